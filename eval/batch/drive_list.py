"""Drives that the LOG arguments of a command line name.

Logs named one by one are the logs of one drive, merged by time. Many drives are named by

* a folder that holds drives: a sub-folder for each, or recordings side by side;
* a quoted pattern (``'drives/*/drive.mcap'``, ``'s3://bucket/**/*.mcap'``): each match is a drive;
* ``@drives.txt``: a line for each drive, its logs separated by spaces, relative to the list's
  folder;
* ``each``: every argument is a drive, or a folder of drives.

If any argument has one of these forms, every other argument is a drive, too. A folder with
``vehicle.toml`` or ``truth.json`` next to its recordings, as ``crosscue simulate`` writes it, is
one drive and uses those files.

A hash of a drive's identity selects its shard, not its position in a list. Drives can therefore be
added, removed or named in another order, and every other drive stays in its shard.
"""

from __future__ import annotations

import glob
import hashlib
import re
import shlex
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, NamedTuple

from crosscue.eval.runs.folder import MANIFEST
from crosscue.replay.errors import LogError, UnknownFormatError, UsageError
from crosscue.replay.files.bounded import read_text
from crosscue.replay.files.identity import identity_of_all, log_identity
from crosscue.replay.files.log_identity import SHORT
from crosscue.replay.formats import format_of, known_formats
from crosscue.replay.limits import MIB
from crosscue.replay.remote.address import LogAddress, is_remote
from crosscue.replay.remote.logs import matches

VEHICLE: Final = "vehicle.toml"
TRUTH: Final = "truth.json"
LIST_BYTES: Final = 64 * MIB
# Max nesting of folders of drives.
DEPTH: Final = 8
NAME_LENGTH: Final = 150
# File names of logs that do not identify a drive.
SAYS_NOTHING: Final = frozenset(
    {"bag", "camera", "can", "can0", "can1", "data", "drive", "images", "log", "logs", "record",
     "recording", "rosbag", "rosbag2", "video"}
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class DriveInput:
    """One drive named on a command line.

    Attributes:
        name: A readable stem and 8 hex digits of the logs' identity, independent of the rest of
            the batch; letters, digits and ``._+=@-`` only.
        logs: Paths or URLs, as entered, sorted by name because their order has no effect.
        vehicle: The vehicle file next to its logs, if any.
        truth: The ground-truth file next to its logs, if any.
    """

    name: str
    logs: tuple[str, ...]
    vehicle: Path | None = None
    truth: Path | None = None

    @property
    def identity(self) -> str:
        """Identity of its logs, independent of their location."""
        return self.name[-SHORT:]


@dataclass(frozen=True, slots=True)
class DriveList:
    """Drives named on a command line.

    Attributes:
        drives: At least one, or those of a shard, which may be empty.
        is_many: True if each drive gets its own run folder below the output folder.
        shard: The shard that these drives belong to; None for all drives.
        of: Number of drives named, in all shards.
    """

    drives: tuple[DriveInput, ...]
    is_many: bool
    shard: Shard | None = None
    of: int = 0

    def part(self, shard: Shard) -> DriveList:
        """Return the drives of one shard.

        Raises:
            UsageError: The list is a single drive.
        """
        if not self.is_many:
            raise UsageError(f"--shard {shard}: expected many drives, found one; add --each")
        mine = tuple(one for one in self.drives if shard.holds(one.identity))
        return replace(self, drives=mine, shard=shard, of=len(self.drives))


class _Found(NamedTuple):
    """Logs of a drive before it has a name, and the folder that may hold its own files."""

    logs: tuple[str, ...]
    beside: Path | None


def find_drives(*logs: Path | str, each: bool = False, shard: str | None = None) -> DriveList:
    """Find one drive, whose logs are merged by time, or many, by the rules of the module docstring.

    Args:
        logs: Paths or URLs.
        each: Treat each path as a separate drive, or as a folder of drives.
        shard: ``2/4`` selects the second of four parts, divided by a hash of each drive's identity.

    Returns:
        ``drives``, each with its logs and the vehicle file and truth next to them; and ``is_many``.

    Raises:
        UsageError: Nothing matches, a list cannot be read, a drive is named twice, a folder may be
            one drive or several, or ``shard`` is not valid or set for one drive.
        LogError: A path does not exist, or may not be read.
    """
    part = None if shard is None else read_shard(shard)
    arguments = [LogAddress(log) if is_remote(log) else log for log in map(str, logs)]
    is_many = each or any(_is_plural(text) for text in arguments)
    if not is_many and len(arguments) > 1:
        found = [_Found(tuple(arguments), None)]
    else:
        found = [one for text in arguments for one in _expanded(text, each=each)]
        if not is_many and not Path(arguments[0]).is_dir():
            found = [found[0]._replace(beside=None)]
    drives = DriveList(tuple(_named(found)), is_many)
    return drives if part is None else drives.part(part)


def _is_plural(text: str) -> bool:
    return text.startswith("@") or _is_pattern(text) or _is_collection(text)


def _is_pattern(text: str) -> bool:
    return glob.has_magic(text) and (is_remote(text) or not Path(text).exists())


def _is_collection(text: str) -> bool:
    """Return whether an argument is a folder that is neither a recording nor a single drive."""
    place = Path(text)
    return not is_remote(text) and place.is_dir() and not _is_drive(place) and not _format(place)


def _expanded(text: str, *, each: bool) -> Iterator[_Found]:
    if text.startswith("@"):
        yield from _listed(Path(text[1:]), each=each)
    elif _is_pattern(text):
        yield from _matched(text)
    elif is_remote(text) or not Path(text).is_dir():
        yield _plain(text)
    else:
        yield from _in_folder(Path(text), each=each)


def _plain(text: str) -> _Found:
    return _Found((text,), None if is_remote(text) else Path(text).parent)


def _stem(name: str) -> str:
    """Return a recording's name without its suffix; a folder's name may contain dots."""
    suffix = Path(name).suffix
    known = any(suffix.lower() in one.suffixes for one in known_formats().values())
    return name[: -len(suffix)] if known else name


def _listed(path: Path, *, each: bool) -> Iterator[_Found]:
    text = read_text(path, LIST_BYTES, UsageError, "expected a list of logs", "surrogateescape")
    count = 0
    for number, line in enumerate(text.splitlines(), 1):
        try:
            words = shlex.split(line, comments=True)
        except ValueError as error:
            raise UsageError(f"@{path}: line {number}: {error}; quote names with blanks") from None
        logs = [LogAddress(word) if is_remote(word) else str(path.parent / word) for word in words]
        if len(logs) == 1:
            yield from _expanded(logs[0], each=each)
        elif logs:
            yield _plain(logs[0])._replace(logs=tuple(logs))
        count += bool(logs)
    if not count:
        raise UsageError(f"@{path}: names no drive; expected a line for each")


def _matched(pattern: str) -> Iterator[_Found]:
    if is_remote(pattern):
        found = matches(pattern)
    else:
        found = tuple(sorted(glob.glob(pattern, recursive=True)))  # noqa: PTH207 (keeps ** and relative names)
    if not found:
        raise UsageError(f"{pattern}: nothing matches; check the pattern")
    for text in found:
        if is_remote(text) or Path(text).is_file():
            yield _plain(text)
        else:
            yield from _in_folder(Path(text), each=False)


def _in_folder(folder: Path, *, each: bool) -> Iterator[_Found]:
    """Yield the folder as one drive, or the drives in it."""
    is_split = _format(folder) == "rosbag2" and not folder.joinpath("metadata.yaml").exists()
    if _is_drive(folder):
        yield _drive_folder(folder)
    elif _format(folder) and not (each and is_split):
        yield _Found((str(folder),), folder.parent)
    else:
        found = list(_drives_below(folder, 1))
        if not found:
            raise UnknownFormatError(
                f"{folder}: no drive found; expected recordings or folders of recordings"
            )
        yield from found


def _drives_below(folder: Path, depth: int) -> Iterator[_Found]:
    recordings = _recordings(folder)
    formats = {_format(one) for one in recordings if one.is_file()}
    if len(formats) > 1:
        raise UsageError(
            f"{folder}: recordings of several formats ({', '.join(sorted(formats))}): one drive or "
            f"many? put a {VEHICLE} next to those of one drive, or list them (@drives.txt)"
        )
    for entry in _entries(folder):
        if entry.is_file() and entry in recordings:
            yield _plain(str(entry))
        elif entry.is_dir() and not entry.joinpath(MANIFEST).exists():
            if _is_drive(entry):
                yield _drive_folder(entry)
            elif _format(entry):
                yield _Found((str(entry),), entry.parent)
            elif depth < DEPTH and not entry.is_symlink():
                yield from _drives_below(entry, depth + 1)


def _drive_folder(folder: Path) -> _Found:
    return _Found(tuple(str(one) for one in _recordings(folder)), folder)


def _is_drive(folder: Path) -> bool:
    """Return whether a folder holds a drive's own files and recordings that fit one drive."""
    if not any(folder.joinpath(mark).is_file() for mark in (VEHICLE, TRUTH)):
        return False
    found = _recordings(folder)
    return len(found) == 1 or any(one.is_file() for one in found)


def _recordings(folder: Path) -> list[Path]:
    found = [one for one in _entries(folder) if _format(one)]
    return [one for one in found if not one.joinpath(MANIFEST).exists()]


def _entries(folder: Path) -> list[Path]:
    try:
        return sorted(one for one in folder.iterdir() if not one.name.startswith("."))
    except OSError as error:
        raise LogError(f"{folder}: {error.strerror}; check its owner and mode") from None


def _format(place: Path) -> str:
    """Return the format of a recording; empty for anything else."""
    try:
        return format_of(place)
    except UnknownFormatError:
        return ""
    except LogError:
        if place.is_dir():
            raise
        return ""


def _named(found: Sequence[_Found]) -> list[DriveInput]:
    """Return each drive with a name that depends on its own logs alone."""
    drives: dict[str, DriveInput] = {}
    for one in found:
        logs = tuple(sorted(one.logs, key=lambda log: (_parts(log)[-1], log)))
        name = _name(logs)
        if name in drives:
            first, second = " ".join(drives[name].logs), " ".join(logs)
            also = "named twice" if first == second else f"the same recording as {first}"
            raise UsageError(f"{second}: {also}; name each drive once")
        vehicle, truth = _file(one.beside, VEHICLE), _file(one.beside, TRUTH)
        drives[name] = DriveInput(name, logs, vehicle, truth)
    return list(drives.values())


def _name(logs: tuple[str, ...]) -> str:
    text = re.sub(r"[^A-Za-z0-9._+=@-]", "_", _readable(logs)).lstrip(".") or "drive"
    return f"{text[:NAME_LENGTH]}-{_identity(logs)}"


def _readable(logs: tuple[str, ...]) -> str:
    """Return a readable name: the folder's if it holds one drive, else the first log's.

    A log with a generic name (``drive``, ``40``) is named after its folder.
    """
    parts = [part for part in _parts(logs[0]) if part != "/"]
    if len(logs) > 1 and all(_parts(log)[:-1] == _parts(logs[0])[:-1] for log in logs):
        folder = Path(logs[0]).parent
        if not is_remote(logs[0]) and any((folder / mark).is_file() for mark in (VEHICLE, TRUTH)):
            return parts[-2]
    stem, above = parts[-1], parts[:-1]
    while above and stem.lower() in SAYS_NOTHING:
        stem = above.pop()
    while above and not any(letter.isalpha() for letter in stem):
        stem = f"{above.pop()}__{stem}"
    return stem


def _parts(log: str) -> tuple[str, ...]:
    """Return the parts of a log's absolute path or URL, the last one without its suffix."""
    if is_remote(log):
        parts = tuple(part for part in re.split(r"[:/]+", log) if part)
    else:
        parts = Path(log).absolute().parts
    return (*parts[:-1], _stem(parts[-1]))


def _identity(logs: tuple[str, ...]) -> str:
    """Return the identity of the logs.

    A log that cannot be read is identified by its path, so that its failure has a stable name.
    """
    try:
        return identity_of_all([log_identity(log) for log in logs]).short
    except LogError:
        places = [log if is_remote(log) else str(Path(log).absolute()) for log in logs]
        text = "\0".join(places).encode(errors="surrogateescape")
        return hashlib.sha256(text).hexdigest()[:SHORT]


def _file(folder: Path | None, name: str) -> Path | None:
    return folder / name if folder is not None and folder.joinpath(name).is_file() else None


@dataclass(frozen=True, slots=True)
class Shard:
    """One of several parts; written ``2/4``.

    Attributes:
        number: Index of the part, from 1.
        count: Number of parts.
    """

    number: int
    count: int

    def holds(self, identity: str) -> bool:
        """Return whether the drive of this identity belongs to this part, and so to no other."""
        digest = hashlib.sha256(identity.encode()).digest()
        return int.from_bytes(digest, "big") % self.count == self.number - 1

    def __str__(self) -> str:
        return f"{self.number}/{self.count}"


def read_shard(text: str) -> Shard:
    """Parse ``2/4``.

    Raises:
        UsageError: The text has another form.
    """
    found = re.fullmatch(r"([0-9]{1,9})/([0-9]{1,9})", text)
    shard = Shard(*map(int, found.groups())) if found else Shard(0, 0)
    if not 1 <= shard.number <= shard.count:
        raise UsageError(f"--shard {text}: expected i/n with i from 1 to n, such as 2/4")
    return shard
