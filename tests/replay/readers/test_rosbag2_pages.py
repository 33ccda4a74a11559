"""Rows read directly from a SQLite file's pages equal those read through SQLite."""

from __future__ import annotations

import os
import random
import sqlite3
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crosscue.replay.errors import CrosscueError
from crosscue.replay.ledger import Ledger
from crosscue.replay.limits import DEFAULT_LIMITS
from crosscue.replay.readers.rosbag2.db3 import Db3Log
from crosscue.replay.readers.rosbag2.pages import PageRows, page_rows
from crosscue.replay.readers.rosbag2.sqlite import open_database
from support.rosbag_files import read_rows

TOPICS = """
CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT);
INSERT INTO topics VALUES(1, '/a', 'std_msgs/msg/String', 'cdr');
INSERT INTO topics VALUES(300, '/b', 'std_msgs/msg/String', 'cdr');
"""
MESSAGES = """
CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL,
    timestamp INTEGER NOT NULL, data BLOB NOT NULL);
"""
INDEX = "CREATE INDEX timestamp_idx ON messages (timestamp ASC);"
Stored = tuple[int, int, int, bytes]


def stored_rows(path: Path) -> list[Stored]:
    """Read the rows with the standard library."""
    db = sqlite3.connect(path)
    rows = db.execute("SELECT id, topic_id, timestamp, data FROM messages ORDER BY id").fetchall()
    db.close()
    return rows


def rows_in_pages(path: Path, topics: frozenset[int] | None = None) -> list[Stored]:
    """Read the rows from the pages."""
    database = open_database(path, DEFAULT_LIMITS)
    try:
        return [row for lot in page_rows(database, topics, DEFAULT_LIMITS) for row in plain(lot)]
    finally:
        database.close()


def plain(lot: PageRows) -> Iterator[Stored]:
    for i in range(len(lot)):
        numbers = int(lot.ids[i]), int(lot.topics[i]), int(lot.times[i])
        yield (*numbers, bytes(lot.messages.payload(i)))


def empty(path: Path, page_bytes: int, reserved: int, auto_vacuum: int = 0) -> sqlite3.Connection:
    """Create a database without tables and with ``reserved`` bytes at the end of each page."""
    db = sqlite3.connect(path, isolation_level=None)
    db.execute(f"PRAGMA page_size={page_bytes}")
    db.execute(f"PRAGMA auto_vacuum={auto_vacuum}")
    db.execute("PRAGMA user_version=1")
    db.close()
    head = bytearray(path.read_bytes())
    head[20] = reserved
    # The start of the first page's cells.
    head[105:107] = ((page_bytes - reserved) & 0xFFFF).to_bytes(2, "big")
    path.write_bytes(head)
    return sqlite3.connect(path, isolation_level=None)


def fill(db: sqlite3.Connection, seed: int, count: int, largest: int, has_index: bool) -> None:
    """Insert rows of all kinds that a table can have, and delete some of them."""
    db.executescript(TOPICS + MESSAGES + (INDEX if has_index else ""))
    chance = random.Random(seed)
    db.execute("BEGIN")
    for _ in range(count):
        row_id = chance.choice([None, None, None, chance.randrange(-(1 << 60), 1 << 60)])
        bits = chance.randrange(63)
        t_ns = chance.choice([0, 1, -1, 1 << bits, -(1 << bits), -(1 << 63), (1 << 63) - 1])
        size = chance.choice([0, 1, 40, chance.randrange(600), chance.randrange(largest)])
        row = (row_id, chance.choice([0, 1, 2, 300, -70_000]), t_ns, chance.randbytes(size))
        db.execute("INSERT OR REPLACE INTO messages VALUES(?, ?, ?, ?)", row)
        if chance.random() < 0.2:
            db.execute("DELETE FROM messages WHERE id % 7 = ?", (chance.randrange(7),))
    db.execute("COMMIT")
    assert db.execute("PRAGMA integrity_check").fetchall() == [("ok",)]
    db.close()


@pytest.mark.slow
@given(
    page_bytes=st.sampled_from([512, 1024, 2048, 4096, 8192, 16384, 32768, 65536]),
    reserved=st.integers(0, 32),
    auto_vacuum=st.integers(0, 2),
    has_index=st.booleans(),
    count=st.integers(0, 250),
    largest=st.sampled_from([10, 5000, 200_000]),
    seed=st.integers(0, 1 << 30),
)
@settings(max_examples=40)
def test_rows_read_from_pages_equal_sqlite_rows(
    tmp_path_factory: pytest.TempPathFactory,
    page_bytes: int,
    reserved: int,
    auto_vacuum: int,
    has_index: bool,
    count: int,
    largest: int,
    seed: int,
) -> None:
    path = tmp_path_factory.mktemp("pages") / "a.db3"
    fill(empty(path, page_bytes, reserved, auto_vacuum), seed, count, largest, has_index)

    assert rows_in_pages(path) == stored_rows(path)


def test_long_payloads_in_scattered_pages_are_complete_and_batches_bounded(tmp_path: Path) -> None:
    path = tmp_path / "a.db3"
    db = empty(path, 512, 0)
    db.executescript(TOPICS + MESSAGES + INDEX + "BEGIN;")
    db.executemany(
        "INSERT INTO messages VALUES(?, 1, ?, zeroblob(490))", [(i, i) for i in range(4000)]
    )
    db.execute("DELETE FROM messages WHERE id % 2")
    chance = random.Random(5)
    large = [(10_000 + i, i, chance.randbytes(700_000)) for i in range(12)]
    db.executemany("INSERT INTO messages VALUES(?, 1, ?, ?)", large)
    db.execute("COMMIT")
    db.close()
    database = open_database(path, DEFAULT_LIMITS)
    lots = list(page_rows(database, None, DEFAULT_LIMITS))
    database.close()

    assert [row for lot in lots for row in plain(lot)] == stored_rows(path)
    assert max(len(lot.messages.buffer) for lot in lots) <= 8 << 20


@pytest.mark.parametrize(
    "odd",
    [(1, 5, None), (1, 5, "text"), (1, 5, 7), (1, 2.5, b"x"), (1, "x", b"x"), (b"1", 5, b"x")],
)
def test_page_reading_stops_before_value_of_unexpected_type(
    tmp_path: Path, odd: tuple[object, ...]
) -> None:
    path = tmp_path / "a.db3"
    db = empty(path, 4096, 0)
    db.executescript(TOPICS + MESSAGES.replace(" NOT NULL", ""))
    rows: Sequence[tuple[object, ...]] = [(1, 1, b"a"), (1, 2, b"b"), odd, (1, 4, b"d")]
    db.executemany("INSERT INTO messages(topic_id, timestamp, data) VALUES(?, ?, ?)", rows)
    db.close()

    assert rows_in_pages(path) == [(1, 1, 1, b"a"), (2, 1, 2, b"b")]
    assert [row.payload for row in read_rows(path).rows] == [b"a", b"b", b"d"]


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("timestamp INTEGER", "timestamp REAL"),
        (");", ") WITHOUT ROWID;"),
        (");", ", more TEXT);"),
        (");", ", more INTEGER AS (id + 1));"),
        ("id INTEGER PRIMARY KEY", "id INTEGER"),
        ("id INTEGER PRIMARY KEY", "id TEXT PRIMARY KEY"),
    ],
)
def test_unsupported_table_definition_is_left_to_sqlite(tmp_path: Path, old: str, new: str) -> None:
    db = empty(tmp_path / "a.db3", 4096, 0)
    db.executescript(TOPICS + MESSAGES.replace(old, new))
    db.execute("INSERT INTO messages(id, topic_id, timestamp, data) VALUES(1, 1, 5, x'01')")
    db.close()

    assert rows_in_pages(tmp_path / "a.db3") == []


@pytest.mark.slow
def test_malformed_pages_end_reading_without_duplicates(tmp_path: Path) -> None:
    path = tmp_path / "a.db3"
    fill(empty(path, 512, 0), 9, 150, 3000, has_index=False)
    whole, truth = path.read_bytes(), stored_rows(path)
    counts = set()
    rng = np.random.default_rng(2)
    for _ in range(400):
        copy = bytearray(whole)
        # Most of the structure of a page is described at its start.
        at = int(rng.integers(2, len(whole) // 512)) * 512 + int(rng.integers(0, 24))
        copy[at] = int(rng.integers(0, 256))
        path.write_bytes(copy)
        try:
            ids = [row[0] for row in rows_in_pages(path)]
        except CrosscueError:
            continue
        assert ids == sorted(set(ids))
        counts.add(len(ids))

    assert max(counts) == len(truth)
    assert len(counts) > 5


def test_file_truncated_during_reading_is_reported(tmp_path: Path) -> None:
    path = tmp_path / "a.db3"
    fill(empty(path, 512, 0), 9, 150, 3000, has_index=True)
    ledger = Ledger("a")
    with Db3Log(path) as log:
        blocks = log.read(ledger)
        next(blocks)
        os.truncate(path, 2048)
        list(blocks)

    assert not ledger.is_whole
