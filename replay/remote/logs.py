"""Logs on object stores, read in byte ranges or downloaded into a local store of limited size.

If an MCAP file or ROS 1 bag has an index that locates the requested part, only the index and that
part are fetched (``RangedLog``). Other logs are downloaded completely: a log that is read to its
end is often read twice, and some readers need a local file (SQLite, videos). Downloads are stored
under a name derived from the address and version, so that a changed object is downloaded again.
When the store exceeds its limit, the least recently used logs are removed, but never an open log.
Protocols and credentials are those of fsspec.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path, PurePosixPath
from typing import Any, BinaryIO, Final, Protocol, TypeVar, cast

from crosscue.replay.base import (
    EVERYTHING,
    Block,
    Closing,
    CrosscueError,
    KnowsItsEnd,
    Ledger,
    Limits,
    Log,
    LogError,
    LogTooLargeError,
    OutputError,
    Selection,
    Topic,
    UsageError,
    WrappedLog,
    cannot_write,
    door,
    is_remote,
    one_line,
)
from crosscue.replay.files.partial_file import is_still
from crosscue.replay.formats import known_formats

from .ranges import RangedFile, Spool

CHUNK_BYTES: Final = 8 << 20
VERSION_KEYS: Final = (
    "ETag",
    "etag",
    "version_id",
    "generation",
    "md5Hash",
    "LastModified",
    "Last-Modified",
    "last_modified",
    "mtime",
    "updated",
    "created",
)
"""Keys under which stores report the version of an object; the first one present is used."""
LOCK: Final = ".lock"
SIZE: Final = ".size"
STORE_VARIABLE: Final = "CROSSCUE_STORE"
LIMIT_VARIABLE: Final = "CROSSCUE_STORE_GIB"
LIMIT_GIB: Final = 50.0

T = TypeVar("T")


class _System(Protocol):
    """The part of fsspec's file system interface that is used here."""

    @property
    def protocol(self) -> str | tuple[str, ...]: ...
    def isdir(self, path: str) -> bool: ...
    def info(self, path: str) -> dict[str, Any]: ...
    def ls(self, path: str, *, detail: bool) -> list[dict[str, Any]]: ...
    def find(self, path: str, *, detail: bool) -> dict[str, dict[str, Any]]: ...
    def glob(self, path: str) -> list[str]: ...
    def open(self, path: str, mode: str, **how: str) -> BinaryIO: ...
    def invalidate_cache(self) -> None: ...


@dataclass(frozen=True, slots=True)
class Store:
    """The local store of downloaded logs.

    Attributes:
        folder: Folder with one subfolder per log.
        max_bytes: Maximum total size of the logs; a single larger log is refused.
    """

    folder: Path
    max_bytes: int


def default_store() -> Store:
    """Return the store that ``CROSSCUE_STORE`` and ``CROSSCUE_STORE_GIB`` configure.

    Raises:
        UsageError: The limit is not a positive number.
    """
    home = os.environ.get("XDG_CACHE_HOME") or str(Path("~/.cache").expanduser())
    folder = os.environ.get(STORE_VARIABLE) or str(Path(home, "crosscue", "logs"))
    text = os.environ.get(LIMIT_VARIABLE) or str(LIMIT_GIB)
    try:
        limit = round(float(text) * (1 << 30))
    except (ValueError, OverflowError):
        limit = 0
    if limit <= 0:
        raise UsageError(f"{LIMIT_VARIABLE}={text}: expected a number of GiB above 0")
    return Store(Path(folder), limit)


@dataclass(frozen=True, slots=True)
class _Object:
    """One object of a remote log: remote address, local name, size and version."""

    address: str
    name: str
    size: int
    version: str


class Fetched(Closing):
    """A local copy of a log, protected from removal until closed; a context manager."""

    def __init__(self, path: Path, hold: int | None) -> None:
        """Take ownership of the open and locked file ``hold``, if any."""
        self.path: Final = path
        self._hold: int | None = hold

    @property
    def is_in_place(self) -> bool:
        """True for a file of this machine, which did not need a download."""
        return self._hold is None

    def close(self) -> None:
        """Release the copy; it stays in the store until its space is needed."""
        if self._hold is not None:
            os.close(self._hold)
            self._hold = None


def fetch(url: str, store: Store | None = None) -> Fetched:
    """Return the local copy of a remote log, downloaded unless the store already has it.

    Raises:
        LogError: Missing, no permission, unknown protocol, changed during download, or
            unreachable.
        LogTooLargeError: Larger than the limit of the store.
        OutputError: The store cannot be written, or the disk is full.
    """
    system, address = _opened(url)
    if _is_local(system):
        return Fetched(Path(address), None)
    store = store or default_store()
    objects = _guarded(url, lambda: _objects(system, address))
    size = sum(one.size for one in objects)
    if size > store.max_bytes:
        raise LogTooLargeError(
            f"{url}: {size / 2**30:.1f} GiB, the store may hold {store.max_bytes / 2**30:.1f}; "
            f"set {LIMIT_VARIABLE}"
        )
    entry = store.folder / _key(url, objects)
    path = entry / "log" / PurePosixPath(address.rstrip("/")).name
    try:
        while True:
            hold = _locked(entry)
            try:
                if not path.exists():
                    _make_room(store, entry, size)
                    _download(url, system, address, objects, entry)
                os.utime(entry)
                # From an exclusive to a shared lock; another process may remove the entry between.
                fcntl.flock(hold, fcntl.LOCK_SH)
                if path.exists():
                    return Fetched(path, hold)
            except BaseException:
                os.close(hold)
                raise
            os.close(hold)
    except OSError as error:
        raise cannot_write(path, error) from None


def version_of(path: str) -> str:
    """Return the size and version of a file, folder or URL without reading its contents.

    Raises:
        LogError: It does not exist or cannot be examined.
    """
    if is_remote(path):
        system, address = _opened(path)
        if _is_local(system):
            return version_of(address)
        return _key(path, _guarded(path, lambda: _objects(system, address)))
    place = Path(path)
    try:
        if place.is_file():
            found = place.stat()
            return f"{found.st_size} {found.st_mtime_ns}"
        digest = hashlib.sha256()
        for entry in sorted(one for one in place.rglob("*") if one.is_file()):
            found = entry.stat()
            name = entry.relative_to(place).as_posix().encode(errors="surrogateescape")
            digest.update(name + f"\0{found.st_size} {found.st_mtime_ns}\0".encode())
        place.stat()
    except OSError as error:
        raise LogError(f"{path}: {error.strerror or error}; check the path") from None
    return digest.hexdigest()


def matches(pattern: str) -> tuple[str, ...]:
    """Return the URLs that match a pattern such as ``s3://bucket/drives/*.mcap``, sorted.

    Raises:
        LogError: The store cannot be queried.
    """
    system, address = _opened(pattern)
    found = _guarded(pattern, lambda: sorted(map(str, system.glob(address))))
    if _is_local(system):
        return tuple(found)
    scheme = pattern.partition("://")[0]
    return tuple(one if "://" in one else f"{scheme}://{one.lstrip('/')}" for one in found)


class RemoteLog(WrappedLog):
    """A downloaded log; closing it releases its local copy."""

    def __init__(
        self, url: str, log: Log, fetched: Fetched, why: str = "its format needs a local file"
    ) -> None:
        """Wrap ``log``, which was downloaded completely for the reason ``why``."""
        super().__init__(log)
        self._why: Final = why
        self.url: Final = url
        self._fetched: Final = fetched

    def read(self, ledger: Ledger, selection: Selection = EVERYTHING) -> Iterator[Block]:
        """Read the rows; see ``Log.read``."""
        if not self._fetched.is_in_place:
            ledger.notice(f"downloaded completely: {self._why}")
        return self._log.read(ledger, selection)

    def close(self) -> None:
        """Close the log and release its local copy."""
        try:
            super().close()
        finally:
            self._fetched.close()


class _Partial(Protocol):
    """A log that reports whether a part of it can be read without the rest."""

    @property
    def format(self) -> str: ...
    @property
    def topics(self) -> tuple[Topic, ...]: ...
    @property
    def beginning(self) -> Selection: ...
    def needs_whole(self, selection: Selection) -> str: ...
    def read(self, ledger: Ledger, selection: Selection = EVERYTHING) -> Iterator[Block]: ...
    def close(self) -> None: ...


RANGED: Final = {
    ".mcap": "crosscue.replay.readers.mcap.reader:open_ranged",
    ".bag": "crosscue.replay.readers.rosbag1.reader:open_ranged",
}
"""Openers of the formats that can be read in byte ranges."""


class RangedLog(Closing):
    """A remote log that fetches only the requested parts, or all of it when all is requested."""

    def __init__(
        self, url: str, log: _Partial, ranged: RangedFile, whole: Callable[[str], RemoteLog]
    ) -> None:
        """Wrap ``log``, which is read in byte ranges; ``whole`` downloads the complete log."""
        self.url: Final = url
        self.ranged: Final = ranged
        self._log: Final = log
        self._fetch: Final = whole
        self._whole: RemoteLog | None = None

    @property
    def path(self) -> Path:
        """Path of a local copy; reading it downloads the complete log."""
        return self._fetched("its local path was requested").path

    @property
    def format(self) -> str:
        """Format of the log."""
        return self._log.format

    @property
    def topics(self) -> tuple[Topic, ...]:
        """Topics of the log."""
        return self._log.topics if self._whole is None else self._whole.topics

    def read(self, ledger: Ledger, selection: Selection = EVERYTHING) -> Iterator[Block]:
        """Read the rows and verify at the end that the object has not changed since it was opened.

        Raises:
            LogError: The object has changed, or cannot be reached.
        """
        why = self._log.needs_whole(selection)
        if why or self._whole is not None:
            yield from self._fetched(why).read(ledger, selection)
            return
        before = self.ranged.transferred
        yield from self._log.read(ledger, selection)
        self.ranged.verify()
        took = self.ranged.transferred - before
        ledger.notice(f"{took} of {self.ranged.size} bytes were fetched")

    def report_missing(self, ledger: Ledger) -> None:
        """Report missing rows; see ``KnowsItsEnd``."""
        if isinstance(self._log, KnowsItsEnd):
            self._log.report_missing(ledger)

    def first_blocks(self, ledger: Ledger) -> Iterator[Block]:
        """Read only the first chunk, for callers that need only the beginning."""
        return self.read(ledger, self._log.beginning)

    def close(self) -> None:
        """Close the connection and release the local copy."""
        try:
            self._log.close()
            self.ranged.close()
        finally:
            if self._whole is not None:
                self._whole.close()

    def _fetched(self, why: str) -> RemoteLog:
        if self._whole is None:
            self._whole = self._fetch(why)
        return self._whole


def open_remote(
    url: str, opener: Callable[[Path], Log], limits: Limits, store: Store | None = None
) -> RemoteLog | RangedLog:
    """Open a log in byte ranges if its format and index allow it; else download it first.

    Args:
        url: Address of the log.
        opener: Opens the local copy.
        limits: Maximum sizes that the reader accepts.
        store: Local store; None for the configured one.

    Raises:
        CrosscueError: As raised by ``fetch`` and ``opener``.
    """

    def whole(why: str) -> RemoteLog:
        fetched = fetch(url, store)
        try:
            return RemoteLog(url, opener(fetched.path), fetched, why)
        except BaseException:
            fetched.close()
            raise

    system, address = _opened(url)
    suffix = PurePosixPath(address).suffix.lower()
    if _is_local(system) or suffix not in RANGED:
        return whole("its format is read from a local file")
    ranged = _ranged(url, system, address, store or default_store())
    if ranged is None:
        return whole("its store does not support range requests")
    module, _, function = RANGED[suffix].partition(":")
    open_ranged = cast(
        "Callable[[Path, RangedFile, Limits], _Partial | None]",
        getattr(import_module(module), function),
    )
    try:
        log = open_ranged(Path(PurePosixPath(address).name), ranged, limits)
    except BaseException:
        ranged.close()
        raise
    if log is None:
        ranged.close()
        return whole("it has no usable index")
    return RangedLog(url, log, ranged, whole)


def by_ranges(url: str) -> RangedFile | None:
    """Open a remote log in byte ranges; return None if it must be downloaded completely.

    Raises:
        LogError: As raised by ``fetch``.
    """
    system, address = _opened(url)
    if _is_local(system) or PurePosixPath(address).suffix.lower() not in RANGED:
        return None
    return _ranged(url, system, address, default_store())


class RemoteFiles:
    """The files of a remote log as listed by its store; none of them is downloaded.

    Attributes:
        sizes: Sizes in bytes by the name that the file has in a local copy.
    """

    def __init__(self, url: str) -> None:
        """Query the store for the log's files.

        Raises:
            LogError: As raised by ``fetch``.
        """
        self._url: Final = url
        self._store: Final = default_store()
        self._system, self._address = _opened(url)
        self._objects: Final = (
            []
            if _is_local(self._system)
            else _guarded(url, lambda: _objects(self._system, self._address))
        )
        self.sizes: Final = {one.name: one.size for one in self._objects}

    @property
    def is_at_hand(self) -> bool:
        """True if ``fetch`` needs no download, because the log is already on this machine."""
        entry = self._store.folder / _key(self._url, self._objects)
        return not self._objects or (entry / "log").exists()

    def ranged(self, name: str) -> RangedFile | None:
        """Open one of the files in byte ranges; None if the store does not support them.

        Raises:
            LogError: As raised by ``fetch``.
        """
        address = next(one.address for one in self._objects if one.name == name)
        return _ranged(self._url, self._system, address, self._store)


def _ranged(url: str, system: _System, address: str, store: Store) -> RangedFile | None:
    """Open an object in byte ranges; None if it is not a single object of known size."""
    info = _guarded(url, lambda: system.info(address))
    if info.get("type") == "directory" or not info.get("size") or info.get("partial") is False:
        return None
    name = PurePosixPath(address.rstrip("/")).name
    reported = _object(name, info)

    def changed() -> bool:
        system.invalidate_cache()
        return _object(name, system.info(address)) != reported

    def opened() -> BinaryIO:
        return system.open(address, "rb", cache_type="none")

    return RangedFile(url, reported.size, opened, changed, Spool(store.folder, store.max_bytes))


def _opened(url: str) -> tuple[_System, str]:
    try:
        url_to_fs = import_module("fsspec.core").url_to_fs
    except ImportError:
        raise LogError(
            f"{url}: reading from object stores needs fsspec; pip install fsspec"
        ) from None
    try:
        system, address = url_to_fs(url)
    except (ImportError, ValueError) as error:
        raise LogError(f"{url}: {one_line(error)}") from None
    return cast("_System", system), str(address)


def _is_local(system: _System) -> bool:
    return "file" in ([system.protocol] if isinstance(system.protocol, str) else system.protocol)


def _guarded(url: str, ask: Callable[[], T]) -> T:
    """Return ``ask()`` and convert any error of a store's library to a ``LogError``."""
    try:
        return ask()
    except CrosscueError:
        raise
    except FileNotFoundError:
        raise LogError(f"{url}: no such object; check the address") from None
    except PermissionError as error:
        raise LogError(f"{url}: no permission ({one_line(error)}); check credentials") from None
    except Exception as error:
        kind = type(error).__name__
        raise LogError(f"{url}: cannot be read ({kind}: {one_line(error)}); try again") from None


def _objects(system: _System, address: str) -> list[_Object]:
    """List the objects of a log: all objects below a folder, or those that share a file's stem."""
    address = address.rstrip("/")
    name = PurePosixPath(address).name
    if _is_folder(system, address):
        found = system.find(address, detail=True).values()
        start = len(address) + 1
        named = [(f"{name}/{str(info['name'])[start:]}", info) for info in found]
    else:
        alone = system.info(address)
        try:
            around = system.ls(address[: len(address) - len(name)] or address, detail=True)
        except (OSError, ValueError):  # a plain web server may have no listing
            around = [alone | {"name": address}]
        around = [one for one in around if _belongs(PurePosixPath(str(one["name"])).name, name)]
        # A web server's listing has no sizes.
        around = [
            one if one.get("size") is not None else system.info(str(one["name"])) for one in around
        ] or [alone | {"name": address}]
        named = [(PurePosixPath(str(info["name"])).name, info) for info in around]
        named = [(other, info) for other, info in named if _belongs(other, name)]
    return sorted((_object(other, info) for other, info in named), key=lambda one: one.name)


def _is_folder(system: _System, address: str) -> bool:
    """Return whether an address is a folder.

    On a web server, every address is both a file and a folder, and ``isdir`` downloads the file.
    Addresses with the suffix of a known format are therefore checked with ``info``.
    """
    suffix = PurePosixPath(address).suffix.lower()
    if any(suffix in known.suffixes for known in known_formats().values()):
        try:
            return system.info(address).get("type") == "directory"
        except FileNotFoundError:
            return system.isdir(address)
    return system.isdir(address)


def _belongs(other: str, name: str) -> bool:
    """Return whether ``other`` is the log itself, its time file, index or write-ahead log."""
    stem = PurePosixPath(name).stem
    return other == name or other.startswith((f"{stem}.", f"{name}-"))


def _object(name: str, info: dict[str, Any]) -> _Object:
    if any(part in ("", ".", "..") for part in name.split("/")) or "\0" in name:
        raise LogError(f"{info['name']}: not a valid file name; rename the object")
    version = next((str(info[key]) for key in VERSION_KEYS if info.get(key) is not None), "")
    return _Object(str(info["name"]), name, int(info["size"]), version)


def _key(url: str, objects: Sequence[_Object]) -> str:
    """Return a name derived from a log's address and version."""
    digest = hashlib.sha256(url.encode())
    for one in objects:
        digest.update(f"\0{one.name}\0{one.size}\0{one.version}".encode())
    return digest.hexdigest()[:32]


def _locked(entry: Path) -> int:
    """Wait for an exclusive lock on an entry, and return its open lock file."""
    while True:
        entry.mkdir(parents=True, exist_ok=True)
        with suppress(FileNotFoundError):
            hold = door.opened(entry / LOCK, os.O_CREAT | os.O_RDWR)
            fcntl.flock(hold, fcntl.LOCK_EX)
            if is_still(hold, entry / LOCK):
                return hold
            os.close(hold)


def _make_room(store: Store, entry: Path, size: int) -> None:
    """Reserve ``size`` bytes for an entry; remove the least recently used entries as needed.

    Raises:
        OutputError: The entries in use leave too little space.
    """
    gate = door.opened(store.folder / LOCK, os.O_CREAT | os.O_RDWR)
    try:
        fcntl.flock(gate, fcntl.LOCK_EX)
        others = [one for one in store.folder.iterdir() if one.is_dir() and one != entry]
        held = {one: _reserved(one) for one in others}
        for one in sorted(others, key=_last_used):
            if sum(held.values()) + size <= store.max_bytes:
                break
            if _removed(one):
                del held[one]
        if sum(held.values()) + size > store.max_bytes:
            raise OutputError(
                f"{store.folder}: full of logs in use ({sum(held.values()) >> 20} MiB); use fewer "
                f"workers or set {LIMIT_VARIABLE}"
            )
        entry.joinpath(SIZE).write_text(str(size))
    finally:
        os.close(gate)


def _reserved(entry: Path) -> int:
    try:
        return int(door.read(entry / SIZE, 64))
    except (OSError, ValueError):
        return 0


def _last_used(entry: Path) -> int:
    try:
        return entry.stat().st_mtime_ns
    except FileNotFoundError:
        return 0


def _removed(entry: Path) -> bool:
    """Remove an entry unless it is in use; return whether it was removed."""
    try:
        hold = door.opened(entry / LOCK, os.O_RDWR)
    except FileNotFoundError:
        shutil.rmtree(entry, ignore_errors=True)
        return not entry.exists()
    try:
        fcntl.flock(hold, fcntl.LOCK_EX | fcntl.LOCK_NB)
        # Renamed first, so that another process starts over instead of finding a partial entry.
        gone = entry.with_name(f".{entry.name}.{os.getpid()}")
        entry.replace(gone)
        shutil.rmtree(gone)
    except BlockingIOError:
        return False
    finally:
        os.close(hold)
    return True


def _download(
    url: str, system: _System, address: str, objects: Sequence[_Object], entry: Path
) -> None:
    partial = entry / "partial"
    shutil.rmtree(partial, ignore_errors=True)
    try:
        for one in objects:
            target = partial / one.name
            target.parent.mkdir(parents=True, exist_ok=True)
            with target.open("wb") as file:
                for chunk in _chunks(url, system, one):
                    file.write(chunk)
                file.flush()
                os.fsync(file.fileno())
        system.invalidate_cache()
        if _guarded(url, lambda: _objects(system, address)) != list(objects):
            raise LogError(f"{url}: changed while it was fetched; run again when it is written")
        partial.replace(entry / "log")
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        raise


def _chunks(url: str, system: _System, one: _Object) -> Iterator[bytes]:
    """Yield an object's bytes and check that their number equals the listed size."""
    source = _guarded(url, lambda: system.open(one.address, "rb"))
    left = one.size
    with source:
        while chunk := _guarded(url, lambda: bytes(source.read(CHUNK_BYTES))):
            left -= len(chunk)
            if left < 0:
                break
            yield chunk
    if left:
        raise LogError(f"{url}: {one.name} is not as long as its store reports; run again")
