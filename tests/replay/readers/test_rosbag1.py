"""ROS 1 bags: every message of the file is read or reported as dropped."""

import bz2
import re
import struct
from collections import Counter
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.rosbag1 import Reader

from crosscue.replay.base import Selection
from crosscue.replay.errors import LogError
from crosscue.replay.limits import Limits
from crosscue.replay.logs.opening import open_log
from crosscue.replay.readers.rosbag1 import bag_pass as rosbag1_pass
from support.accounted import read
from support.data import shared
from support.rosbag_files import (
    START_NS,
    TOPICS,
    Reading,
    Row,
    bag,
    by_topic,
    chunk,
    connection,
    faults,
    message,
    read_rows,
    record,
    rows_of,
    stamp,
    u32,
    unclosed,
    write_bag,
)
from support.trees import written


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


@pytest.mark.parametrize("suffix", [".bag", ".bag.active"])
def test_bag_of_killed_recorder_is_read_completely(tmp_path: Path, suffix: str) -> None:
    rows = rows_of(800)
    content = unclosed(write_bag(tmp_path / "a.bag", rows).read_bytes())
    path = written(tmp_path / f"killed{suffix}", content)
    reading = read_rows(path)

    assert by_topic(reading.rows) == by_topic(rows)
    assert {t.name for t in open_log(path).topics} == {name for name, _, _ in TOPICS}
    assert reading.ledger.is_whole
    assert any("did not close" in sentence for sentence in reading.ledger.notices)


@pytest.mark.parametrize("wrong", [0, -3])
def test_wrong_chunk_count_drops_no_message(tmp_path: Path, wrong: int) -> None:
    rows = rows_of(800)
    path = write_bag(tmp_path / "a.bag", rows)
    content = bytearray(path.read_bytes())
    at = content.index(b"chunk_count=") + len(b"chunk_count=")
    declared = struct.unpack_from("<I", content, at)[0]
    content[at : at + 4] = u32(declared + wrong if wrong else 0)
    path.write_bytes(content)
    reading = read_rows(path)

    assert by_topic(reading.rows) == by_topic(rows)
    assert any("chunk_count" in sentence for sentence in reading.ledger.notices)


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


@pytest.mark.slow
def test_chunk_with_too_many_records_is_not_read_completely(tmp_path: Path) -> None:
    body = connection(0, b"/a") + message(0, START_NS, b"") * 70_000
    path = bag(tmp_path / "a.bag", chunk(bz2.compress(body), b"bz2", size=len(body)))

    blocks, ledger = read(path, limits=Limits(records_per_chunk=1000))

    assert sum(map(len, blocks)) < 3000
    assert not ledger.is_whole


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["none", "bz2", "lz4", "lz4 checked", "unclosed"])
def test_any_damage_is_reported(tmp_path: Path, kind: str) -> None:
    rows = rows_of(250)
    path = write_bag(tmp_path / "a.bag", rows, "none" if kind == "unclosed" else kind)
    if kind == "unclosed":
        path.write_bytes(unclosed(path.read_bytes()))
    whole = read_rows(path)

    assert not faults(path, whole.rows, 20, frozenset(whole.ledger.notices))


def test_encrypted_bag_is_refused_with_instructions(tmp_path: Path) -> None:
    with pytest.raises(LogError, match=r"encrypted by 'rosbag/AesCbcEncryptor'.*rosbag decrypt"):
        open_log(bag(tmp_path / "a.bag", encryptor=b"rosbag/AesCbcEncryptor"))


MS = 1_000_000
BOUND = st.none() | st.integers(-50, 450).map(lambda ms: START_NS + ms * MS)


def read_by_complete_pass(path: Path, selection: Selection) -> Reading:
    """Read the range by a complete pass over all chunks."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rosbag1_pass, "find_bag_window", lambda *_: "a test")
        return read_rows(path, selection)


@pytest.mark.slow
@given(
    seed=st.integers(0, 1000),
    mixed=st.sampled_from([0, 3, 300]),
    compression=st.sampled_from(["none", "bz2", "lz4"]),
    selection=st.builds(
        Selection,
        st.none() | st.frozensets(st.sampled_from(["/can", "/gps/fix", "/none"])),
        BOUND,
        BOUND,
    ),
)
@settings(max_examples=60)
def test_time_range_yields_same_rows_as_complete_pass(
    seed: int, mixed: int, compression: str, selection: Selection
) -> None:
    rows = rows_of(300, seed)
    # Out of order by up to `mixed` places, so that chunks overlap in time.
    order = np.argsort(np.arange(300) + np.random.default_rng(seed).uniform(0, mixed, 300))
    rows = [rows[i] for i in order]
    with TemporaryDirectory() as folder:
        path = write_bag(Path(folder) / "a.bag", rows, compression, chunk_bytes=2000)
        ours, whole = read_rows(path, selection), read_by_complete_pass(path, selection)

    kept = [
        row
        for row in rows
        if selection.wants(row.topic)
        and (selection.start_ns is None or row.log_ns >= selection.start_ns)
        and (selection.end_ns is None or row.log_ns < selection.end_ns)
    ]
    assert by_topic(ours.rows) == by_topic(kept) == by_topic(whole.rows)
    assert ours.ledger.accounts == whole.ledger.accounts
    assert ours.ledger.is_whole


def test_chunks_outside_time_range_are_not_read(tmp_path: Path) -> None:
    rows = rows_of(1000)
    path = write_bag(tmp_path / "a.bag", rows)
    content = bytearray(path.read_bytes())
    # Everything before the middle except the bag's header, and well before the range.
    content[5000 : len(content) // 3] = b"\xff" * (len(content) // 3 - 5000)
    path.write_bytes(content)

    reading = read_rows(path, Selection(start_ns=rows[700].log_ns, end_ns=rows[710].log_ns))

    assert by_topic(reading.rows) == by_topic(rows[700:710])
    assert reading.ledger.is_whole
    assert "chunks" in reading.ledger.integrity
    assert reading.ledger.integrity.endswith("the rest was not")


def test_wrong_time_in_index_is_detected(tmp_path: Path) -> None:
    rows = rows_of(400)
    path = write_bag(tmp_path / "a.bag", rows, chunk_bytes=2000)
    content = path.read_bytes()
    ends = [row for row in rows if content.count(b"end_time=" + stamp(row.log_ns)) == 1]
    last, middle = ends[len(ends) // 2], rows.index(ends[len(ends) // 2]) - 1
    # The index states an end one message too early, and the chunks are still in order.
    changed = content.replace(
        b"end_time=" + stamp(last.log_ns), b"end_time=" + stamp(rows[middle].log_ns)
    )
    path.write_bytes(changed)

    reading = read_rows(path, Selection(start_ns=last.log_ns))

    assert by_topic(reading.rows) == by_topic(rows[middle + 1 :])
    assert any("every chunk was examined" in notice for notice in reading.ledger.notices)
    assert reading.ledger.is_whole
