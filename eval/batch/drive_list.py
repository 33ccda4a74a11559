"""Which drives a command line means.

Logs named one by one are the logs of one drive, merged by time. Many drives are meant by

* a folder that holds drives: a sub-folder for each, or recordings side by side;
* a pattern that the shell left alone (``'drives/*/drive.mcap'``, ``'s3://bucket/**/*.mcap'``):
  each match is a drive;
* ``@drives.txt``: a line for each drive, its logs as words, relative to the list's folder;
* ``each``: every argument is a drive, or a folder of drives.

One of these makes drives of its neighbors, too. A folder with ``vehicle.toml`` or ``truth.json``
beside its recordings, as ``crosscue simulate`` writes, is one drive, and brings those files along.
"""

from __future__ import annotations

import glob
import hashlib
import os
import re
import shlex
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from crosscue.eval.runs.folder import MANIFEST
from crosscue.replay.base import (
    MIB,
    LogError,
    UnknownFormatError,
    UsageError,
    is_remote,
    read_at_most,
)
from crosscue.replay.files.identity import identity_of, identity_of_all
from crosscue.replay.files.log_identity import SHORT
from crosscue.replay.formats import format_of, known_formats
from crosscue.replay.remote.logs import matches

from .shards import Shard, read_shard

VEHICLE: Final = "vehicle.toml"
TRUTH: Final = "truth.json"
LIST_BYTES: Final = 64 * MIB
DEPTH: Final = 8
"""Of folders within folders of drives."""
NAME_LENGTH: Final = 150
SAYS_NOTHING: Final = frozenset(
    {
        "bag",
        "camera",
        "can",
        "can0",
        "can1",
        "data",
        "drive",
        "images",
        "log",
        "logs",
        "record",
        "recording",
        "rosbag",
        "rosbag2",
        "video",
    }
)
"""Names of logs that distinguish no drive from another."""


@dataclass(frozen=True, slots=True)
class DriveInput:
    """One drive that a command line means.

    Attributes:
        name: A readable stem and 8 hex digits of the logs' identity, whatever else is in the
            batch; letters, digits and ``._+=@-`` only.
        logs: Paths or URLs, as given, sorted by name: their order changes nothing.
        vehicle: The vehicle file that is beside its logs, if any.
        truth: The truth that is beside its logs, if any.
    """

    name: str
    logs: tuple[str, ...]
    vehicle: Path | None = None
    truth: Path | None = None

    @property
    def identity(self) -> str:
        """Of its logs, wherever they are."""
        return self.name[-SHORT:]


@dataclass(frozen=True, slots=True)
class DriveList:
    """What a command line means.

    Attributes:
        drives: At least one, or those of a shard, which may be none.
        is_many: Does each get a run folder of its own below the one asked for?
        shard: Which part of the drives named these are; None for all.
        of: How many drives were named.
    """

    drives: tuple[DriveInput, ...]
    is_many: bool
    shard: Shard | None = None
    of: int = 0

    def part(self, shard: Shard) -> DriveList:
        """The drives of one shard.

        Raises:
            UsageError: It is a single drive.
        """
        if not self.is_many:
            raise UsageError(
                f"--shard {shard}: for many drives; this is one (--each makes it many)"
            )
        mine = tuple(one for one in self.drives if shard.holds(one.identity))
        return replace(self, drives=mine, shard=shard, of=len(self.drives))


@dataclass(frozen=True, slots=True)
class _Found:
    """A drive before it has a name.

    Attributes:
        logs: As in ``DriveInput``, in the order met.
        beside: The folder that may hold its vehicle file and truth, or None.
    """

    logs: tuple[str, ...]
    beside: Path | None


def drives_of(
    arguments: Sequence[str], *, each: bool = False, shard: str | None = None
) -> DriveList:
    """The drives that LOG arguments mean; see the head of this file.

    Args:
        arguments: At least one.
        each: Every one is a drive, or a folder of drives.
        shard: Which part of the drives, see ``read_shard``; None for all.

    Raises:
        UsageError: Nothing matches, a list that cannot be read, a drive named twice, or a folder
            that may be one drive or several.
        LogError: A place that is not there or may not be looked into.
    """
    part = None if shard is None else read_shard(shard, os.environ)
    found = _all_of(arguments, each=each)
    return found if part is None else found.part(part)


def _all_of(arguments: Sequence[str], *, each: bool) -> DriveList:
    is_many = each or any(_is_plural(text) for text in arguments)
    if not is_many and len(arguments) > 1:
        return DriveList(tuple(_named([_Found(tuple(arguments), None)])), False)
    found = [one for text in arguments for one in _expanded(text, each=each)]
    if not is_many and not Path(arguments[0]).is_dir():
        found = [replace(found[0], beside=None)]
    return DriveList(tuple(_named(found)), is_many)


def _is_plural(text: str) -> bool:
    return text.startswith("@") or _is_pattern(text) or _is_collection(text)


def _is_pattern(text: str) -> bool:
    return glob.has_magic(text) and (is_remote(text) or not Path(text).exists())


def _is_collection(text: str) -> bool:
    """A folder that is neither a recording nor one drive's."""
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
    """A recording's name without its suffix; a folder's may hold dots."""
    suffix = Path(name).suffix
    known = any(suffix.lower() in one.suffixes for one in known_formats().values())
    return name[: -len(suffix)] if known else name


def _listed(path: Path, *, each: bool) -> Iterator[_Found]:
    try:
        content = read_at_most(path, LIST_BYTES)
        if content is None:
            raise UsageError(f"@{path}: larger than {LIST_BYTES // MIB} MiB; give a list of logs")
        lines = content.decode("utf-8", "surrogateescape").splitlines()
    except OSError as error:
        raise UsageError(f"@{path}: {error.strerror}; give a text file") from None
    count = 0
    for number, line in enumerate(lines, 1):
        try:
            words = shlex.split(line, comments=True)
        except ValueError as error:
            raise UsageError(f"@{path}: line {number}: {error}; quote names with blanks") from None
        logs = [word if is_remote(word) else str(path.parent / word) for word in words]
        if len(logs) == 1:
            yield from _expanded(logs[0], each=each)
        elif logs:
            yield replace(_plain(logs[0]), logs=tuple(logs))
        count += bool(logs)
    if not count:
        raise UsageError(f"@{path}: names no drive; give a line for each")


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
    """The folder as a drive, or the drives in it."""
    is_split = _format(folder) == "rosbag2" and not folder.joinpath("metadata.yaml").exists()
    if _is_drive(folder):
        yield _drive_folder(folder)
    elif _format(folder) and not (each and is_split):
        yield _Found((str(folder),), folder.parent)
    else:
        found = list(_walk(folder, 1))
        if not found:
            raise UnknownFormatError(
                f"{folder}: no drive in it; give recordings or folders of them"
            )
        yield from found


def _walk(folder: Path, depth: int) -> Iterator[_Found]:
    """Drives in a folder of drives."""
    recordings = _recordings(folder)
    formats = {_format(one) for one in recordings if one.is_file()}
    if len(formats) > 1:
        raise UsageError(
            f"{folder}: recordings of several formats ({', '.join(sorted(formats))}): one drive or "
            f"many? put a {VEHICLE} beside those of one drive, or name them in a list (@drives.txt)"
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
                yield from _walk(entry, depth + 1)


def _drive_folder(folder: Path) -> _Found:
    return _Found(tuple(str(one) for one in _recordings(folder)), folder)


def _is_drive(folder: Path) -> bool:
    """What belongs to one drive, beside recordings that can be those of one."""
    if not any(folder.joinpath(mark).is_file() for mark in (VEHICLE, TRUTH)):
        return False
    found = _recordings(folder)
    return len(found) == 1 or any(one.is_file() for one in found)


def _recordings(folder: Path) -> list[Path]:
    """Recordings right in a folder."""
    found = [one for one in _entries(folder) if _format(one)]
    return [one for one in found if not one.joinpath(MANIFEST).exists()]


def _entries(folder: Path) -> list[Path]:
    try:
        return sorted(one for one in folder.iterdir() if not one.name.startswith("."))
    except OSError as error:
        raise LogError(f"{folder}: {error.strerror}; check its owner and mode") from None


def _format(place: Path) -> str:
    """Of a recording; empty for anything else."""
    try:
        return format_of(place)
    except UnknownFormatError:
        return ""
    except LogError:
        if place.is_dir():
            raise
        return ""


def _named(found: Sequence[_Found]) -> list[DriveInput]:
    """Each drive with a name that its own logs alone decide.

    Raises:
        UsageError: One drive is named twice, perhaps as a copy.
    """
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
    """What a person calls the drive: its folder if that is one drive's, else its first log.

    A log of a name that says nothing (``drive``, ``40``) is called by its folder.
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
    """Of a log's absolute place, the last one without its suffix."""
    if is_remote(log):
        parts = tuple(part for part in re.split(r"[:/]+", log) if part)
    else:
        parts = Path(log).absolute().parts
    return (*parts[:-1], _stem(parts[-1]))


def _identity(logs: tuple[str, ...]) -> str:
    """Of the logs; of a log that cannot be read, of its place: it will fail, but by this name."""
    try:
        return identity_of_all([identity_of(log) for log in logs]).short
    except LogError:
        places = [log if is_remote(log) else str(Path(log).absolute()) for log in logs]
        text = "\0".join(places).encode(errors="surrogateescape")
        return hashlib.sha256(text).hexdigest()[:SHORT]


def _file(folder: Path | None, name: str) -> Path | None:
    return folder / name if folder is not None and folder.joinpath(name).is_file() else None
