"""A time range of a ROS 1 bag: the same rows as from a complete pass, with only the range read."""

from __future__ import annotations

import struct
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crosscue.replay.base import Selection
from crosscue.replay.readers.rosbag1 import bag_pass as rosbag1_pass
from support.rosbag_files import START_NS, Reading, by_topic, read_rows, rows_of, write_bag

MS = 1_000_000
BOUND = st.none() | st.integers(-50, 450).map(lambda ms: START_NS + ms * MS)


def stamp(t_ns: int) -> bytes:
    return struct.pack("<II", t_ns // 10**9, t_ns % 10**9)


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
    topics=st.none() | st.frozensets(st.sampled_from(["/can", "/gps/fix", "/none"])),
    start_ns=BOUND,
    end_ns=BOUND,
)
@settings(max_examples=60)
def test_time_range_yields_same_rows_as_complete_pass(
    seed: int,
    mixed: int,
    compression: str,
    topics: frozenset[str] | None,
    start_ns: int | None,
    end_ns: int | None,
) -> None:
    rows = rows_of(300, seed)
    # Out of order by up to `mixed` places, so that chunks overlap in time.
    order = np.argsort(np.arange(300) + np.random.default_rng(seed).uniform(0, mixed, 300))
    rows = [rows[i] for i in order]
    selection = Selection(topics, start_ns, end_ns)
    with TemporaryDirectory() as folder:
        path = write_bag(Path(folder) / "a.bag", rows, compression, chunk_bytes=2000)
        ours, whole = read_rows(path, selection), read_by_complete_pass(path, selection)

    kept = [
        row
        for row in rows
        if selection.wants(row.topic)
        and (start_ns is None or row.log_ns >= start_ns)
        and (end_ns is None or row.log_ns < end_ns)
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
