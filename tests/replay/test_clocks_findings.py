"""Faults of clocks are reported, and nothing is reported for a healthy log."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from crosscue.replay.clocks.findings import findings
from crosscue.replay.clocks.reports import ClockWatch
from crosscue.replay.columns import Block, Int64s
from support.clock_streams import SECOND_NS, START_NS, Stream, table_of

MS = 1_000_000
STREAM = Stream(1200, 50 * MS, wait_ns=2 * MS)


def findings_of(*blocks: Block) -> tuple[str, ...]:
    clock_watch = ClockWatch()
    for block in blocks:
        clock_watch.see(block)
    return findings(clock_watch.reports())


def with_header(header_ns: Int64s) -> Block:
    return table_of("/camera", STREAM.log_ns(), header_ns)


@pytest.mark.parametrize(
    ("ahead_ns", "words"),
    [
        (37 * SECOND_NS, "37.000 s ahead of log time: looks like TAI, without leap seconds"),
        (18 * SECOND_NS, "looks like GPS time counted from 1970"),
        (-(315_964_800 - 18) * SECOND_NS, "looks like GPS time counted from 1980"),
        (7200 * SECOND_NS, "looks like local time interpreted as UTC"),
        (-5 * SECOND_NS, "is 5.000 s behind log time"),
        (12 * SECOND_NS - START_NS, "counts from boot or start, log time counts from 1970"),
    ],
)
def test_different_epoch_is_identified(ahead_ns: int, words: str) -> None:
    (reported,) = findings_of(with_header(STREAM.header_ns() + ahead_ns))

    assert reported.startswith("/camera: header stamp ")
    assert words in reported


def test_faulty_header_stamp_is_reported() -> None:
    drifting = replace(STREAM, drift_ppm=200.0).header_ns()
    jumping = replace(STREAM, jumps={600: 4 * SECOND_NS}).header_ns()
    set_back = replace(STREAM, jumps={600: -4 * SECOND_NS}).header_ns()

    assert findings_of(with_header(np.zeros(1200, dtype=np.int64))) == (
        "/camera: header stamp is 0 on 1200 of 1200 rows",
    )
    assert findings_of(with_header(np.full(1200, START_NS))) == (
        "/camera: header stamp is the same on all 1200 rows",
    )
    assert findings_of(with_header(drifting)) == (
        "/camera: header stamp runs 200 ppm fast against the log clock (12 ms a minute)",
    )
    assert findings_of(with_header(jumping)) == (
        "/camera: header stamp jumps against the log clock once by 4 s at 30.00 s",
    )
    assert findings_of(with_header(set_back)) == (
        "/camera: header stamp was set back once by -3.95 s at 30.00 s",
    )


def test_topics_without_common_clock_are_reported() -> None:
    boot = STREAM.log_ns() - START_NS

    apart_all = findings_of(table_of("/can", boot), table_of("/camera", STREAM.log_ns()))
    one_apart = findings_of(
        table_of("/can", boot),
        table_of("/camera", STREAM.log_ns()),
        table_of("/imu", STREAM.log_ns() + 50 * MS),
    )

    assert len(apart_all) == 1
    assert apart_all[0].startswith("no two share a clock")
    assert "/can 0.00" in apart_all[0]
    assert "2025-11-13 02:13:20" in apart_all[0]
    assert [s.split(":")[0] for s in one_apart] == ["/can"]


@given(
    st.lists(
        st.tuples(*[st.integers(-(2**63), 2**63 - 1) | st.integers(0, 10**11)] * 3), max_size=60
    )
)
def test_findings_of_arbitrary_times_are_printable(rows: list[tuple[int, int, int]]) -> None:
    columns = np.array(rows, dtype=np.int64).reshape(-1, 3)

    reported = findings_of(table_of("/a", *columns.T), table_of("/b", columns[:, 1]))

    for sentence in reported:
        assert sentence.isprintable()
        assert "nan" not in sentence
