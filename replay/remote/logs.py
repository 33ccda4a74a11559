"""Logs on object stores, read in byte ranges or downloaded into a local store of limited size.

If an MCAP file or ROS 1 bag has an index that locates the requested part, only the index and that
part are fetched (``RangedLog``). Other logs are downloaded completely: a log that is read to its
end is often read twice, and some readers need a local file (SQLite, videos). Downloads are stored
under a name derived from the address and version, so that a changed object is downloaded again.
When the store exceeds its limit, the least recently used logs are removed, but never an open log.
Protocols and credentials are those of fsspec. An object's suffix is that of its URL's path, and an
unknown one is refused before anything is fetched.
"""

import fcntl
import hashlib
import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path, PurePosixPath
from typing import Any, BinaryIO, Final, Protocol, TypeVar, cast

from crosscue.replay.base import (
    EVERYTHING,
    KnowsItsEnd,
    KnowsItsStart,
    Log,
    Selection,
    WrappedLog,
    first_stored_ns,
)
from crosscue.replay.columns import Block, Topic
from crosscue.replay.errors import (
    CrosscueError,
    LogError,
    LogTooLargeError,
    OutputError,
    UsageError,
    one_line,
)
from crosscue.replay.files import door
from crosscue.replay.files.closing import Closing
from crosscue.replay.files.partial_file import is_still
from crosscue.replay.files.whole_file import cannot_write
from crosscue.replay.formats import has_known_suffix, unknown_format
from crosscue.replay.ledger import Ledger
from crosscue.replay.limits import Limits

from .address import LogAddress
from .ranges import RangedFile, Spool, answered

CHUNK_BYTES: Final = 4 << 20
# Keys under which stores report the version of an object; the first one present is used.
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
    folder = os.environ.get(STORE_VARIABLE) or door.user_cache(STORE_VARIABLE) / "logs"
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

    address: str = field(repr=False)
    name: str
    size: int
    version: str


class FetchedLog(Closing):
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


def fetch_log(url: str, store: Store | None = None) -> FetchedLog:
    """Return the local copy of a remote log, downloaded unless the store already has it.

    Raises:
        LogError: Missing, no permission, unknown protocol, changed during download, or
            unreachable.
        LogTooLargeError: Larger than the limit of the store.
        OutputError: The store cannot be written, or the disk is full.
    """
    url, system, address = opened_store(url)
    if _is_local(system):
        return FetchedLog(Path(address), None)
    store = store or default_store()
    objects = guarded(url, lambda: _objects(system, address, url))
    size = sum(one.size for one in objects)
    if size > store.max_bytes:
        raise LogTooLargeError(
            f"{url}: {size / 2**30:.1f} GiB, the store may hold {store.max_bytes / 2**30:.1f}; "
            f"set {LIMIT_VARIABLE}"
        )
    entry = store.folder / _key(url, objects)
    path = entry / "log" / url.name
    try:
        while True:
            # Shared, as by other users of the log: they keep it open for as long as they read.
            hold = _locked(entry, fcntl.LOCK_SH)
            if path.exists():
                os.utime(entry)
                return FetchedLog(path, hold)
            os.close(hold)
            hold = _locked(entry, fcntl.LOCK_EX)
            try:
                if not path.exists():
                    _make_room(store, entry, size)
                    _download(url, system, address, objects, entry)
                os.utime(entry)
                # From an exclusive to a shared lock; another process may remove the entry between.
                fcntl.flock(hold, fcntl.LOCK_SH)
                if path.exists():
                    return FetchedLog(path, hold)
            except BaseException:
                os.close(hold)
                raise
            os.close(hold)
    except OSError as error:
        raise cannot_write(path, error) from None


def matches(pattern: str) -> tuple[str, ...]:
    """Return the URLs that match a pattern such as ``s3://bucket/drives/*.mcap``, sorted.

    Raises:
        LogError: The store cannot be queried.
    """
    url, system, address = opened_store(pattern)
    names = address.partition("?")[0] if url.has_query else address
    found = guarded(url, lambda: sorted(map(str, system.glob(names))))
    if _is_local(system):
        return tuple(found)
    scheme = url.partition("://")[0]
    return tuple(url.at(one if "://" in one else f"{scheme}://{one.lstrip('/')}") for one in found)


class RemoteLog(WrappedLog):
    """A downloaded log; closing it releases its local copy."""

    def __init__(
        self, url: str, log: Log, fetched: FetchedLog, why: str = "its format needs a local file"
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


class _Partial(Log, Protocol):
    """A log that reports whether a part of it can be read without the rest."""

    @property
    def beginning(self) -> Selection: ...
    def needs_whole(self, selection: Selection) -> str: ...


# Openers of the formats that can be read in byte ranges.
RANGED: Final = {
    ".mcap": "crosscue.replay.readers.mcap.reader:open_remote_mcap",
    ".bag": "crosscue.replay.readers.rosbag1.reader:open_remote_bag",
}


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
        yield from self._log.read(ledger, selection)
        self.ranged.verify()
        # With those for the index, and those of earlier passes, which are not fetched again.
        ledger.notice(f"{self.ranged.transferred} of {self.ranged.size} bytes were fetched")

    def report_missing(self, ledger: Ledger) -> None:
        """Report missing rows; see ``KnowsItsEnd``."""
        if isinstance(self._log, KnowsItsEnd):
            self._log.report_missing(ledger)

    def start_ns(self) -> int | None:
        """Return the log time of the first stored row, from the index or the first chunk."""
        known = self._log.start_ns() if isinstance(self._log, KnowsItsStart) else None
        if known is not None:
            return known
        return first_stored_ns(self.read(Ledger(self.url), self._log.beginning))

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
        CrosscueError: As raised by ``fetch_log`` and ``opener``.
    """
    url, system, address = opened_store(url)

    def whole(why: str) -> RemoteLog:
        fetched = fetch_log(url, store)
        try:
            return RemoteLog(url, opener(fetched.path), fetched, why)
        except BaseException:
            fetched.close()
            raise

    suffix = PurePosixPath(url.name).suffix.lower()
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
        log = open_ranged(Path(url.name), ranged, limits)
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
        LogError: As raised by ``fetch_log``.
    """
    url, system, address = opened_store(url)
    if _is_local(system) or PurePosixPath(url.name).suffix.lower() not in RANGED:
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
            LogError: As raised by ``fetch_log``.
        """
        self._store: Final = default_store()
        self._url, self._system, self._address = opened_store(url)
        self._objects: Final = (
            []
            if _is_local(self._system)
            else guarded(self._url, lambda: _objects(self._system, self._address, self._url))
        )
        self.sizes: Final = {one.name: one.size for one in self._objects}

    @property
    def is_at_hand(self) -> bool:
        """True if ``fetch_log`` needs no download, because the log is already on this machine."""
        entry = self._store.folder / _key(self._url, self._objects)
        return not self._objects or (entry / "log").exists()

    def ranged(self, name: str) -> RangedFile | None:
        """Open one of the files in byte ranges; None if the store does not support them.

        Raises:
            LogError: As raised by ``fetch_log``.
        """
        address = next(one.address for one in self._objects if one.name == name)
        return _ranged(self._url, self._system, address, self._store)


def _ranged(url: LogAddress, system: _System, address: str, store: Store) -> RangedFile | None:
    """Open an object in byte ranges; None if it is not a single object of known size."""
    info = guarded(url, lambda: system.info(address))
    if info.get("type") == "directory" or not info.get("size") or info.get("partial") is False:
        return None
    reported = _object(url.name, info)

    def changed() -> bool:
        system.invalidate_cache()
        return _object(url.name, system.info(address)) != reported

    def opened() -> BinaryIO:
        return system.open(address, "rb", cache_type="none")

    return RangedFile(url, reported.size, opened, changed, Spool(store.folder, store.max_bytes))


def opened_store(url: str) -> tuple[LogAddress, _System, str]:
    """Return an address, its store, and the address in the store, which may hold secrets."""
    url = LogAddress(url)
    url_to_fs = import_module("fsspec.core").url_to_fs
    system, address = guarded(url, lambda: url_to_fs(url.with_secrets()))
    return url, cast("_System", system), str(address)


def _is_local(system: _System) -> bool:
    return "file" in ([system.protocol] if isinstance(system.protocol, str) else system.protocol)


def guarded(url: LogAddress, ask: Callable[[], T]) -> T:
    """Return ``ask()`` and convert any error of a store's library to a ``LogError``."""
    try:
        return answered(url, ask)
    except CrosscueError:
        raise
    except Exception as error:
        line = url.hide(f"{type(error).__name__}: {one_line(error)}")
        # The web's store calls every failure a missing file; the cause has the server's status.
        status = getattr(error.__cause__, "status", None)
        if isinstance(error, PermissionError) or status in (401, 403):
            why = f"no permission ({status or line}); check credentials"
        elif isinstance(error, FileNotFoundError):
            why = "no such object; check the address"
        else:
            why = f"cannot be read ({line}); try again"
    # Raised here, so that it does not carry the library's error, whose text may hold secrets.
    raise LogError(f"{url}: {why}")


def _objects(system: _System, address: str, url: LogAddress) -> list[_Object]:
    """List the objects of a log: all objects below a folder, or those that share a file's stem.

    Raises:
        UnknownFormatError: It is a file of an unknown suffix.
    """
    address = address.rstrip("/")
    if _is_folder(system, address, url):
        found = system.find(address, detail=True).values()
        start = len(address) + 1
        named = [(f"{url.name}/{str(info['name'])[start:]}", info) for info in found]
    else:
        if not has_known_suffix(url.name):
            raise unknown_format(url)
        named = [(url.name, system.info(address) | {"name": address})]
        around: list[dict[str, Any]] = []
        with suppress(Exception):  # a web server may have no listing, or forbid it
            around = [] if url.has_query else system.ls(address[: -len(url.name)], detail=True)
        for one in around:
            if _belongs(name := PurePosixPath(str(one["name"])).name, url.name):
                # A web server's listing has no sizes.
                known = one.get("size") is not None
                named.append((name, one if known else system.info(str(one["name"]))))
    return sorted((_object(name, info) for name, info in named), key=lambda one: one.name)


def _is_folder(system: _System, address: str, url: LogAddress) -> bool:
    """Return whether an address is a folder. A web server has none: ``isdir`` fetches the file."""
    if url.startswith(("http://", "https://")):
        return False
    try:
        return system.info(address).get("type") == "directory"
    except FileNotFoundError:
        return system.isdir(address)


def _belongs(other: str, name: str) -> bool:
    """Return whether ``other`` is the log's time file, index or write-ahead log."""
    return other != name and other.startswith((f"{PurePosixPath(name).stem}.", f"{name}-"))


def _object(name: str, info: dict[str, Any]) -> _Object:
    if any(part in ("", ".", "..") for part in name.split("/")) or "\0" in name:
        raise LogError(f"{name}: not a valid file name; rename the object")
    version = next((str(info[key]) for key in VERSION_KEYS if info.get(key) is not None), "")
    return _Object(str(info["name"]), name, int(info["size"]), version)


def _key(url: LogAddress, objects: Sequence[_Object]) -> str:
    """Return a name derived from a log's address and version.

    A new signature of the same object does not change it. Only where the store reports no version
    may the query tell objects apart.
    """
    digest = hashlib.sha256(url.encode())
    if not all(one.version for one in objects):
        digest.update(url.with_secrets().partition("?")[2].encode())
    for one in objects:
        digest.update(f"\0{one.name}\0{one.size}\0{one.version}".encode())
    return digest.hexdigest()[:32]


def _locked(entry: Path, how: int) -> int:
    """Wait for a lock on an entry, and return its open lock file."""
    while True:
        entry.mkdir(parents=True, exist_ok=True)
        with suppress(FileNotFoundError):
            hold = door.opened(entry / LOCK, os.O_CREAT | os.O_RDWR)
            fcntl.flock(hold, how)
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
    url: LogAddress, system: _System, address: str, objects: Sequence[_Object], entry: Path
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
        if guarded(url, lambda: _objects(system, address, url)) != list(objects):
            raise LogError(f"{url}: changed while it was fetched; run again when it is written")
        partial.replace(entry / "log")
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        raise


def _chunks(url: LogAddress, system: _System, one: _Object) -> Iterator[bytes]:
    """Yield an object's bytes and check that their number equals the listed size."""
    source = guarded(url, lambda: system.open(one.address, "rb", cache_type="none"))
    left = one.size
    with source:
        while chunk := guarded(url, lambda: bytes(source.read(CHUNK_BYTES))):
            left -= len(chunk)
            if left < 0:
                break
            yield chunk
    if left:
        raise LogError(f"{url}: {one.name} is not as long as its store reports; run again")
