"""ROS 2 SQLite bags: every row is read or reported as dropped."""

from __future__ import annotations

import sqlite3
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest
from rosbags.rosbag2 import Reader

from support.data import shared
from support.rosbag_files import Row, damaged_copies, judge, read_rows, rows_of, write_folder

TABLES = """
CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT);
CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB);
CREATE INDEX timestamp_idx ON messages (timestamp ASC);
INSERT INTO topics VALUES(1, '/a', 'std_msgs/msg/String', 'cdr');
"""
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


def write_database(path: Path, *rows: tuple[object, ...], tables: str = TABLES) -> Path:
    """Write a database with ``rows`` of topic id, timestamp and payload."""
    with sqlite3.connect(path) as db:
        db.executescript(tables)
        db.executemany("INSERT INTO messages(topic_id, timestamp, data) VALUES(?, ?, ?)", rows)
    db.close()
    return path


def killed_recorder(path: Path, journal: str, before: int, after: int) -> None:
    arguments = [sys.executable, "-c", RECORDER, str(path), journal, str(before), str(after)]
    assert subprocess.run(arguments, check=False).returncode == 9


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


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
    path = tmp_path / "a.db3"
    killed_recorder(path, "wal", 600, 1000)
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
    path = tmp_path / "a.db3"
    path.write_bytes((wal_folder / "a.db3").read_bytes())
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
    path = tmp_path / "a.db3"
    killed_recorder(path, "delete", 600, 1000)
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
    silent = []
    for how, copy in damaged_copies(path.read_bytes(), cuts=60, flips=140, seed=21):
        path.write_bytes(copy)
        verdict = judge(path, rows)
        if verdict.startswith(("SILENT", "wrong")):
            silent.append((how, verdict))

    assert not silent
