"""Identity of a log: names, sizes and a hash of enough bytes to distinguish any two logs.

The identity of a log is a SHA-256 over its files, sorted by name: the name of each file (with the
name of the folder, if the log is a folder), its size, and a hash of its content. A log of up to
4 MiB is hashed completely. Of a larger log, 4 MiB are divided equally between its files, with at
least 64 KiB each, and a longer file is hashed in parts. For a file with an index at its end (MCAP
files and ROS 1 bags) these are 64 KiB from the head, 64 KiB from the tail, and up to 64 MiB of the
index. For other files they are a quarter from the head, a quarter from the tail, and 32 blocks
spread evenly between them. Identifying a log of 100 GB therefore takes milliseconds. A log has the
same identity at any path or URL, and at any age.

Files next to a log that readers use belong to it: time files of pictures and videos, and SQLite's
journals. Hidden files and the files of other commands (``vehicle.toml``, ``truth.json``, ``.seal``)
do not. Only the hashed parts of a URL are fetched. If they are half of the log or more, the
complete log is fetched, and remains in the store for later reads.
"""

from __future__ import annotations

import hashlib
import os
import re
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, suppress
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Final, Protocol

from crosscue.replay.base import HasUrl, Log
from crosscue.replay.errors import LogError
from crosscue.replay.files.log_identity import Identity
from crosscue.replay.limits import MIB
from crosscue.replay.remote.address import LogAddress, is_remote

from .tree_text import spelled

if TYPE_CHECKING:
    from crosscue.replay.remote.ranges import RangedFile

SHARE_BYTES: Final = 4 * MIB
MIN_BYTES: Final = 64 << 10
EDGE_BYTES: Final = 64 << 10
BLOCKS: Final = 32
INDEX_BYTES: Final = 64 * MIB
BESIDE: Final = frozenset({"vehicle.toml", "truth.json"})

_MCAP_MAGIC: Final = b"\x89MCAP0\r\n"
_MCAP_FOOTER: Final = struct.Struct("<BQQQI8s")
_BAG_MAGIC: Final = b"#ROSBAG V2.0\n"
_BAG_INDEX: Final = re.compile(rb"index_pos=(.{8})", re.DOTALL)


def log_identity(place: Path | str) -> Identity:
    """Return the identity of a log: a file, a folder or a URL; see the head of this file.

    Raises:
        LogError: It does not exist or cannot be read.
    """
    if isinstance(place, str) and is_remote(place):
        return _identity_of_url(LogAddress(place))
    path = Path(place)
    if path.name in ("", ".."):
        path = path.resolve()
    total, digest_of_all = 0, hashlib.sha256()
    try:
        path.stat()
        files = list(_files(path))
        max_bytes = _hashed_bytes(len(files))
        for name, file in files:
            with file.open("rb", buffering=0) as stream:
                opened = _Local(stream.fileno())
                digest_of_all.update(_report_text(name, opened.size, _hash(opened, max_bytes)))
            total += opened.size
    except OSError as error:
        raise LogError(f"{error.filename or path}: {error.strerror or error}; check it") from None
    return Identity(spelled(path.name), total, digest_of_all.hexdigest())


def identity_of_log(log: Log) -> Identity:
    """Return the identity of an open log; parts of a remote log are not fetched twice.

    Raises:
        LogError: It no longer exists or cannot be read.
    """
    if isinstance(log, HasUrl):
        from crosscue.replay.remote.logs import RangedLog

        if isinstance(log, RangedLog):
            return _identity_of_ranged(log.ranged)
    return log_identity(log.path)


def _identity_of_url(url: LogAddress) -> Identity:
    from crosscue.replay.remote.logs import by_ranges, fetch_log

    ranged = by_ranges(url)
    if ranged is not None:
        with closing(ranged):
            return _identity_of_ranged(ranged)
    found = _identity_of_parts(url)
    if found is None:
        with fetch_log(url) as fetched:
            return log_identity(fetched.path)
    return found


def _identity_of_parts(url: LogAddress) -> Identity | None:
    """Return the identity of a remote log of any format; None if all of it should be fetched."""
    from crosscue.replay.remote.logs import RemoteFiles

    remote = RemoteFiles(url)
    names = sorted(_names_of(url.name, remote.sizes).items(), key=lambda one: os.fsencode(one[0]))
    max_bytes = _hashed_bytes(len(names))
    sizes = [remote.sizes[at] for _, at in names]
    total = sum(sizes)
    if not names or remote.is_at_hand or total < 2 * sum(min(size, max_bytes) for size in sizes):
        return None
    digest = hashlib.sha256()
    for reported, at in names:
        content = hashlib.sha256().digest()
        if remote.sizes[at]:
            ranged = remote.ranged(at)
            if ranged is None:
                return None
            with closing(ranged):
                content = _hash(_Remote(ranged), max_bytes)
        digest.update(_report_text(os.fsencode(reported), remote.sizes[at], content))
    return Identity(url.name, total, digest.hexdigest())


def _names_of(name: str, sizes: Mapping[str, int]) -> dict[str, str]:
    """Return the names of a remote log's files in its identity, with those in its store."""
    if name not in sizes:
        parts = {at: PurePosixPath(at).parts[1:] for at in sizes}
        return {at: at for at in sizes if parts[at] and _is_of_log(parts[at])}
    beside = _names_beside(name, lambda other: other in sizes)
    return {name: name} | {f"beside/{other}": other for other in beside}


def _hashed_bytes(files: int) -> int:
    """Return the number of bytes of each file that are hashed."""
    return max(SHARE_BYTES // max(files, 1), MIN_BYTES)


def _identity_of_ranged(ranged: RangedFile) -> Identity:
    name = ranged.url.name
    file = _Remote(ranged)
    digest = hashlib.sha256()
    digest.update(_report_text(os.fsencode(name), file.size, _hash(file, SHARE_BYTES)))
    return Identity(name, file.size, digest.hexdigest())


def _report_text(name: bytes, size: int, content: bytes) -> bytes:
    return f"{len(name)}\0{size}\0".encode() + name + content


def identity_of_all(found: Sequence[Identity]) -> Identity:
    """Return the combined identity of a drive's logs, in any order.

    Args:
        found: Identity of each log; at least one.
    """
    if len(found) == 1:
        return found[0]
    ordered = sorted(found, key=lambda one: (one.name, one.digest))
    sizes = [one.size for one in ordered]
    known = [size for size in sizes if size is not None]
    digest = hashlib.sha256("\0".join(one.digest for one in ordered).encode()).hexdigest()
    names = " + ".join(one.name for one in ordered)
    return Identity(names, sum(known) if len(known) == len(sizes) else None, digest)


def _files(place: Path) -> Iterator[tuple[bytes, Path]]:
    """Yield a log's files and those that belong to it, with their names, sorted."""
    found = {place.name: place} if place.is_file() else _below(place)
    for beside in _beside(place):
        found.setdefault(f"beside/{beside.name}", beside)
    yield from sorted((os.fsencode(name), path) for name, path in found.items())


def link_of_log(place: Path) -> Path | None:
    """Return a link among the files of a log and those that belong to it; None without any.

    The log itself may be given as a link.

    Raises:
        OSError: A folder cannot be listed.
    """
    for folder, folders, names in os.walk(place, onerror=_raise) if place.is_dir() else ():
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        for name in sorted([*folders, *filter(lambda name: _is_of_log((name,)), names)]):
            if os.path.islink(f"{folder}/{name}"):  # noqa: PTH114 (there may be 100,000)
                return Path(folder, name)
    return next((path for path in _beside(place) if path.is_symlink()), None)


def _below(folder: Path) -> dict[str, Path]:
    found = {}
    for place, folders, names in os.walk(folder, onerror=_raise):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        for name in names:
            path = Path(place, name)
            if _is_of_log((name,)) and path.is_file():
                found[f"{folder.name}/{path.relative_to(folder).as_posix()}"] = path
    return found


def _is_of_log(parts: Sequence[str]) -> bool:
    """Return whether a file below a log's folder belongs to the log."""
    is_ours = parts[-1] in BESIDE or PurePosixPath(parts[-1]).suffix == ".seal"
    return not is_ours and not any(part.startswith(".") for part in parts)


def _raise(error: OSError) -> None:
    raise error


def _beside(place: Path) -> list[Path]:
    from .time_file_names import find_time_file

    if place.is_dir():
        with suppress(LogError):
            time_file = find_time_file(place)
            if time_file is not None and place not in time_file.parents:
                return [time_file]
        return []
    return [
        place.with_name(name)
        # Unlike ``Path.is_file``, this is False for a name that is too long.
        for name in _names_beside(
            place.name,
            lambda name: os.path.isfile(place.with_name(name)),  # noqa: PTH113
        )
    ]


def _names_beside(name: str, is_there: Callable[[str], bool]) -> list[str]:
    """Return the files next to a log that belong to it: journals, and the time file of a video."""
    from .time_file_names import times_of_video

    times = times_of_video(name) if PurePosixPath(name).suffix.lower() in _videos() else ()
    time_file = next(filter(is_there, times), None)
    journals = [name + suffix for suffix in ("-wal", "-journal") if is_there(name + suffix)]
    return [*journals, *([] if time_file is None else [time_file])]


def _videos() -> tuple[str, ...]:
    from crosscue.replay.formats import FORMATS

    return FORMATS["video"].suffixes


class _File(Protocol):
    """File with reads at a position."""

    @property
    def size(self) -> int: ...
    def read(self, at: int, size: int) -> bytes | memoryview: ...


class _Local:
    """A local file."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor: Final = descriptor
        self.size: Final = os.fstat(descriptor).st_size

    def read(self, at: int, size: int) -> bytes:
        return os.pread(self._descriptor, size, at)


class _Remote:
    """A remote object, of which only the requested bytes are fetched."""

    def __init__(self, ranged: RangedFile) -> None:
        self._ranged: Final = ranged
        self.size: Final = ranged.size

    def read(self, at: int, size: int) -> memoryview:
        self._ranged.expect([(at, at + size)])
        return self._ranged.at_least(at, size)[:size]


def _hash(file: _File, max_bytes: int) -> bytes:
    """Hash a file's content, or parts of it if it is longer than ``max_bytes``."""
    digest = hashlib.sha256()
    for at, end in _parts(file, max_bytes):
        while at < end and (part := file.read(at, min(end - at, MIB))):
            digest.update(part)
            at += len(part)
    return digest.digest()


def _parts(file: _File, max_bytes: int) -> Iterator[tuple[int, int]]:
    """Yield the spans of the file to hash."""
    size = file.size
    if size <= max_bytes:
        yield 0, size
        return
    index = _index_at(file)
    edge = max_bytes // 4 if index is None else min(EDGE_BYTES, max_bytes // 4)
    yield 0, edge
    if index is None:
        block = max_bytes // 2 // BLOCKS
        between = size - 2 * edge - block
        for i in range(BLOCKS):
            at = edge + between * i // (BLOCKS - 1)
            yield at, at + block
    elif index < size - edge:
        yield index, min(size - edge, index + INDEX_BYTES)
    yield size - edge, size


def _index_at(file: _File) -> int | None:
    """Return the start of the index at a log's end, as recorded in the file."""
    head, size = bytes(file.read(0, EDGE_BYTES))[:4096], file.size
    if head.startswith(_MCAP_MAGIC):
        tail = file.read(size - EDGE_BYTES, EDGE_BYTES)
        opcode, length, start, *_ = _MCAP_FOOTER.unpack(tail[-_MCAP_FOOTER.size :])
        return int(start) if opcode == 2 and length == 20 and 0 < start < size else None
    found = _BAG_INDEX.search(head) if head.startswith(_BAG_MAGIC) else None
    start = int.from_bytes(found[1], "little") if found else 0
    return start if 0 < start < size else None
