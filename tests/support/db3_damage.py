"""Small .db3 files of many shapes, damaged copies of them, and the verdicts of both checks."""

import random
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from crosscue.replay.errors import CrosscueError
from crosscue.replay.limits import DEFAULT_LIMITS
from crosscue.replay.readers.rosbag2.pages import page_rows
from crosscue.replay.readers.rosbag2.soundness import soundness
from crosscue.replay.readers.rosbag2.sqlite import open_database

TABLES: Final = """
CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL,
    serialization_format TEXT NOT NULL);
INSERT INTO topics VALUES(1, '/a', 'std_msgs/msg/String', 'cdr');
INSERT INTO topics VALUES(2, '/b', 'std_msgs/msg/String', 'cdr');
CREATE TABLE metadata(id INTEGER PRIMARY KEY, metadata_version INTEGER NOT NULL, metadata TEXT);
CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL,
    timestamp INTEGER NOT NULL, data BLOB NOT NULL);
"""
INDEX: Final = "CREATE INDEX timestamp_idx ON messages (timestamp ASC);"
START_NS: Final = 1_700_000_000_000_000_000


@dataclass(frozen=True, slots=True)
class Shape:
    """Properties of a file.

    Attributes:
        page_bytes: Size of a page.
        rows: Number of rows written.
        largest: Size of the largest payload.
        deleted: Fraction of the rows deleted at the end.
        has_index: Whether the file has a time index.
        before: Statements before the tables are created.
        after: Statements at the end.
        is_understood: Whether the file's structure is checked without SQLite.
    """

    page_bytes: int = 4096
    rows: int = 150
    largest: int = 200
    deleted: float = 0.0
    has_index: bool = True
    before: str = ""
    after: str = ""
    is_understood: bool = True


SHAPES: Final = {
    **{f"pages of {1 << k}": Shape(1 << k, 100 + (1 << k) // 25, 150) for k in range(9, 17)},
    "three levels": Shape(512, 1200, 60),
    "without an index": Shape(1024, has_index=False),
    "long payloads": Shape(1024, 40, 5000),
    "very long payloads": Shape(512, 8, 30_000),
    "free pages": Shape(
        512,
        after="CREATE TABLE more(a); INSERT INTO more VALUES(zeroblob(99999)); DROP TABLE more",
    ),
    "deleted rows": Shape(1024, 300, 400, deleted=0.5),
    "deleted long payloads": Shape(512, 60, 3000, deleted=0.6),
    "long metadata": Shape(512, after=f"INSERT INTO metadata VALUES(1, 9, '{'m' * 3000}')"),
    "statistics": Shape(after="ANALYZE"),
    "write-ahead log": Shape(before="PRAGMA journal_mode=wal"),
    "automatic vacuum": Shape(1024, before="PRAGMA auto_vacuum=1", is_understood=False),
    "table without row ids": Shape(
        after="CREATE TABLE more(name TEXT PRIMARY KEY) WITHOUT ROWID", is_understood=False
    ),
    "second index": Shape(after="CREATE INDEX more ON messages (topic_id)", is_understood=False),
    "checked column": Shape(
        after="ALTER TABLE messages ADD COLUMN more CHECK (more > 1)", is_understood=False
    ),
}


def write_shape(path: Path, shape: Shape, seed: int = 1) -> Path:
    """Write a file that SQLite's integrity check finds sound."""
    chance = random.Random(seed)
    with closing(sqlite3.connect(path, isolation_level=None)) as db:
        db.execute(f"PRAGMA page_size={shape.page_bytes}")
        db.executescript(f"{shape.before};{TABLES}{INDEX if shape.has_index else ''}BEGIN;")
        for i in range(shape.rows):
            # Not all in time order, and some times twice.
            t_ns = START_NS + (i // 2 * 2 + chance.randrange(5)) * 1_000_000
            payload = chance.randbytes(chance.randrange(shape.largest))
            row = (chance.choice([1, 2]), t_ns, payload)
            db.execute("INSERT INTO messages(topic_id, timestamp, data) VALUES(?, ?, ?)", row)
        db.execute("COMMIT")
        for i in range(shape.rows):
            if chance.random() < shape.deleted:
                db.execute("DELETE FROM messages WHERE id = ?", (i,))
        db.executescript(shape.after)
        assert db.execute("PRAGMA integrity_check").fetchall() == [("ok",)]
    return path


def copies(intact: bytes, count: int, seed: int) -> Iterator[tuple[str, bytes]]:
    """Yield damaged copies with a description; the seed determines all."""
    chance = random.Random(seed)
    kinds = (_flip, _zero, _noise, _cut, _move, _swap, _edit_head, _edit_cell, _swap_cells, _count)
    for number in range(count):
        copy = bytearray(intact)
        kind = kinds[number % len(kinds)]
        kind(copy, chance)
        yield f"{kind.__name__[1:]}, {number} of seed {seed}", bytes(copy)


def _flip(copy: bytearray, chance: random.Random) -> None:
    copy[chance.randrange(len(copy))] ^= 1 << chance.randrange(8)


def _zero(copy: bytearray, chance: random.Random) -> None:
    at, length = chance.randrange(len(copy)), chance.choice([1, 2, 4, 16, 512])
    copy[at : at + length] = bytes(len(copy[at : at + length]))


def _noise(copy: bytearray, chance: random.Random) -> None:
    at, length = chance.randrange(len(copy)), chance.choice([1, 2, 4, 16])
    copy[at : at + length] = chance.randbytes(len(copy[at : at + length]))


def _cut(copy: bytearray, chance: random.Random) -> None:
    size = _page_bytes(copy)
    pages = len(copy) // size
    del copy[chance.choice([chance.randrange(len(copy)), chance.randrange(pages) * size]) :]
    # A header that agrees with the shorter file.
    if len(copy) >= 100 and chance.random() < 0.5:
        copy[28:32] = (len(copy) // size).to_bytes(4, "big")


def _move(copy: bytearray, chance: random.Random) -> None:
    """Write a page over another, or both in each other's place."""
    size = _page_bytes(copy)
    a, b = (chance.randrange(len(copy) // size) * size for _ in range(2))
    first, second = copy[a : a + size], copy[b : b + size]
    copy[a : a + size] = second
    if chance.random() < 0.5:
        copy[b : b + size] = first


def _swap(copy: bytearray, chance: random.Random) -> None:
    """Swap two parts of a page."""
    size = _page_bytes(copy)
    length = chance.choice([1, 2, 4, 8])
    page = chance.randrange(len(copy) // size) * size
    a, b = (page + chance.randrange(size - length) for _ in range(2))
    copy[a : a + length], copy[b : b + length] = copy[b : b + length], copy[a : a + length]


def _edit_head(copy: bytearray, chance: random.Random) -> None:
    """Change a number in the header of a page or of the file."""
    head = chance.choice([_head(copy, chance), 16 + chance.randrange(80)])
    at = head + chance.randrange(16)
    copy[at] = (copy[at] + chance.choice([1, -1, 8, 64, chance.randrange(256)])) % 256


def _edit_cell(copy: bytearray, chance: random.Random) -> None:
    """Change a cell's pointer, or one of its first bytes: sizes, row id, types, time."""
    pointer, at = _cell(copy, chance)
    at = chance.choice([pointer, pointer + 1, *(at + chance.randrange(16) for _ in range(4))])
    if at < len(copy):
        copy[at] = (copy[at] + chance.choice([1, -1, 128, chance.randrange(256)])) % 256


def _swap_cells(copy: bytearray, chance: random.Random) -> None:
    """Swap or repeat pointers of neighbouring cells, or bytes of their row ids and times."""
    (a, first), (b, second) = _cell(copy, chance), _cell(copy, chance)
    length = 2
    if chance.random() < 0.5:
        b = a + 2
    elif chance.random() < 0.5:
        shift, length = chance.randrange(16), chance.choice([1, 2, 8])
        a, b = first + shift, second + shift
    if max(a, b) + length <= len(copy):
        one, other = copy[a : a + length], copy[b : b + length]
        copy[a : a + length] = other
        if chance.random() < 0.7:
            copy[b : b + length] = one


def _count(copy: bytearray, chance: random.Random) -> None:
    """Hide cells at the end of a page, or whole free pages."""
    head = _head(copy, chance)
    count = int.from_bytes(copy[head + 3 : head + 5], "big")
    copy[head + 3 : head + 5] = max(0, count - chance.randrange(1, 3)).to_bytes(2, "big")
    if chance.random() < 0.3:
        copy[32:40] = bytes(8)


def _page_bytes(copy: bytearray) -> int:
    size = int.from_bytes(copy[16:18], "big")
    return 65536 if size == 1 else size


def _head(copy: bytearray, chance: random.Random) -> int:
    """Return the position of the header of a page, with preference for B-tree pages."""
    size, head = _page_bytes(copy), 100
    for _ in range(10):
        page = chance.randrange(len(copy) // size)
        head = page * size + (0 if page else 100)
        if copy[head] in (2, 5, 10, 13):
            break
    return head


def _cell(copy: bytearray, chance: random.Random) -> tuple[int, int]:
    """Return the positions of a cell's pointer and of the cell."""
    head = _head(copy, chance)
    count = int.from_bytes(copy[head + 3 : head + 5], "big")
    interior = 4 * (copy[head] in (2, 5))
    pointer = min(head + 8 + interior + 2 * chance.randrange(count or 1), len(copy) - 3)
    page = head - head % _page_bytes(copy)
    return pointer, page + int.from_bytes(copy[pointer : pointer + 2], "big")


def own_verdict(path: Path) -> bool | None:
    """Return whether our check finds the file sound; None if it cannot be opened."""
    try:
        database = open_database(path, DEFAULT_LIMITS)
    except CrosscueError:
        return None
    try:
        found = soundness(database, DEFAULT_LIMITS)
        if found is None:
            return False
        for _ in page_rows(database, None, DEFAULT_LIMITS, found):
            pass
        return found.is_complete
    finally:
        database.close()


def sqlite_verdict(path: Path) -> bool:
    """Return whether SQLite's integrity check finds the file sound."""
    with closing(sqlite3.connect(f"{path.as_uri()}?immutable=1", uri=True)) as db:
        db.execute("PRAGMA cell_size_check=ON")
        db.text_factory = bytes
        try:
            return db.execute("PRAGMA integrity_check").fetchall() == [(b"ok",)]
        except (sqlite3.Error, UnicodeError):
            return False
