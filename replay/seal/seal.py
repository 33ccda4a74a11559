"""Seals: a hash of each MiB of a log, stored next to it as ``LOG.seal``.

Many formats have no checksum, so that a flipped payload byte in a .db3, a candump log or a video
cannot be detected. A seal locates it to within one MiB. The hash is XXH3 with 128 bits. It protects
against accidents (a failing disk, a broken copy), not against an attacker who can write the seal.

The seal of a folder covers all of its files, except hidden files and seals. The seal of a file also
covers the files that its reader opens next to it: SQLite's journals, or a video's time file.
"""

import json
import os
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path, PurePosixPath
from typing import Any, Final

import xxhash

from crosscue.replay.errors import LogError, OutputError, one_line
from crosscue.replay.files import door
from crosscue.replay.files.tree_text import json_tree, spelled, strict_json
from crosscue.replay.limits import MIB

SUFFIX: Final = ".seal"
KIND: Final = "crosscue seal"
VERSION: Final = 1
HASH: Final = "xxh3_128"
BLOCK_BYTES: Final = MIB
DIGEST_BYTES: Final = 16
# Max size of a seal file, which suffices for a log of 8 TB.
MAX_SEAL_BYTES: Final = 256 * MIB
# Name in the seal of a log that is one file, so that both can be renamed together.
THE_LOG: Final = "."
_NAMES_SHOWN: Final = 3


@dataclass(frozen=True, slots=True)
class SealedFile:
    """One file at the time of sealing.

    Attributes:
        name: Spelling of its path in the log's folder; ``THE_LOG`` for a log of one file.
        size: Size in bytes.
        digests: Concatenated hashes of all blocks, with ``DIGEST_BYTES`` each.
    """

    name: str
    size: int
    digests: bytes

    @property
    def blocks(self) -> int:
        """Number of blocks."""
        return _blocks_in(self.size)

    def digest(self, block: int) -> bytes:
        """Return the hash of one block."""
        return self.digests[block * DIGEST_BYTES : (block + 1) * DIGEST_BYTES]


@dataclass(frozen=True, slots=True)
class Seal:
    """All files of a log at the time of sealing.

    Attributes:
        sealed_at: Time of sealing in UTC, ISO 8601.
        files: Files by name.
    """

    sealed_at: str
    files: Mapping[str, SealedFile]

    @property
    def blocks(self) -> int:
        """Total number of blocks of all files."""
        return sum(file.blocks for file in self.files.values())


@dataclass(frozen=True, slots=True)
class Span:
    """Bytes of a file that differ from the seal.

    Attributes:
        name: Name as in the seal.
        start: First byte of the first block that differs.
        stop: One past the last byte of the last block that differs.
    """

    name: str
    start: int
    stop: int


def seal_path(log: Path) -> Path:
    """Return the path of a log's seal, which need not exist."""
    # "." has no name, and symbolic links must not be resolved.
    return Path(os.path.abspath(log) + SUFFIX)  # noqa: PTH100


def files_of(log: Path) -> dict[str, Path]:
    """Return the files of a log by their names in a seal.

    Raises:
        OSError: A folder cannot be listed.
    """
    if log.is_dir():
        return {spelled(str(path.relative_to(log))): path for path in sorted(_walked(log))}
    from crosscue.replay.files.time_file_names import time_file_of_video

    beside = [log.with_name(log.name + suffix) for suffix in ("-wal", "-journal")]
    times = time_file_of_video(log) if _is_video(log) else None
    return {THE_LOG: log} | {
        spelled(path.name): path for path in [*beside, times] if path is not None and path.is_file()
    }


def _is_video(log: Path) -> bool:
    from crosscue.replay.formats import FORMATS

    return log.suffix.lower() in FORMATS["video"].suffixes


def _walked(folder: Path) -> Iterator[Path]:
    """Yield the regular files below a folder; links are followed once."""
    met: set[tuple[int, int]] = set()
    _is_new(folder, met)
    for place, folders, names in os.walk(folder, followlinks=True, onerror=_fail):
        here = Path(place)
        folders[:] = [name for name in folders if name[0] != "." and _is_new(here / name, met)]
        for name in names:
            path = here / name
            if name[0] != "." and not name.endswith(SUFFIX) and path.is_file():
                yield path


def _is_new(folder: Path, met: set[tuple[int, int]]) -> bool:
    at = folder.stat()
    key = (at.st_dev, at.st_ino)
    is_new = key not in met
    met.add(key)
    return is_new


def _fail(error: OSError) -> None:
    raise error


@dataclass(slots=True)
class Sealing:
    """An unfinished seal; iterate over it to compute it.

    Attributes:
        log: Log to seal.
        done: Number of bytes hashed so far.
        total: Number of bytes to hash.
    """

    log: Path
    done: int = 0
    total: int = 0
    _made: dict[str, SealedFile] = field(default_factory=dict)

    def __iter__(self) -> Iterator[int]:
        """Hash every block, and yield the number of bytes done.

        Raises:
            LogError: A file cannot be read, or changes during hashing.
        """
        try:
            files = files_of(self.log)
            before = _stamps(files)
            self.total = sum(size for size, _ in before.values())
            for name, path in files.items():
                size, digests = before[name][0], bytearray()
                for digest in digests_of(path, range(_blocks_in(size)), size):
                    digests += digest
                    self.done += BLOCK_BYTES
                    yield min(self.done, self.total)
                self._made[name] = SealedFile(name, size, bytes(digests))
            after = _stamps(files_of(self.log))
        except OSError as error:
            raise LogError(f"{error.filename or self.log}: {error.strerror or error}") from None
        if after != before:
            raise LogError(f"{self.log}: changed while it was sealed; seal it when it is complete")

    @property
    def seal(self) -> Seal:
        """Return the seal, once all bytes are hashed."""
        return Seal(datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ"), self._made)


def _stamps(files: Mapping[str, Path]) -> dict[str, tuple[int, int]]:
    stats = {name: path.stat() for name, path in files.items()}
    return {name: (at.st_size, at.st_mtime_ns) for name, at in stats.items()}


def _blocks_in(size: int) -> int:
    return -(-size // BLOCK_BYTES)


def digests_of(path: Path, blocks: Iterable[int], size: int) -> Iterator[bytes]:
    """Yield the hashes of blocks of a file, for a size of ``size`` bytes.

    Raises:
        OSError: The file cannot be read.
    """
    buffer = memoryview(bytearray(BLOCK_BYTES))
    with path.open("rb", buffering=0) as file:
        for block in blocks:
            at = block * BLOCK_BYTES
            want, got = min(BLOCK_BYTES, size - at), 0
            while got < want and (n := os.preadv(file.fileno(), [buffer[got:want]], at + got)):
                got += n
            yield xxhash.xxh3_128_digest(buffer[:got])


def write_seal(log: Path, seal: Seal, *, overwrite: bool) -> bool:
    """Write a log's seal atomically; return False if an equal seal exists.

    Raises:
        OutputError: A different seal exists and ``overwrite`` is False, or it cannot be written.
    """
    path = seal_path(log)
    if path.exists() and not overwrite:
        try:
            kept = read_seal(path)
        except LogError as error:
            raise OutputError(f"{error}, or use --overwrite") from None
        if kept.files == seal.files:
            return False
        raise OutputError(
            f"{path}: the log differs from its seal of {kept.sealed_at}; see "
            f"'crosscue check {log}{SUFFIX}', and use --overwrite only if the log is correct"
        )
    from crosscue.replay.files.whole_file import write_text

    write_text(path, _as_text(seal))
    return True


def _as_text(seal: Seal) -> str:
    tree = {
        "kind": KIND,
        "version": VERSION,
        "hash": HASH,
        "block_bytes": BLOCK_BYTES,
        "sealed_at": seal.sealed_at,
        "files": [
            {"name": file.name, "size": file.size, "blocks": file.digests.hex()}
            for _, file in sorted(seal.files.items())
        ],
    }
    return strict_json(tree | {"check": _own_check(tree)}) + "\n"


def _own_check(tree: Mapping[str, Any]) -> str:
    """Return the hash of a seal's own content, which distinguishes its damage from the log's."""
    plain = json.dumps(tree, sort_keys=True, separators=(",", ":"))
    return str(xxhash.xxh3_128_hexdigest(plain.encode()))


def read_seal(path: Path) -> Seal:
    """Read and check a seal file.

    Raises:
        LogError: It cannot be read, is damaged, or is of another version.
    """
    try:
        raw = door.read(path, MAX_SEAL_BYTES)
    except OSError as error:
        raise LogError(f"{path}: {error.strerror or error}; check the path") from None
    try:
        tree = json_tree(raw)
    except (ValueError, RecursionError) as error:
        raise _unsound(path, f"not JSON: {one_line(error, 80)}") from None
    if not isinstance(tree, dict) or tree.get("kind") != KIND:
        raise _unsound(path, "not a seal")
    if tree.get("version") != VERSION or tree.get("hash") != HASH:
        raise _unsound(
            path,
            f"version {tree.get('version')!r:.20} with hash {tree.get('hash')!r:.20}; expected "
            f"{VERSION} with {HASH!r}",
        )
    check = tree.pop("check", None)
    try:
        if check != _own_check(tree) or tree["block_bytes"] != BLOCK_BYTES:
            raise _unsound(path, "its own checksum does not match")
        files = [_file_of(one) for one in tree["files"]]
        sealed_at = datetime.fromisoformat(tree["sealed_at"])
    except (KeyError, TypeError, ValueError, RecursionError) as error:
        raise _unsound(path, f"a wrong entry ({one_line(error, 80)})") from None
    if len({file.name for file in files}) != len(files):
        raise _unsound(path, "a file is listed twice")
    return Seal(sealed_at.strftime("%Y-%m-%dT%H:%M:%SZ"), {file.name: file for file in files})


def _unsound(path: Path, what: str) -> LogError:
    return LogError(f"{path}: damaged seal: {what}; delete it and seal the log again")


def _file_of(entry: Mapping[str, Any]) -> SealedFile:
    """Read the entry of a file.

    Raises:
        ValueError: The name leads out of the log, or the hashes do not match the size.
        KeyError: A field is missing.
        TypeError: A field has another type.
    """
    name, size = entry["name"], entry["size"]
    if not isinstance(name, str) or not isinstance(size, int):
        raise TypeError("name, size: expected text and an integer")
    parts = PurePosixPath(name).parts
    if name != THE_LOG and (
        not parts
        or name[0] == "/"
        or ".." in parts
        or "\0" in name
        or str(PurePosixPath(name)) != name
    ):
        raise ValueError(f"name {name!r:.40} leads out of the log")
    digests = bytes.fromhex(entry["blocks"])
    if size < 0 or len(digests) != _blocks_in(size) * DIGEST_BYTES:
        raise ValueError(f"{name!r:.40}: {len(digests)} bytes of hashes for {size} bytes")
    return SealedFile(name, size, digests)


def seal_over(log: Path) -> tuple[Path, Seal] | None:
    """Return path and content of a log's seal, or of the seal of a folder that contains the log.

    Raises:
        LogError: The seal is damaged.
    """
    # Called for every log that is opened; joining names as text is ten times as fast.
    place = os.path.abspath(log)  # noqa: PTH100
    if os.path.exists(place + SUFFIX):  # noqa: PTH110
        own = Path(place + SUFFIX)
        return own, read_seal(own)
    folder = os.path.dirname(place)  # noqa: PTH120
    while (above := os.path.dirname(folder)) != folder:  # noqa: PTH120
        if os.path.exists(folder + SUFFIX):  # noqa: PTH110
            seal = read_seal(Path(folder + SUFFIX))
            part = _part_of(seal, log, spelled(str(Path(place).relative_to(folder))))
            return None if part is None else (Path(folder + SUFFIX), part)
        folder = above
    return None


def _part_of(seal: Seal, log: Path, name: str) -> Seal | None:
    """Return the part of a folder's seal for one log in it, or None if it has no such part."""
    if log.is_dir():
        inside = name + "/"
        files = [
            replace(file, name=key.removeprefix(inside))
            for key, file in seal.files.items()
            if key.startswith(inside)
        ]
    elif name in seal.files:
        place = name[: -len(spelled(log.name))]
        beside = [place + other for other in files_of(log) if other != THE_LOG]
        files = [replace(seal.files[name], name=THE_LOG)]
        files += [
            replace(seal.files[key], name=key.removeprefix(place))
            for key in beside
            if key in seal.files
        ]
    else:
        files = []
    return Seal(seal.sealed_at, {file.name: file for file in files}) if files else None


class Check:
    """Check of a log's files against its seal, each block at most once.

    Attributes:
        checked: Number of blocks checked.
        oddities: Sentences about files that are missing, new, or of another size.
    """

    def __init__(self, log: Path, seal: Seal) -> None:
        """Compare the lists of files and their sizes.

        Raises:
            OSError: A folder cannot be listed.
        """
        self.seal: Final = seal
        self.checked = 0
        self._paths = files_of(log)
        self._names = {path: name for name, path in self._paths.items()}
        self._name = log.name
        self._seen: dict[str, set[int]] = {}
        self._bad: dict[str, set[int]] = {}
        self._sizes = {name: path.stat().st_size for name, path in self._paths.items()}
        self.oddities: Final = tuple(self._compared())

    def _compared(self) -> Iterator[str]:
        sealed, here = self.seal.files, self._sizes
        missing = [self.called(name) for name in sealed if name not in here]
        added = [self.called(name) for name in here if name not in sealed]
        if missing:
            yield f"missing: {_few(missing)}"
        if added:
            yield f"not in the seal: {_few(added)}"
        changed = [
            f"{self.called(name)} ({file.size} bytes when sealed, now {here[name]})"
            for name, file in sealed.items()
            if name in here and here[name] != file.size
        ]
        if changed:
            yield f"size changed: {_few(changed)}"

    def called(self, name: str) -> str:
        """Return a file's name for display."""
        return self._name if name == THE_LOG else name

    def named(self, path: Path) -> str | None:
        """Return the name in the seal of one of the log's files, or None for other files."""
        return self._names.get(path)

    def everything(self) -> Iterator[int]:
        """Check all remaining blocks, and yield the number of blocks checked so far."""
        for name, file in self.seal.files.items():
            yield from self.blocks(name, range(file.blocks))

    def blocks(self, name: str, blocks: Iterable[int]) -> Iterator[int]:
        """Check blocks of a file, except those beyond its end or checked before."""
        file = self.seal.files.get(name)
        if file is None or name not in self._sizes:
            return
        seen = self._seen.setdefault(name, set())
        there = min(file.blocks, _blocks_in(self._sizes[name]))
        wanted = [block for block in blocks if block < there and block not in seen]
        try:
            found = digests_of(self._paths[name], wanted, file.size)
            for block, digest in zip(wanted, found, strict=True):
                self._note(name, block, digest == file.digest(block))
                yield self.checked
        except OSError:
            # An unreadable block counts as changed; the reader reports the disk's error.
            for block in wanted:
                if block not in seen:
                    self._note(name, block, False)

    def _note(self, name: str, block: int, is_right: bool) -> None:
        self._seen[name].add(block)
        self.checked += 1
        if not is_right:
            self._bad.setdefault(name, set()).add(block)

    def damaged(self) -> Iterator[Span]:
        """Yield the spans that differ, with adjacent blocks as one span."""
        for name, bad in sorted(self._bad.items()):
            size = max(self.seal.files[name].size, 0)
            blocks = sorted(bad)
            first = blocks[0]
            for block, after in zip(blocks, [*blocks[1:], -1], strict=True):
                if after != block + 1:
                    stop = min((block + 1) * BLOCK_BYTES, size)
                    yield Span(self.called(name), first * BLOCK_BYTES, stop)
                    first = after


def _few(names: list[str]) -> str:
    rest = len(names) - _NAMES_SHOWN
    return ", ".join(names[:_NAMES_SHOWN]) + (f" and {rest} more" if rest > 0 else "")
