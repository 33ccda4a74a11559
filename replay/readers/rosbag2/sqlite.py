"""Opening of a SQLite file as its recorder left it, without changing the user's folder.

* A write-ahead log is read with the file. Its index is in memory instead of in a ``-shm`` file
  (exclusive locking mode on SQLite's VFS without locks).
* A hot rollback journal (the recorder died inside a transaction) is applied to a temporary copy.
* The path is percent-encoded in the URI, so that ``run%41.db3`` opens the file of that name.
"""

import os
import shutil
import sqlite3
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final
from urllib.parse import quote

from crosscue.replay.errors import LogError, LogFormatError
from crosscue.replay.files.partial_file import Scratch
from crosscue.replay.limits import MIB, Limits

from .wal import check_wal

SQLITE_MAGIC: Final = b"SQLite format 3\x00"
# Exceptions of the standard library for damaged files, including invalid UTF-8 in messages.
FAULTS: Final = (sqlite3.Error, UnicodeError, ValueError, OverflowError, MemoryError)

_WAL_VERSION: Final = 2
_WAIT_S: Final = 1.0
_GUARD_EVERY: Final = 100_000
_STEPS_PER_BYTE: Final = 40
_STEPS_AT_LEAST: Final = 100_000_000
_SETTINGS: Final = (
    # Allows SQLite to open a file that is shorter than its header states; nothing is written. It
    # must come first, because the others read the schema.
    "writable_schema=ON",
    "trusted_schema=OFF",
    "cell_size_check=ON",
    "cache_size=-200",
)


@dataclass(slots=True)
class Database:
    """An open, read-only database.

    Attributes:
        connection: Connection that returns text as ``str``, with invalid UTF-8 escaped.
        notices: Notices on the opening, for the ledger.
        copy: Folder of the temporary copy, or None.
        damage: Description of the missing data, or empty.
        plain: The file if it is complete and has no journal, else None.
    """

    connection: sqlite3.Connection
    notices: list[str] = field(default_factory=list)
    copy: Scratch | None = None
    damage: str = ""
    plain: Path | None = None

    def close(self) -> None:
        """Close the database and remove the temporary copy."""
        self.connection.close()
        if self.copy is not None:
            self.copy.close()


def beside(path: Path, suffix: str) -> Path:
    """Return the path of SQLite's companion file of ``path``, such as ``-wal``."""
    return path.with_name(path.name + suffix)


def open_database(path: Path, limits: Limits) -> Database:
    """Open ``path`` for reading.

    Raises:
        LogFormatError: Not a SQLite file.
        LogError: SQLite cannot open it; the message states the remedy.
        OSError: The file cannot be read, or a temporary copy cannot be written.
    """
    with path.open("rb") as file:
        head = file.read(100)
    if head[:16] != SQLITE_MAGIC:
        raise LogFormatError(
            f"{path}: begins with {head[:16]!r}, expected {SQLITE_MAGIC!r} (a SQLite file); "
            "check the file"
        )
    try:
        return _opened(path, head, limits)
    except FAULTS as error:
        raise LogError(f"{path}: {explained(error)}") from None


def explained(error: Exception) -> str:
    """Describe an error of SQLite and its remedy."""
    name = getattr(error, "sqlite_errorname", "")
    if name.startswith(("SQLITE_BUSY", "SQLITE_LOCKED")):
        return "locked by another program; stop the recorder, or copy the file and read the copy"
    if name.startswith(("SQLITE_CORRUPT", "SQLITE_NOTADB")):
        return f"damaged ({error}); 'sqlite3 FILE .recover' may recover more"
    if name.startswith("SQLITE_INTERRUPT"):
        return "damaged: reading it takes more steps than its size allows"
    if isinstance(error, UnicodeError):
        return "damaged in its table of tables; 'sqlite3 FILE .recover' may recover some data"
    return f"SQLite cannot read it: {error}"


def _opened(path: Path, head: bytes, limits: Limits) -> Database:
    is_wal = _WAL_VERSION in head[18:20]
    if is_wal and _has_bytes(beside(path, "-wal")):
        connection = _connect(path, "mode=ro&vfs=unix-none", limits, "locking_mode=EXCLUSIVE")
        said = "the recorder did not close it: its write-ahead log was read with it"
        return Database(connection, [said], damage=_wal_damage(beside(path, "-wal")))
    missing, torn = _missing_bytes(head, path)
    if missing and torn:
        return _copy_without_torn_page(path, torn, missing, limits)
    try:
        connection = _connect(path, "immutable=1" if is_wal else "mode=ro", limits)
    except FAULTS:
        if _has_bytes(beside(path, "-journal")):
            return _repaired_copy(path, limits)
        raise
    return Database(connection, damage=_shortfall(missing), plain=path)


def _shortfall(missing: int) -> str:
    return f"{missing} bytes fewer than its header states" if missing else ""


def _wal_damage(path: Path) -> str:
    """Return why SQLite cannot read committed rows of a write-ahead log, or empty."""
    state = check_wal(path)
    if state is None:
        return "the write-ahead log's header is damaged, so the log cannot be read"
    if state.has_lost_commit:
        return f"the write-ahead log is damaged at frame {state.sound + 1} of {state.frames}"
    return ""


def _missing_bytes(head: bytes, path: Path) -> tuple[int, int]:
    """Return the bytes missing for the header's page count, and the bytes of a truncated page.

    See section 1.3 of SQLite's file format description.
    """
    page_bytes = int.from_bytes(head[16:18], "big")
    page_bytes = 65536 if page_bytes == 1 else page_bytes
    if page_bytes < 512 or head[24:28] != head[92:96]:
        return 0, 0
    size = path.stat().st_size
    missing = int.from_bytes(head[28:32], "big") * page_bytes - size
    return max(0, missing), size % page_bytes


def _has_bytes(path: Path) -> bool:
    try:
        return path.stat().st_size > 0
    except OSError:
        return False


def _connect(path: Path, options: str, limits: Limits, *first: str) -> sqlite3.Connection:
    """Connect, with the settings ``first`` before all others, and read the schema once."""
    place = quote(os.fsencode(path.absolute()))
    connection = sqlite3.connect(
        f"file:{place}?{options}",
        uri=True,
        isolation_level=None,
        check_same_thread=False,
        timeout=_WAIT_S,
    )
    try:
        connection.text_factory = _text
        connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, limits.message_bytes + MIB)
        for setting in (*first, *_SETTINGS):
            connection.execute(f"PRAGMA {setting}")
        _guard(connection, path)
        connection.execute("SELECT count(*) FROM sqlite_master").fetchone()
    except BaseException:
        connection.close()
        raise
    return connection


def _text(raw: bytes) -> str:
    return raw.decode("utf-8", "backslashreplace")


def _guard(connection: sqlite3.Connection, path: Path) -> None:
    """Limit the number of steps, because pages of a damaged file may refer to each other."""
    size = path.stat().st_size + (
        beside(path, "-wal").stat().st_size if beside(path, "-wal").exists() else 0
    )
    left = (size * _STEPS_PER_BYTE + _STEPS_AT_LEAST) // _GUARD_EVERY

    def is_over() -> bool:
        nonlocal left
        left -= 1
        return left < 0

    connection.set_progress_handler(is_over, _GUARD_EVERY)


def _repaired_copy(path: Path, limits: Limits) -> Database:
    """Open a copy in which SQLite undoes the recorder's unfinished transaction."""
    journal = beside(path, "-journal")
    folder = _room_for_copy(path, path.stat().st_size + journal.stat().st_size)
    try:
        copy = folder.path / "copy.db3"
        shutil.copyfile(path, copy)
        shutil.copyfile(journal, beside(copy, "-journal"))
        connection = _connect(copy, "mode=rw", limits)
    except BaseException:
        folder.close()
        raise
    said = (
        "the recorder died while writing: its unfinished transaction was undone in a temporary "
        "copy; the file itself is unchanged"
    )
    return Database(connection, [said], folder)


def _copy_without_torn_page(path: Path, torn: int, missing: int, limits: Limits) -> Database:
    """Open a copy that ends with a complete page, because SQLite pads a partial page with zeros."""
    folder = _room_for_copy(path, path.stat().st_size)
    try:
        copy = folder.path / "copy.db3"
        shutil.copyfile(path, copy)
        os.truncate(copy, path.stat().st_size - torn)
        connection = _connect(copy, "immutable=1", limits)
    except BaseException:
        folder.close()
        raise
    said = "the file ends inside a page: its complete pages were read from a temporary copy"
    return Database(connection, [said], folder, _shortfall(missing))


def _room_for_copy(path: Path, size: int) -> Scratch:
    folder = Scratch()
    free = shutil.disk_usage(folder.path).free
    if free < size + 64 * MIB:
        folder.close()
        raise LogError(
            f"{path}: needs a temporary copy to be repaired in: {size} bytes in "
            f"{folder.path.parent}, free are {free}; set TMPDIR to a larger disk"
        )
    return folder
