"""ROS 1 bags: every message of the file is read or reported as dropped."""

from __future__ import annotations

import bz2
import os
import re
import struct
from collections import Counter
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.rosbag1 import Reader

from crosscue.replay.base import Selection
from crosscue.replay.errors import LogError, LogFormatError
from crosscue.replay.ledger import NOT_ASKED_TIME, NOT_ASKED_TOPIC
from crosscue.replay.limits import Limits
from crosscue.replay.logs.opening import open_log
from crosscue.replay.readers.rosbag1.reader import open_bag
from support.data import shared
from support.rosbag_files import (
    START_NS,
    TOPICS,
    Row,
    by_topic,
    damaged_copies,
    header_field,
    judge,
    read_rows,
    record,
    rows_of,
    unclosed,
    write_bag,
)

COMPRESSIONS = ("none", "bz2", "lz4", "lz4 checked")


def u32(value: int) -> bytes:
    return struct.pack("<I", value)


def stamp(t_ns: int) -> bytes:
    return struct.pack("<II", t_ns // 10**9, t_ns % 10**9)


def connection(conn: int, topic: bytes, type_name: bytes = b"std_msgs/String") -> bytes:
    body = b"".join(
        header_field(name, value)
        for name, value in (
            (b"topic", topic),
            (b"type", type_name),
            (b"md5sum", type_name * 2),
            (b"message_definition", b"string data\n"),
        )
    )
    return record(body, op=b"\x07", conn=u32(conn), topic=topic)


def message(conn: int, t_ns: int, payload: bytes) -> bytes:
    return record(payload, op=b"\x02", conn=u32(conn), time=stamp(t_ns))


def chunk(body: bytes, compression: bytes = b"none", size: int | None = None) -> bytes:
    declared = len(body) if size is None else size
    return record(body, op=b"\x05", compression=compression, size=u32(declared))


def bag(path: Path, *records: bytes, **header: bytes) -> Path:
    fields = {"op": b"\x03", "index_pos": bytes(8), "conn_count": u32(0), "chunk_count": u32(0)}
    path.write_bytes(b"#ROSBAG V2.0\n" + record(b" " * 64, **(fields | header)) + b"".join(records))
    return path


@pytest.mark.slow
@pytest.mark.parametrize("parts", [("plotjuggler", "tilt_laser.bag"), ("sail_il", "run1.bag")])
def test_real_bags_match_rosbags(parts: tuple[str, str]) -> None:
    path = shared("bags", *parts)
    reading = read_rows(path)
    with Reader(path) as reader:
        theirs = [Row(c.topic, t, bytes(raw)) for c, t, raw in reader.messages()]
        counts = {name: topic.msgcount for name, topic in reader.topics.items()}

    assert Counter(reading.rows) == Counter(theirs)
    assert {t.name: t.declared for t in reading.log.topics} == counts
    assert reading.ledger.is_whole
    assert not reading.ledger.notices


@pytest.mark.parametrize("compression", COMPRESSIONS)
def test_every_message_is_read_in_stored_order(tmp_path: Path, compression: str) -> None:
    rows = rows_of(2000)
    reading = read_rows(write_bag(tmp_path / "a.bag", rows, compression))

    assert by_topic(reading.rows) == by_topic(rows)
    assert reading.ledger.is_whole
    assert not reading.ledger.notices
    topic = next(t for t in reading.log.topics if t.name == "/imu/data")
    assert (topic.type_name, topic.encoding, topic.schema_encoding) == (
        "sensor_msgs/Imu",
        "ros1",
        "ros1msg",
    )
    assert b"float64[9] orientation_covariance" in topic.schema


@pytest.mark.parametrize(
    ("compression", "expected"),
    [
        ("none", "have no checksum"),
        ("bz2", "bz2 checksums verified in"),
        ("lz4", "have no checksum"),
        ("lz4 checked", "lz4 checksums verified in"),
    ],
)
def test_ledger_reports_verified_checksums(tmp_path: Path, compression: str, expected: str) -> None:
    path = write_bag(tmp_path / "a.bag", rows_of(100), compression)

    assert expected in read_rows(path).ledger.integrity


@pytest.mark.parametrize("name", ["run%41.bag", "a#b.bag", "q?x=1.bag", "-rf.bag", "ü\n.bag"])
def test_unusual_file_name_opens_that_file(tmp_path: Path, name: str) -> None:
    write_bag(tmp_path / "runA.bag", rows_of(10, seed=1))
    rows = rows_of(20, seed=2)

    assert by_topic(read_rows(write_bag(tmp_path / name, rows)).rows) == by_topic(rows)


def test_non_utf8_file_name_is_opened(tmp_path: Path) -> None:
    rows = rows_of(20)
    path = tmp_path / os.fsdecode(b"caf\xe9.bag")
    write_bag(tmp_path / "plain.bag", rows).rename(path)

    assert by_topic(read_rows(path).rows) == by_topic(rows)


@pytest.mark.parametrize("suffix", [".bag", ".bag.active"])
def test_bag_of_killed_recorder_is_read_completely(tmp_path: Path, suffix: str) -> None:
    rows = rows_of(800)
    content = unclosed(write_bag(tmp_path / "a.bag", rows).read_bytes())
    path = tmp_path / f"killed{suffix}"
    path.write_bytes(content)
    reading = read_rows(path)

    assert by_topic(reading.rows) == by_topic(rows)
    assert {t.name for t in open_log(path).topics} == {name for name, _, _ in TOPICS}
    assert reading.ledger.is_whole
    assert any("did not close" in sentence for sentence in reading.ledger.notices)


@pytest.mark.parametrize(("field", "wrong"), [(b"chunk_count", 0), (b"chunk_count", -3)])
def test_wrong_chunk_count_drops_no_message(tmp_path: Path, field: bytes, wrong: int) -> None:
    rows = rows_of(800)
    path = write_bag(tmp_path / "a.bag", rows)
    content = bytearray(path.read_bytes())
    at = content.index(field + b"=") + len(field) + 1
    declared = struct.unpack_from("<I", content, at)[0]
    content[at : at + 4] = u32(declared + wrong if wrong else 0)
    path.write_bytes(content)
    reading = read_rows(path)

    assert by_topic(reading.rows) == by_topic(rows)
    assert any("chunk_count" in sentence for sentence in reading.ledger.notices)


def test_wrong_index_position_drops_no_message(tmp_path: Path) -> None:
    rows = rows_of(300)
    path = write_bag(tmp_path / "a.bag", rows)
    content = bytearray(path.read_bytes())
    at = content.index(b"index_pos=") + len(b"index_pos=")
    content[at : at + 8] = struct.pack("<Q", 2**60)
    path.write_bytes(content)
    reading = read_rows(path)

    assert by_topic(reading.rows) == by_topic(rows)
    assert reading.ledger.is_whole
    assert any("index at byte" in sentence for sentence in reading.ledger.notices)


@pytest.mark.slow
@settings(max_examples=40, deadline=None)
@given(fraction=st.floats(0.0, 1.0), compression=st.sampled_from(COMPRESSIONS))
def test_truncated_bag_yields_messages_before_cut(
    tmp_path_factory: pytest.TempPathFactory, fraction: float, compression: str
) -> None:
    rows = rows_of(300)
    folder = tmp_path_factory.mktemp("cut")
    content = write_bag(folder / "whole.bag", rows, compression).read_bytes()
    path = folder / "cut.bag"
    path.write_bytes(content[: int(fraction * len(content))])
    try:
        reading = read_rows(path)
    except LogFormatError:
        return

    whole = by_topic(rows)
    for topic, kept in by_topic(reading.rows).items():
        assert kept == whole[topic][: len(kept)]
    if len(reading.rows) < len(rows):
        assert not reading.ledger.is_whole


def test_bag_cut_in_half_yields_about_half_of_messages(tmp_path: Path) -> None:
    rows = rows_of(800)
    content = write_bag(tmp_path / "a.bag", rows).read_bytes()
    path = tmp_path / "cut.bag"
    path.write_bytes(content[: len(content) // 2])

    # The index costs some bytes, so half of the file is not exactly half of the messages.
    assert 0.4 * len(rows) < len(read_rows(path).rows) < 0.6 * len(rows)


@pytest.mark.parametrize("compression", ["bz2", "lz4 checked"])
def test_messages_of_damaged_chunk_are_counted_by_topic(tmp_path: Path, compression: str) -> None:
    rows = rows_of(600)
    path = write_bag(tmp_path / "a.bag", rows, compression)
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 0x55
    path.write_bytes(content)
    reading = read_rows(path)
    missing = Counter(row.topic for row in rows) - Counter(row.topic for row in reading.rows)

    assert missing
    dropped = {
        name: a.dropped.total() for name, a in reading.ledger.accounts.items() if a.dropped.total()
    }
    assert dropped == dict(missing)
    for name, account in reading.ledger.accounts.items():
        assert account.in_file == Counter(row.topic for row in rows)[name]


def test_damaged_record_header_drops_one_message(tmp_path: Path) -> None:
    rows = rows_of(600)
    path = write_bag(tmp_path / "a.bag", rows)
    content = bytearray(path.read_bytes())
    heads = [m.start() for m in re.finditer(rb"\x26\0\0\0\x04\0\0\0op=\x02", bytes(content))]
    at = heads[len(heads) // 2]
    content[at : at + 4] = b"\xff\xff\xff\xff"
    path.write_bytes(content)
    reading = read_rows(path)

    assert len(reading.rows) == len(rows) - 1
    assert sum(a.dropped.total() for a in reading.ledger.accounts.values()) == 1


@pytest.mark.parametrize("damage", [b"\xff\xff\xff\xff", b"\0\0\0\0"])
@pytest.mark.parametrize("of_body", [False, True])
def test_damaged_length_without_index_drops_at_most_two_messages(
    tmp_path: Path, damage: bytes, of_body: bool
) -> None:
    payloads = [b"%03d" % i * (3 + i % 5) for i in range(80)]
    body = b"".join(message(0, START_NS + i, payload) for i, payload in enumerate(payloads))
    content = bytearray(chunk(connection(0, b"/a") + body))
    at = content.index(message(0, START_NS + 40, payloads[40])) + (42 if of_body else 0)
    content[at : at + 4] = damage
    reading = read_rows(bag(tmp_path / "a.bag", bytes(content)))

    given = [row.payload for row in reading.rows]
    assert not set(given) - set(payloads)
    assert len(given) >= 78
    assert not reading.ledger.is_whole


def test_changed_connection_number_is_detected_by_index(tmp_path: Path) -> None:
    rows = rows_of(200)
    path = write_bag(tmp_path / "a.bag", rows)
    content = bytearray(path.read_bytes())
    found = list(re.finditer(rb"op=\x02\x09\0\0\0conn=(\x00)", bytes(content)))
    content[found[5].start(1)] = 1
    path.write_bytes(content)
    reading = read_rows(path)

    assert len(reading.rows) == len(rows) - 1
    assert not Counter(reading.rows) - Counter(rows)
    assert [d.reason for d in reading.ledger.drops()] == ["record and index disagree"]


def test_messages_outside_chunks_are_read(tmp_path: Path) -> None:
    path = bag(
        tmp_path / "a.bag",
        connection(3, b"/out"),
        message(3, START_NS, b"one"),
        chunk(connection(4, b"/in") + message(4, START_NS + 1, b"two")),
        message(3, START_NS + 2, b"three"),
    )

    assert read_rows(path).rows == (
        Row("/out", START_NS, b"one"),
        Row("/out", START_NS + 2, b"three"),
        Row("/in", START_NS + 1, b"two"),
    )


def _loose(count: int, begin: int) -> list[tuple[Row, bytes]]:
    """Return messages outside chunks, of two connections and several lengths."""
    made = []
    for i in range(begin, begin + count):
        conn, t_ns = i % 2, START_NS + 10_000_000 * i
        payload = bytes((7 * i + k) % 251 for k in range(20 + 5 * (i % 4)))
        made.append((Row(("/a", "/b")[conn], t_ns, payload), message(conn, t_ns, payload)))
    return made


def _unindexed(path: Path) -> tuple[Path, list[tuple[int, int, Row]]]:
    """Write an unindexed bag of messages and chunks; return it and the byte range of each row."""
    parts: list[bytes] = [connection(0, b"/a"), connection(1, b"/b")]
    places: list[tuple[int, int, Row]] = []
    at = bag(path, *parts).stat().st_size
    for i, kind in enumerate((b"", b"none", b"", b"bz2", b"")):
        rows = _loose(8, 8 * i)
        if kind:
            body = b"".join(raw for _, raw in rows)
            packed = body if kind == b"none" else bz2.compress(body)
            whole = record(packed, op=b"\x05", compression=kind, size=u32(len(body)))
            rows, stretches = [(row, b"") for row, _ in rows], [whole]
            places += [(at, at + len(whole), row) for row, _ in rows]
        else:
            stretches = [raw for _, raw in rows]
            for row, raw in rows:
                places.append((at, at + len(raw), row))
                at += len(raw)
        parts += stretches
        at += sum(map(len, stretches)) if kind else 0
    return bag(path, *parts), places


@pytest.mark.parametrize("part", range(0, 32, 8))
def test_flipped_byte_in_unindexed_bag_loses_only_reported_messages(
    tmp_path: Path, part: int
) -> None:
    path, places = _unindexed(tmp_path / "a.bag")
    whole = path.read_bytes()
    assert Counter(read_rows(path).rows) == Counter(row for *_, row in places)
    assert read_rows(path).ledger.is_whole
    begin = places[0][0]
    for at in range(begin + part, len(whole), 31):
        path.write_bytes(whole[:at] + bytes([whole[at] ^ (1 << at % 8)]) + whole[at + 1 :])
        reading = read_rows(path)

        details = [drop.detail for drop in reading.ledger.drops()]
        spans = [
            (int(a), int(b)) for d in details for a, b in re.findall(r"bytes (\d+) to (\d+)", d)
        ]
        hit = [row for start, stop, row in places if start <= at < stop]
        given = Counter(reading.rows)
        for start, stop, row in places:
            if given[row] or row in hit:
                continue
            assert any(a < stop and start < b for a, b in spans), (at, details)
        # No checksum shows a changed payload, time or connection, of one message at most.
        altered = given - Counter(row for *_, row in places)
        assert altered.total() <= 1, at
        missing = sum(not given[row] for *_, row in places)
        if missing > altered.total():
            assert not reading.ledger.is_whole, at
            assert spans or "chunk at byte" in " ".join(details), (at, details)
            assert all(a - 200 <= at for a, _ in spans), (at, spans)
        assert missing <= (8 if len(hit) == 8 else 3), (at, missing, details)


def test_header_fields_may_be_in_any_order(tmp_path: Path) -> None:
    t_ns = START_NS
    orders = [("op", "conn", "time"), ("time", "conn", "op"), ("conn", "time", "op")]
    values = {"op": b"\x02", "conn": u32(0), "time": stamp(t_ns)}
    body = b"".join(
        record(bytes([65 + i]), **{name: values[name] for name in order})
        for i, order in enumerate(orders * 40)
    )
    reading = read_rows(bag(tmp_path / "a.bag", chunk(connection(0, b"/a") + body)))

    assert [row.payload for row in reading.rows] == [bytes([65 + i]) for i in range(120)]


def test_two_types_on_one_topic_are_not_mixed(tmp_path: Path) -> None:
    path = bag(
        tmp_path / "a.bag",
        chunk(
            connection(0, b"/a")
            + connection(1, b"/a", b"std_msgs/Int8")
            + connection(2, b"/a")
            + b"".join(message(conn, START_NS, bytes([conn])) for conn in (0, 1, 2))
        ),
    )
    reading = read_rows(path)

    assert [row.payload for row in reading.rows] == [b"\0", b"\2"]
    assert reading.ledger.topic("/a").skipped == {"another message type on the same topic": 1}


def test_renamed_topic_keeps_stored_name_with_notice(tmp_path: Path) -> None:
    renamed = connection(0, b"/old").replace(b"topic=/old", b"topic=/new", 1)
    path = bag(tmp_path / "a.bag", chunk(renamed + message(0, START_NS, b"x")))
    reading = read_rows(path)

    assert reading.rows == (Row("/new", START_NS, b"x"),)
    assert any("published as /old" in sentence for sentence in reading.ledger.notices)


def test_message_of_unknown_connection_is_dropped(tmp_path: Path) -> None:
    path = bag(tmp_path / "a.bag", chunk(connection(0, b"/a") + message(9, START_NS, b"x")))
    ledger = read_rows(path).ledger

    assert ledger.topic("").dropped == {"message of an unknown connection": 1}


@pytest.mark.parametrize(
    ("content", "match"),
    [
        (b"", "begins with b''"),
        (b"#ROSBAG V1.2\n", "rosbag fix"),
        (b"#ROSBAG V2.0\n", "no readable record"),
        (b"PK\x03\x04", "format 2.0"),
    ],
)
def test_unsupported_file_is_refused_in_one_line(
    tmp_path: Path, content: bytes, match: str
) -> None:
    path = tmp_path / "a.bag"
    path.write_bytes(content)

    with pytest.raises(LogFormatError, match=match) as refused:
        open_log(path)
    assert "\n" not in str(refused.value)


def test_encrypted_bag_is_refused_with_instructions(tmp_path: Path) -> None:
    with pytest.raises(LogError, match=r"encrypted by 'rosbag/AesCbcEncryptor'.*rosbag decrypt"):
        open_log(bag(tmp_path / "a.bag", encryptor=b"rosbag/AesCbcEncryptor"))


def test_empty_bag_is_read_without_losses(tmp_path: Path) -> None:
    reading = read_rows(write_bag(tmp_path / "a.bag", []))

    assert reading.rows == ()
    assert reading.ledger.is_whole


def test_chunk_with_declared_size_over_limit_is_dropped(tmp_path: Path) -> None:
    good = chunk(connection(0, b"/a") + message(0, START_NS, b"x"))
    bomb = chunk(bz2.compress(bytes(1000)), b"bz2", size=2**32 - 1)
    reading = read_rows(bag(tmp_path / "a.bag", good, bomb, good))

    assert len(reading.rows) == 2
    assert [d.reason for d in reading.ledger.drops()] == ["chunk over the size limit"]


def test_chunk_larger_than_declared_is_dropped(tmp_path: Path) -> None:
    body = connection(0, b"/a") + message(0, START_NS, bytes(5_000_000))
    reading = read_rows(bag(tmp_path / "a.bag", chunk(bz2.compress(body), b"bz2", size=500)))

    assert reading.rows == ()
    assert not reading.ledger.is_whole


@pytest.mark.slow
def test_chunk_with_too_many_records_is_not_read_completely(tmp_path: Path) -> None:
    body = connection(0, b"/a") + message(0, START_NS, b"") * 70_000
    path = bag(tmp_path / "a.bag", chunk(bz2.compress(body), b"bz2", size=len(body)))
    limits = Limits(records_per_chunk=1000)
    from crosscue.replay.ledger import Ledger

    ledger = Ledger("a")
    with open_bag(path, limits) as log:
        rows = sum(len(block) for block in log.read(ledger))

    assert rows < 3000
    assert not ledger.is_whole


def test_time_range_is_read_and_other_messages_are_counted(tmp_path: Path) -> None:
    rows = rows_of(1000)
    path = write_bag(tmp_path / "a.bag", rows)
    start, end = rows[400].log_ns, rows[450].log_ns
    reading = read_rows(path, Selection(start_ns=start, end_ns=end))

    assert by_topic(reading.rows) == by_topic(rows[400:450])
    skipped = sum(a.skipped[NOT_ASKED_TIME] for a in reading.ledger.accounts.values())
    assert skipped == 950
    assert reading.ledger.is_whole
    # Only the chunks around the range were opened.
    assert reading.ledger.integrity.startswith(("1 chunk", "2 chunk"))


def test_unselected_topics_are_counted_as_skipped(tmp_path: Path) -> None:
    rows = rows_of(500)
    path = write_bag(tmp_path / "a.bag", rows)
    reading = read_rows(path, Selection(topics=frozenset({"/gps/fix"})))

    assert list(reading.rows) == by_topic(rows)["/gps/fix"]
    skipped = sum(a.skipped[NOT_ASKED_TOPIC] for a in reading.ledger.accounts.values())
    assert skipped == 500 - len(reading.rows)
    assert reading.ledger.is_whole


@pytest.mark.slow
@pytest.mark.parametrize("kind", [*COMPRESSIONS, "unclosed"])
def test_any_damage_is_reported(tmp_path: Path, kind: str) -> None:
    rows = rows_of(250)
    path = write_bag(tmp_path / "a.bag", rows, "none" if kind == "unclosed" else kind)
    content = path.read_bytes()
    if kind == "unclosed":
        content = unclosed(content)
        path.write_bytes(content)
    whole = read_rows(path)
    known_notices = frozenset(whole.ledger.notices)
    silent = []
    for how, copy in damaged_copies(content, cuts=60, flips=140, seed=20):
        path.write_bytes(copy)
        verdict = judge(path, whole.rows, known_notices)
        if verdict.startswith("SILENT"):
            silent.append((how, verdict))

    assert not silent
