"""ROS 2 SQLite bags: every row is read or reported as dropped."""

from __future__ import annotations

import os
import sqlite3
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.rosbag2 import Reader

from crosscue.replay.base import Selection
from crosscue.replay.errors import LogError, LogFormatError
from crosscue.replay.ledger import NOT_ASKED_TIME, NOT_ASKED_TOPIC, Ledger
from crosscue.replay.logs.opening import open_log
from crosscue.replay.readers.rosbag2.db3 import open_db3
from crosscue.replay.readers.rosbag2.tables import StorageTables
from crosscue.replay.readers.rosbag2.wal import check_wal
from support.data import shared
from support.rosbag_files import (
    START_NS,
    Row,
    by_topic,
    damaged_copies,
    judge,
    read_rows,
    rows_of,
    write_folder,
)

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


def db3_of(folder: Path, rows: list[Row]) -> Path:
    return next(write_folder(folder, rows).glob("*.db3"))


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


def test_every_message_is_read_in_stored_order(tmp_path: Path) -> None:
    rows = rows_of(3000)
    reading = read_rows(db3_of(tmp_path / "bag", rows))

    assert by_topic(reading.rows) == by_topic(rows)
    assert reading.ledger.is_whole
    assert not reading.ledger.notices


@pytest.mark.parametrize("name", ["run%41.db3", "a#b.db3", "q?x=1.db3", "-rf.db3", "ü\n.db3"])
def test_unusual_file_name_opens_that_file(tmp_path: Path, name: str) -> None:
    for neighbour in ("runA.db3", "a", "q"):
        write_database(tmp_path / neighbour, (1, 0, b"wrong"))
    write_database(tmp_path / name, (1, 0, b"right"))

    assert [row.payload for row in read_rows(tmp_path / name).rows] == [b"right"]


def test_non_utf8_file_name_is_opened(tmp_path: Path) -> None:
    path = tmp_path / os.fsdecode(b"caf\xe9.db3")
    write_database(tmp_path / "plain.db3", (1, 0, b"x")).rename(path)

    assert len(read_rows(path).rows) == 1


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


def test_valid_write_ahead_log_is_reported_as_valid(wal_folder: Path) -> None:
    state = check_wal(wal_folder / "a.db3-wal")

    assert state is not None
    assert state.frames == state.sound > 40
    assert not state.has_lost_commit
    assert len(read_rows(wal_folder / "a.db3").rows) == 40


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


def test_closed_wal_database_leaves_files_unchanged(tmp_path: Path) -> None:
    path = tmp_path / "a.db3"
    db = sqlite3.connect(path)
    db.execute("PRAGMA journal_mode=wal")
    db.close()
    write_database(path, (1, 0, b"x"))
    before = contents(tmp_path)

    assert len(read_rows(path).rows) == 1
    assert contents(tmp_path) == before


def test_hot_journal_is_rolled_back_in_copy(tmp_path: Path) -> None:
    path = tmp_path / "a.db3"
    killed_recorder(path, "delete", 600, 1000)
    before = contents(tmp_path)
    assert "a.db3-journal" in before
    reading = read_rows(path)

    assert [row.log_ns for row in reading.rows] == list(range(600))
    assert contents(tmp_path) == before
    assert any("undone in a temporary copy" in sentence for sentence in reading.ledger.notices)


def test_rows_of_wrong_types_are_skipped_with_reason(tmp_path: Path) -> None:
    path = write_database(
        tmp_path / "a.db3",
        (1, 5, b"good"),
        (1, "not a time", b"x"),
        (1, 2.5, b"x"),
        (1, 6, None),
        (1, 7, "text"),
        (77, 8, b"orphan"),
        ("one", 9, b"x"),
        (1, 10, b""),
    )
    reading = read_rows(path)
    ledger = reading.ledger

    assert reading.rows == (Row("/a", 5, b"good"), Row("/a", 10, b""))
    assert ledger.topic("/a").skipped == {
        "timestamp is not an integer": 2,
        "payload is not a blob": 2,
    }
    assert ledger.topic("").skipped == {"message without a topic": 2}
    assert ledger.topic("/a").in_file == 6


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


def test_file_without_definitions_uses_known_ones(tmp_path: Path) -> None:
    reading = read_rows(write_database(tmp_path / "a.db3", (1, 5, b"x")))
    (topic,) = reading.log.topics

    assert topic.schema.startswith(b"string data")
    assert topic.schema_encoding == "ros2msg"
    assert any("Humble" in sentence for sentence in reading.ledger.notices)


@pytest.mark.parametrize("has_index", [True, False])
def test_time_range_is_read_and_other_messages_are_counted(tmp_path: Path, has_index: bool) -> None:
    rows = rows_of(1000)
    path = db3_of(tmp_path / "bag", rows)
    if not has_index:
        with sqlite3.connect(path) as db:
            db.execute("DROP INDEX timestamp_idx")
        db.close()
    wanted = rows[400:450]
    selection = Selection(start_ns=wanted[0].log_ns, end_ns=rows[450].log_ns)
    reading = read_rows(path, selection)

    assert by_topic(reading.rows) == by_topic(wanted)
    skipped = sum(a.skipped[NOT_ASKED_TIME] for a in reading.ledger.accounts.values())
    assert skipped == 950
    assert reading.ledger.is_whole
    assert ("a part was read" in reading.ledger.integrity) == has_index


def test_unselected_topics_are_counted_as_skipped(tmp_path: Path) -> None:
    rows = rows_of(500)
    path = db3_of(tmp_path / "bag", rows)
    reading = read_rows(path, Selection(topics=frozenset({"/gps/fix"})))

    assert list(reading.rows) == by_topic(rows)["/gps/fix"]
    skipped = sum(a.skipped[NOT_ASKED_TOPIC] for a in reading.ledger.accounts.values())
    assert skipped == 500 - len(reading.rows)


@pytest.mark.parametrize(
    ("content", "match"),
    [(b"", "begins with b''"), (b"SQLite format 2", "SQLite format 3"), (b"\0" * 999, "SQLite")],
)
def test_unsupported_file_is_refused_in_one_line(
    tmp_path: Path, content: bytes, match: str
) -> None:
    path = tmp_path / "a.db3"
    path.write_bytes(content)

    with pytest.raises(LogFormatError, match=match) as refused:
        open_log(path)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    "tables",
    [
        "CREATE TABLE other(a);",
        "CREATE TABLE topics(id, name, type);",
        "CREATE TABLE topics(id, name, type); CREATE VIEW messages AS WITH RECURSIVE n(topic_id, "
        "timestamp, data) AS (SELECT 1, 1, 1 UNION ALL SELECT 1, 1, 1 FROM n) SELECT * FROM n;",
    ],
)
def test_database_without_bag_tables_is_refused_with_its_tables(
    tmp_path: Path, tables: str
) -> None:
    path = tmp_path / "a.db3"
    db = sqlite3.connect(path)
    db.executescript(tables)
    db.close()

    with pytest.raises(LogFormatError, match=r"expected a table '(messages|topics)'.*it holds"):
        open_log(path)


@pytest.mark.slow
def test_locked_database_is_refused(tmp_path: Path) -> None:
    path = write_database(tmp_path / "a.db3", (1, 5, b"x"))
    writer = sqlite3.connect(path, isolation_level=None)
    writer.execute("BEGIN EXCLUSIVE")
    try:
        with pytest.raises(LogError, match="locked by another program"):
            open_db3(path)
    finally:
        writer.close()


def test_zeroed_page_drops_only_its_rows(tmp_path: Path) -> None:
    rows = rows_of(2000)
    path = db3_of(tmp_path / "bag", rows)
    content = bytearray(path.read_bytes())
    middle = len(content) // 2 // 4096 * 4096
    content[middle : middle + 4096] = bytes(4096)
    path.write_bytes(content)
    reading = read_rows(path)
    dropped = sum(account.dropped.total() for account in reading.ledger.accounts.values())

    assert len(rows) - 100 < len(reading.rows) < len(rows)
    assert not Counter(reading.rows) - Counter(rows)
    assert dropped == len(rows) - len(reading.rows)


def test_row_whose_time_contradicts_index_is_dropped(tmp_path: Path) -> None:
    rows = rows_of(300)
    path = db3_of(tmp_path / "bag", rows)
    content = path.read_bytes()
    stamp = rows[150].log_ns.to_bytes(8, "big")
    # The time is stored in the row and in the index. The row is read with its payload.
    in_row = content.index(stamp + rows[150].payload)
    path.write_bytes(content[: in_row + 7] + bytes([stamp[7] ^ 1]) + content[in_row + 8 :])
    reading = read_rows(path)

    assert Counter(rows) - Counter(reading.rows) == Counter([rows[150]])
    assert not Counter(reading.rows) - Counter(rows)
    assert [d.reason for d in reading.ledger.drops()] == ["row and time index disagree"]


@pytest.mark.slow
@settings(max_examples=25, deadline=None)
@given(fraction=st.floats(0.0, 1.0))
def test_truncated_database_yields_only_stored_rows_and_is_reported(
    tmp_path_factory: pytest.TempPathFactory, fraction: float
) -> None:
    rows = rows_of(150)
    path = db3_of(tmp_path_factory.mktemp("cut") / "bag", rows)
    content = path.read_bytes()
    path.write_bytes(content[: int(fraction * len(content))])
    try:
        reading = read_rows(path)
    except LogError:
        return

    assert not Counter(reading.rows) - Counter(rows)
    assert int(fraction * len(content)) == len(content) or not reading.ledger.is_whole


def test_large_messages_are_read_in_blocks_of_bounded_size(tmp_path: Path) -> None:
    rows = [(1, i, bytes([i]) * 3_000_000 if i % 3 == 0 else b"small") for i in range(24)]
    path = write_database(tmp_path / "a.db3", *rows)
    with open_db3(path) as log:
        blocks = list(log.read(Ledger("a")))

    assert sum(len(block) for block in blocks) == len(rows)
    for block in blocks:
        assert block.rows.stop.max() <= 12_000_000  # type: ignore[union-attr]


def test_compressed_messages_are_decompressed(tmp_path: Path) -> None:
    rows = rows_of(400)
    folder = write_folder(tmp_path / "bag", rows, compression="message")
    reading = read_rows(next(folder.glob("*.db3")))

    assert by_topic(reading.rows) == by_topic(rows)
    assert reading.ledger.is_whole


def test_damaged_compressed_message_is_dropped_and_others_are_read(tmp_path: Path) -> None:
    import zstandard

    tool = zstandard.ZstdCompressor(write_checksum=True)
    packed = [tool.compress(bytes([i]) * 500) for i in range(5)]
    packed[2] = packed[2][:-1] + bytes([packed[2][-1] ^ 1])
    path = write_database(tmp_path / "a.db3", *((1, i, blob) for i, blob in enumerate(packed)))
    reading = read_rows(path)

    assert [row.log_ns for row in reading.rows] == [0, 1, 3, 4]
    assert reading.ledger.topic("/a").dropped == {"damaged compressed message": 1}
    assert reading.ledger.topic("/a").in_file == 5


def test_compressed_message_over_size_limit_is_dropped(tmp_path: Path) -> None:
    import zstandard

    bomb = zstandard.ZstdCompressor().compress(bytes(100 << 20))
    reading = read_rows(write_database(tmp_path / "a.db3", (1, 5, bomb), (1, 6, b"\0\1\0\0")))

    assert [row.log_ns for row in reading.rows] == [6]
    assert reading.ledger.topic("/a").dropped == {"damaged compressed message": 1}


def test_messages_may_be_out_of_time_order(tmp_path: Path) -> None:
    times = [START_NS + t for t in (5, 6, 7, 8, 9, 0, 1, 2, 3, 4)]
    path = write_database(tmp_path / "a.db3", *((1, t, b"x") for t in times))

    assert [row.log_ns for row in read_rows(path).rows] == times


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


def test_undamaged_file_is_read_in_one_pass(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_database(tmp_path / "a.db3", *[(1, i, b"x" * i) for i in range(50)])

    def counted(*_: object) -> None:
        raise AssertionError("the table was gone through again")

    monkeypatch.setattr(StorageTables, "counts", counted)
    reading = read_rows(path)

    assert reading.ledger.is_whole
    assert len(reading.rows) == 50


def test_payloads_of_unselected_topics_are_not_checked(tmp_path: Path) -> None:
    path = write_database(
        tmp_path / "a.db3",
        (1, 1, b"wanted"),
        (2, 2, "no blob"),
        (2, 3, b"y"),
        (77, 4, b"orphan"),
        tables=TABLES + "INSERT INTO topics VALUES(2, '/b', 'std_msgs/msg/String', 'cdr');",
    )
    reading = read_rows(path, Selection(frozenset({"/a"})))

    assert reading.rows == (Row("/a", 1, b"wanted"),)
    accounts = reading.ledger.accounts
    # One of them is not a blob, which is not checked.
    assert accounts["/b"].skipped == {"topic not selected": 2}
    assert accounts[""].skipped == {"message without a topic": 1}
