"""Fetch published recordings, with a hash for each file, into a folder or a cache.

Each recording has a folder here: ``recording.toml`` specifies the URLs of its files;
``vehicle.toml`` and ``truth.json`` are part of crosscue. ``$CROSSCUE_DRIVES`` names the folder for
recordings of the demo (default: the user's cache). ``$CROSSCUE_DRIVE_MIRROR`` names a server that
replaces the publisher, with files ``MIRROR/NAME/FILE``. ``$CROSSCUE_DATA`` names a folder that is
searched first.
"""

import hashlib
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Annotated, Final, Literal

from pydantic import Field

from crosscue.detectors.catalog.card import Hash
from crosscue.detectors.catalog.fetch import DATA
from crosscue.detectors.settings import Settings
from crosscue.replay.errors import LogError, OutputError, UsageError, VehicleError
from crosscue.replay.files.door import user_cache
from crosscue.replay.files.transfer import Progress, download, is_there, take
from crosscue.replay.limits import MIB
from crosscue.replay.progress import Progress as ShownProgress
from crosscue.replay.progress import emit
from crosscue.replay.vehicle.validation_errors import read_model
from crosscue.results import Result
from crosscue.verb import Option

FOLDER: Final = Path(__file__).parent
VARIABLE: Final = "CROSSCUE_DRIVES"
MIRROR: Final = "CROSSCUE_DRIVE_MIRROR"
OTHERWISE: Final = f"give its folder with --data FOLDER or {DATA}, or name a mirror in {MIRROR}"


class RecordedFile(Settings):
    """One file of a recording."""

    name: Annotated[str, Field(pattern=r"^\w[\w.-]*(/\w[\w.-]*)*$")]
    """Path of the file inside the recording."""
    size_bytes: Annotated[int, Field(gt=0, le=64 * MIB)]
    sha256: Hash
    url: Annotated[str, Field(pattern="^https?://")] | None = None
    """URL of the file; None if it is in the recording's folder."""


class Recording(Settings):
    """A published recording."""

    version: Literal[1]
    name: Annotated[str, Field(pattern=r"^\w+$")]
    """Name of its folder, both here and in the cache."""
    about: str
    """Description of its content in one line."""
    licence: str
    attribution: str
    """Attribution to show with its pictures."""
    url: Annotated[str, Field(pattern="^https?://")]
    """URL of the folder with its files, at one commit."""
    folders: tuple[str, ...]
    """Possible subfolders of ``--data`` or ``$CROSSCUE_DATA`` that contain it."""
    files: Annotated[tuple[RecordedFile, ...], Field(min_length=1)]

    @property
    def size_bytes(self) -> int:
        """Total size of its files."""
        return sum(file.size_bytes for file in self.files)

    @property
    def vehicle(self) -> Path:
        """Path of crosscue's vehicle file."""
        return FOLDER / self.name / "vehicle.toml"

    @property
    def truth(self) -> Path:
        """Path of crosscue's annotations."""
        return FOLDER / self.name / "truth.json"

    def needs(self) -> str:
        """Number and size of files, and licence, for display."""
        return (
            f"recording {self.name}: {len(self.files)} files, {self.size_bytes / 1e6:.1f} MB, "
            f"{self.licence}"
        )


def recording(name: str) -> Recording:
    """Return the recording with this name.

    Raises:
        UsageError: No recording has this name.
        VehicleError: Its ``recording.toml`` is damaged.
    """
    known = sorted(path.parent.name for path in FOLDER.glob("*/recording.toml"))
    if name not in known:
        raise UsageError(f"recording {name}: unknown; expected one of: {', '.join(known)}")
    path = FOLDER / name / "recording.toml"
    return read_model(path, Recording, VehicleError, "install crosscue again")


def recording_folder(known: Recording) -> Path:
    """Return the cache folder of a recording, which is distinct for each list of files."""
    of_files = hashlib.sha256("".join(file.sha256 for file in known.files).encode()).hexdigest()
    asked = os.environ.get(VARIABLE)
    base = Path(asked) if asked else user_cache(VARIABLE) / "drives"
    return base / of_files[:16] / known.name


def fetch_recording(
    known: Recording,
    given: Path | None = None,
    on_progress: Progress = lambda name, done, total: None,
    place: Path | None = None,
) -> Path:
    """Fetch a recording, and check every file; existing files are kept.

    Args:
        known: The recording.
        given: Folder that contains it; the network is then not used.
        on_progress: Called with a file, the bytes of the recording fetched so far, and their total.
        place: Folder for it; the cache if None.

    Returns:
        The folder of the recording, to be opened as a log.

    Raises:
        LogError: ``given`` does not contain the recording.
        UsageError: ``given`` contains another recording, or a part of it.
        CrosscueError: A file cannot be fetched, or is not the published one.
        OutputError: The cache cannot be written.
    """
    place = place or recording_folder(known)
    total, done = known.size_bytes, 0
    source = _folder_in(known, given)
    at_hand = None
    if source is None and os.environ.get(DATA):
        at_hand = _folder_below(known, Path(os.environ[DATA]))
    mirror = os.environ.get(MIRROR)
    owner = f"recording {known.name}"
    for file in known.files:
        target, before = place / file.name, done
        if is_there(file, target):
            pass
        elif source is not None:
            take(source / file.name, file, target, owner)
        elif at_hand is not None and is_there(file, at_hand / file.name):
            take(at_hand / file.name, file, target, owner)
        else:
            folder = f"{mirror.rstrip('/')}/{known.name}" if mirror else known.url
            download(
                file.url if file.url and not mirror else f"{folder}/{file.name}",
                file,
                target,
                owner,
                OTHERWISE,
                _after(before, total, on_progress),
            )
        done += file.size_bytes
        on_progress(file.name, done, total)
    return place


@dataclass(frozen=True, slots=True, repr=False)
class FetchedRecording(Result):
    """A recording on this machine.

    Attributes:
        folder: Its folder, to be opened as a log.
        about: Description of its content in one line.
        licence: Its licence.
        attribution: Attribution to show with it.
    """

    folder: Path
    about: str
    licence: str
    attribution: str

    def lines(self) -> Iterator[str]:
        """Yield what it is, and a command to begin with."""
        yield self.about
        yield f"licence    {self.licence}; {self.attribution}"
        yield f"recording  {self.folder}"
        yield f"           begin with: crosscue info {self.folder}"


def fetch(
    name: str,
    output: Path | str | None = None,
    *,
    source: Annotated[Path | str | None, Option("--data", metavar="FOLDER")] = None,
) -> FetchedRecording:
    """Download a public recording, with every file verified.

    Files that are already there are kept, so an interrupted download is continued.

    Examples:
        crosscue fetch comma2k19
        crosscue fetch pandaset_002 -o pandaset

    Args:
        name: Recording: comma2k19 (a minute of a Toyota's CAN, IMU and GNSS, with a DBC file) or
            pandaset_002 (8 s of pictures with poses).
        output: Folder for its files (default: NAME in the current folder).
        source: Folder that contains it, to use instead of downloading it.

    Raises:
        UsageError: No recording has this name, or ``source`` contains another one.
        OutputError: The folder contains other files, or cannot be written.
        CrosscueError: A file cannot be fetched, or is not the published one.
    """
    known, place = recording(name), Path(output or name)
    _refuse_others(place, known)
    given = None if source is None else Path(source)
    fetch_recording(
        known,
        given,
        lambda file, done, of: emit(ShownProgress(file, done / 1e6, of / 1e6, "MB")),
        place=place,
    )
    return FetchedRecording(place, known.about, known.licence, known.attribution)


def _refuse_others(place: Path, known: Recording) -> None:
    if place.exists() and not place.is_dir():
        raise OutputError(f"{place}: is a file; choose a new folder")
    files = {place / file.name: file for file in known.files}
    for found in sorted(place.rglob("*")):
        whole = found.with_suffix("") if found.suffix == ".part" else found
        if found.is_dir():
            continue
        if whole not in files or (found == whole and not is_there(files[whole], found)):
            raise OutputError(
                f"{place}: holds {found.relative_to(place)}, which is not of recording "
                f"{known.name}; choose a new folder"
            )


def _after(before: int, total: int, on_progress: Progress) -> Progress:
    """Return a callback that reports progress of a file as progress of the recording."""
    return lambda name, have, _: on_progress(name, before + have, total)


def _folder_in(known: Recording, given: Path | None) -> Path | None:
    if given is None:
        return None
    found = _folder_below(known, given)
    if found is None:
        raise LogError(
            f"{given}: expected a folder with {known.files[0].name} of recording {known.name}, "
            f"itself or in {' or '.join(known.folders)}"
        )
    return found


def _folder_below(known: Recording, folder: Path) -> Path | None:
    """Return the folder with the recording's first file, or None."""
    for below in (".", *known.folders):
        if (folder / below / known.files[0].name).is_file():
            return folder / PurePosixPath(below)
    return None
