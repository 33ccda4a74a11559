"""ROS 2 databases: rows, pages and damaged files."""

import os
import random
import sqlite3
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.rosbag2 import Reader

from crosscue.replay.errors import CrosscueError
from crosscue.replay.ledger import Ledger
from crosscue.replay.limits import DEFAULT_LIMITS
from crosscue.replay.readers.rosbag2.db3 import Db3Log
from crosscue.replay.readers.rosbag2.pages import PageRows, page_rows
from crosscue.replay.readers.rosbag2.sqlite import open_database
from support.data import shared
from support.rosbag_files import Row, damaged_copies, faults, read_rows, rows_of, write_folder
from support.trees import contents, written

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
TABLES = TOPICS + MESSAGES + INDEX
RECORDER = f"""
import os, sqlite3, sys
path, journal, before, after = sys.argv[1], sys.argv[2], int(sys.argv[3]), int(sys.argv[4])
db = sqlite3.connect(path, isolation_level=None)
db.execute("PRAGMA journal_mode=" + journal)
db.execute("PRAGMA wal_autocheckpoint=0")
db.execute("PRAGMA cache_size=5")
db.executescript('''{TABLES}''')
def put(first, last):
    db.execute("BEGIN")
    for i in range(first, last):
        db.execute("INSERT INTO messages VALUES(?, 1, ?, ?)", (i + 1, i, bytes(1000)))
put(0, before)
db.execute("COMMIT")
put(before, after)
if journal == "wal":
    db.execute("COMMIT")
else:
    db.execute("UPDATE messages SET timestamp = 5")
os._exit(9)
"""


def write_database(path: Path, *rows: tuple[object, ...]) -> Path:
    """Write a database with ``rows`` of topic id, timestamp and payload."""
    with sqlite3.connect(path) as db:
        db.executescript(TABLES)
        db.executemany("INSERT INTO messages(topic_id, timestamp, data) VALUES(?, ?, ?)", rows)
    db.close()
    return path


def killed_recorder(folder: Path, journal: str) -> Path:
    """Write 600 rows, and 400 more in a transaction, as a process that ends without closing."""
    path = folder / "a.db3"
    arguments = [sys.executable, "-c", RECORDER, str(path), journal, "600", "1000"]
    assert subprocess.run(arguments, check=False).returncode == 9
    return path


def test_real_database_matches_rosbags() -> None:
    path = shared("bags", "evo", "tf_example", "tf_example.db3")
    reading = read_rows(path)
    with Reader(path.parent) as reader:
        theirs = [Row(c.topic, t, bytes(raw)) for c, t, raw in reader.messages()]

    assert Counter(reading.rows) == Counter(theirs)
    assert {name: a.found for name, a in reading.ledger.accounts.items()} == {
        "/tf_static": 1,
        "/tf": 517,
    }
    assert all(t.schema_encoding == "ros2msg" and t.schema for t in reading.log.topics)
    assert reading.ledger.is_whole
    assert "no checksums" in reading.ledger.integrity
    assert "finds no fault" in reading.ledger.integrity


@pytest.mark.parametrize("name", ["run%41.db3", "a#b.db3", "q?x=1.db3", "-rf.db3", "ü\n.db3"])
def test_unusual_file_name_opens_that_file(tmp_path: Path, name: str) -> None:
    for neighbour in ("runA.db3", "a", "q"):
        write_database(tmp_path / neighbour, (1, 0, b"wrong"))
    write_database(tmp_path / name, (1, 0, b"right"))

    assert [row.payload for row in read_rows(tmp_path / name).rows] == [b"right"]


@pytest.mark.parametrize("has_shm", [True, False])
def test_write_ahead_log_is_read_and_files_are_unchanged(tmp_path: Path, has_shm: bool) -> None:
    path = killed_recorder(tmp_path, "wal")
    if not has_shm:
        (tmp_path / "a.db3-shm").unlink()
    before = contents(tmp_path)
    reading = read_rows(path)

    assert len(reading.rows) == 1000
    assert contents(tmp_path) == before
    assert any("write-ahead log" in sentence for sentence in reading.ledger.notices)
    assert reading.ledger.is_whole


@pytest.fixture(scope="module")
def wal_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write 40 transactions of a killed recorder, the last 39 only in the write-ahead log."""
    folder = tmp_path_factory.mktemp("wal")
    db = sqlite3.connect(tmp_path_factory.mktemp("live") / "a.db3", isolation_level=None)
    db.execute("PRAGMA journal_mode=wal")
    db.execute("PRAGMA wal_autocheckpoint=0")
    db.executescript(TABLES)
    for i in range(40):
        db.execute("INSERT INTO messages VALUES(?, 1, ?, ?)", (i + 1, i, bytes([i]) * 300))
        if i == 0:
            db.execute("PRAGMA wal_checkpoint")
    live = Path(db.execute("PRAGMA database_list").fetchone()[2])
    for suffix in ("", "-wal"):
        source = live.with_name(live.name + suffix)
        (folder / source.name).write_bytes(source.read_bytes())
    db.close()
    return folder


def test_losses_of_damaged_write_ahead_log_are_reported(wal_folder: Path, tmp_path: Path) -> None:
    path = written(tmp_path / "a.db3", (wal_folder / "a.db3").read_bytes())
    truth = read_rows(wal_folder / "a.db3").rows
    log = (wal_folder / "a.db3-wal").read_bytes()
    silent = []
    for how, copy in damaged_copies(log, cuts=0, flips=80, seed=22):
        (tmp_path / "a.db3-wal").write_bytes(copy)
        reading = read_rows(path)
        assert not Counter(reading.rows) - Counter(truth)
        if len(reading.rows) < len(truth) and reading.ledger.is_whole:
            silent.append(how)

    assert not silent


def test_hot_journal_is_rolled_back_in_copy(tmp_path: Path) -> None:
    path = killed_recorder(tmp_path, "delete")
    before = contents(tmp_path)
    assert "a.db3-journal" in before
    reading = read_rows(path)

    assert [row.log_ns for row in reading.rows] == list(range(600))
    assert contents(tmp_path) == before
    assert any("undone in a temporary copy" in sentence for sentence in reading.ledger.notices)


def test_two_types_on_one_topic_are_not_mixed(tmp_path: Path) -> None:
    path = write_database(
        tmp_path / "a.db3", (1, 5, b"text"), (2, 6, b"number"), (3, 7, b"more text")
    )
    with sqlite3.connect(path) as db:
        db.execute("INSERT INTO topics VALUES(2, '/a', 'std_msgs/msg/Int8', 'cdr')")
        db.execute("INSERT INTO topics VALUES(3, '/a', 'std_msgs/msg/String', 'cdr')")
    db.close()
    reading = read_rows(path)

    assert [row.payload for row in reading.rows] == [b"text", b"more text"]
    assert reading.ledger.topic("/a").skipped == {"another message type on the same topic": 1}


@pytest.mark.slow
@pytest.mark.parametrize("compression", ["none", "message"])
def test_any_damage_is_reported(tmp_path: Path, compression: str) -> None:
    rows = rows_of(250)
    is_packed = compression == "message"
    folder = write_folder(tmp_path / "bag", rows, compression="message" if is_packed else "none")
    path = next(folder.glob("*.db3"))

    assert not faults(path, rows, 21, forbidden=("SILENT", "wrong"))


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
    # Bytes of a page, reserved ones of them, and the vacuum; seed, rows, largest and an index.
    pages=st.tuples(
        st.sampled_from([1 << k for k in range(9, 17)]), st.integers(0, 32), st.integers(0, 2)
    ),
    rows=st.tuples(
        st.integers(0, 1 << 30),
        st.integers(0, 250),
        st.sampled_from([10, 5000, 200_000]),
        st.booleans(),
    ),
)
@settings(max_examples=40)
def test_rows_read_from_pages_equal_sqlite_rows(
    tmp_path_factory: pytest.TempPathFactory,
    pages: tuple[int, int, int],
    rows: tuple[int, int, int, bool],
) -> None:
    path = tmp_path_factory.mktemp("pages") / "a.db3"
    fill(empty(path, *pages), *rows)

    assert rows_in_pages(path) == stored_rows(path)


def test_long_payloads_in_scattered_pages_are_complete_and_batches_bounded(tmp_path: Path) -> None:
    path = tmp_path / "a.db3"
    db = empty(path, 512, 0)
    db.executescript(TABLES + "BEGIN;")
    small = [(i, i) for i in range(4000)]
    db.executemany("INSERT INTO messages VALUES(?, 1, ?, zeroblob(490))", small)
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
