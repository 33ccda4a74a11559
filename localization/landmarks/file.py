"""The SQLite file of a landmark database: its tables, and checks when it is opened.

A file is rejected unless it has crosscue's ``application_id``, this version as ``user_version``,
the length that its header specifies, and exactly the expected tables.
"""

from __future__ import annotations

import errno
import os
import sqlite3
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final
from urllib.parse import quote

from crosscue.replay.errors import LogError, LogFormatError, OutputError
from crosscue.replay.files.whole_file import cannot_write

# ``CCLM`` in the file's header.
APPLICATION_ID: Final = 0x43434C4D
VERSION: Final = 1
_MAX_BYTES: Final = 16 << 20
_BUSY_S: Final = 5.0
_HEADER: Final = b"SQLite format 3\0"

TABLES: Final = (
    "CREATE TABLE setting (key TEXT PRIMARY KEY, value TEXT NOT NULL) WITHOUT ROWID",
    "CREATE TABLE landmark (id INTEGER PRIMARY KEY, name TEXT NOT NULL UNIQUE, "
    "x_m REAL NOT NULL, y_m REAL NOT NULL, "
    "var_x_m2 REAL NOT NULL, cov_xy_m2 REAL NOT NULL, var_y_m2 REAL NOT NULL, "
    "heading_rad REAL, source TEXT NOT NULL)",
    "CREATE TABLE picture (id INTEGER PRIMARY KEY, width_px INTEGER NOT NULL, "
    "height_px INTEGER NOT NULL, points INTEGER NOT NULL, points_px BLOB NOT NULL, "
    "descriptors BLOB NOT NULL, crc INTEGER NOT NULL)",
    "CREATE VIRTUAL TABLE place USING rtree(id, min_x, max_x, min_y, max_y)",
)


def connect_reading(path: Path) -> sqlite3.Connection:
    """Open for reading; the journal of an interrupted writer is rolled back first.

    Raises:
        LogError: The file cannot be opened.
    """
    sql = connect(path, "rw" if journal_of(path).exists() else "ro")
    sql.execute("PRAGMA query_only = ON")
    return sql


def connect(path: Path, mode: str) -> sqlite3.Connection:
    """Open in one of SQLite's modes ``ro``, ``rw``, ``rwc``.

    Raises:
        LogError: The file cannot be opened.
    """
    # Percent-encoded, because '%41', '?' and '#' in a file name would open another file.
    uri = f"file:{quote(str(path.absolute()), errors='surrogateescape')}?mode={mode}"
    try:
        sql = sqlite3.connect(uri, uri=True, isolation_level=None, timeout=_BUSY_S)
        sql.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, _MAX_BYTES)
        sql.execute("PRAGMA trusted_schema = OFF")
    except sqlite3.Error as error:
        raise LogError(f"{path}: {error}; check the path and its mode") from None
    return sql


def check_length(path: Path) -> None:
    """Compare the file's length with the one in its header.

    Raises:
        LogError: The file cannot be read.
        LogFormatError: The file is not an SQLite file, or truncated.
    """
    try:
        length = path.stat().st_size
        if not path.is_file():
            raise LogError(f"{path}: not a regular file; expected a landmark database")
        with path.open("rb") as file:
            header = file.read(100)
    except OSError as error:
        raise LogError(
            f"{path}: {error.strerror}; make a landmark database with: crosscue landmarks add"
        ) from None
    if len(header) < 100 or not header.startswith(_HEADER):
        raise LogFormatError(f"{path}: not SQLite; expected a landmark database")
    (page,) = struct.unpack_from(">H", header, 16)
    changes, pages = struct.unpack_from(">II", header, 24)
    page = 65_536 if page == 1 else page
    (valid_for,) = struct.unpack_from(">I", header, 92)
    # Before a journal is rolled back, the header cannot be trusted.
    is_settled = changes == valid_for and not journal_of(path).exists()
    if is_settled and length < pages * page:
        raise LogFormatError(
            f"{path}: cut short: {length:,} of {pages * page:,} bytes; copy it again, or build it "
            "again with: crosscue landmarks add"
        )


def journal_of(path: Path) -> Path:
    """Path of SQLite's rollback journal."""
    return path.with_name(path.name + "-journal")


def check_ours(sql: sqlite3.Connection, path: Path) -> None:
    """Check that the file is a landmark database of this version.

    Raises:
        LogFormatError: It is not.
    """
    application = sql.execute("PRAGMA application_id").fetchone()[0]
    if application != APPLICATION_ID:
        raise LogFormatError(f"{path}: another SQLite file; expected a landmark database")
    version = sql.execute("PRAGMA user_version").fetchone()[0]
    if version != VERSION:
        raise LogFormatError(
            f"{path}: landmark database of version {version}, this crosscue reads {VERSION}; "
            "build it again with: crosscue landmarks add"
        )
    found = sql.execute(
        "SELECT sql FROM sqlite_schema WHERE sql IS NOT NULL AND name NOT GLOB 'place_*'"
    ).fetchall()
    if sorted(str(row[0]) for row in found) != sorted(TABLES):
        raise damaged(path, "its tables are not those of version 1")


def matcher_name(sql: sqlite3.Connection, path: Path) -> str:
    """Read the name of the matcher of its features."""
    row = sql.execute("SELECT value FROM setting WHERE key = 'matcher'").fetchone()
    if row is None:
        raise damaged(path, "the name of its matcher is missing")
    return str(row[0])


def damaged(path: Path, why: str) -> LogFormatError:
    """Return the error for an inconsistent file."""
    return LogFormatError(
        f"{path}: damaged: {why}; copy it again, or build it again with: crosscue landmarks add"
    )


@contextmanager
def errors_in_one_line(path: Path, *, writing: bool = False) -> Iterator[None]:
    """Convert SQLite's errors to crosscue's."""
    try:
        yield
    except UnicodeDecodeError as error:
        raise damaged(path, str(error)) from None
    except sqlite3.Error as error:
        code = getattr(error, "sqlite_errorcode", 0) & 0xFF
        if code in (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB):
            raise damaged(path, str(error)) from None
        if code == sqlite3.SQLITE_BUSY:
            raise OutputError(
                f"{path}: another process is writing it; wait until it is done"
            ) from None
        if code == sqlite3.SQLITE_FULL:
            full = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            raise cannot_write(path, full) from None
        if writing:
            raise OutputError(f"{path}: {error}; choose a writable folder") from None
        raise LogFormatError(f"{path}: {error}; check the file and its folder") from None
