"""Clocks of a log: gaps, offsets and what is found."""

import re
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crosscue.replay.clocks.clock import Clock
from crosscue.replay.clocks.findings import findings
from crosscue.replay.clocks.reports import ClockWatch, StampReport
from crosscue.replay.columns import Block, Int64s
from support.memory_log import SECOND_NS, START_NS, Stream, table_of, watch, watch_stream

MS = 1_000_000
quick = settings(max_examples=40, deadline=None)


def header_report(stream: Stream, rows_per_block: int = 700) -> StampReport:
    header = watch_stream(stream, rows_per_block).header
    assert header is not None
    return header


def log_report(log_ns: Int64s, rows_per_block: int = 700) -> StampReport:
    return watch(table_of("/s", log_ns), rows_per_block).log


def steady(rows: int = 2000, period_ns: int = 10 * MS) -> Int64s:
    return START_NS + period_ns * np.arange(rows, dtype=np.int64)


@quick
@given(
    offset_ns=st.integers(-(10**18), 10**17),
    drift_ppm=st.floats(-500.0, 500.0),
    wait_ns=st.integers(0, 5 * MS),
    period_ns=st.sampled_from([1 * MS, 10 * MS, 50 * MS, 100 * MS]),
    seed=st.integers(0, 1000),
)
def test_simulated_offset_and_drift_are_estimated(
    offset_ns: int, drift_ppm: float, wait_ns: int, period_ns: int, seed: int
) -> None:
    rows = 60_000 * MS // period_ns
    header = header_report(Stream(rows, period_ns, offset_ns, drift_ppm, wait_ns, seed=seed))

    line = header.line
    assert line is not None
    assert line.drift_ppm is not None
    assert line.drift_error_ppm is not None
    assert line.drift_ppm == pytest.approx(drift_ppm, abs=0.2 + wait_ns / MS * 8.0)
    assert abs(line.drift_ppm - drift_ppm) < 0.2 + 6.0 * line.drift_error_ppm
    assert abs(line.offset_ns - offset_ns) < 0.2 * MS + wait_ns
    assert header.jumps == header.resets == 0


@quick
@given(
    gaps=st.dictionaries(st.integers(1, 1998), st.integers(600, 5000), max_size=60),
    rows_per_block=st.sampled_from([1, 100, 2000]),
)
def test_gaps_are_counted_exactly(gaps: dict[int, int], rows_per_block: int) -> None:
    log_ns = steady()
    for row, percent in gaps.items():
        log_ns[row + 1 :] += percent * 100_000

    log = log_report(log_ns, rows_per_block)

    assert log.median_period_ns == 10 * MS
    assert log.gaps == len(gaps)
    if gaps:
        longest_ns = 10 * MS + max(gaps.values()) * 100_000
        row = min(r for r, p in gaps.items() if p == max(gaps.values()))
        assert (log.longest_step_ns, log.longest_step_at_ns) == (longest_ns, log_ns[row])


@pytest.mark.slow
@quick
@given(
    stretches=st.dictionaries(
        st.integers(0, 16), st.tuples(st.integers(1, 20), st.integers(21, 50)), max_size=8
    ),
    rows_per_block=st.sampled_from([1, 113, 2000]),
)
def test_late_rows_are_counted_exactly_and_are_not_gaps(
    stretches: dict[int, tuple[int, int]], rows_per_block: int
) -> None:
    """A few rows are stored later by a number of places, with unchanged stamps."""
    order = np.arange(2000)
    for place, (n, late) in stretches.items():
        row = 100 + 110 * place
        order[row : row + n + late] = np.concatenate(
            [np.arange(row + n, row + n + late), np.arange(row, row + n)]
        )

    log = log_report(steady()[order], rows_per_block)

    assert log.late_rows == sum(n for n, _ in stretches.values())
    assert log.late_stretches == len(stretches)
    worst = max((n + late - 1 for n, late in stretches.values()), default=0)
    assert log.worst_late_ns == worst * 10 * MS
    assert (log.gaps, log.resets, log.duplicates) == (0, 0, 0)
    assert log.longest_step_ns == 10 * MS


@pytest.mark.slow
@quick
@given(
    rows=st.lists(st.integers(0, 8), unique=True, max_size=5),
    back_ns=st.integers(31 * MS, START_NS // 10),
    rows_per_block=st.sampled_from([1, 113, 2000]),
)
def test_clock_set_back_is_counted_only_as_reset(
    rows: list[int], back_ns: int, rows_per_block: int
) -> None:
    log_ns = steady()
    for row in rows:
        log_ns[200 * row + 150 :] -= back_ns

    log = log_report(log_ns, rows_per_block)

    assert log.resets == len(rows)
    assert {s.by_ns for s in log.reset_steps} <= {10 * MS - back_ns}
    assert (log.late_rows, log.gaps, log.duplicates) == (0, 0, 0)


@pytest.mark.parametrize(
    ("header", "unset", "why"),
    [
        (np.zeros(2000, dtype=np.int64), 2000, "is never set"),
        (np.full(2000, START_NS), 0, "never changes"),
        (np.where(np.arange(2000) % 2, steady(), 0), 1000, "missing on 1,000 of 2,000"),
        (steady() - START_NS, 1, "off the log clock"),
        (steady()[::-1], 0, "was set back"),
        (steady() + np.arange(2000) * 20_000, 0, r"drifts \+2000 ppm"),
        (np.concatenate([steady()[:900], steady()[900:] + SECOND_NS]), 0, "jumps 1 time against"),
    ],
    ids=["zero", "constant", "half", "boot", "backwards", "drift", "jump"],
)
def test_inconsistent_header_stamp_is_not_used(header: Int64s, unset: int, why: str) -> None:
    report = watch(table_of("/s", steady(), header.astype(np.int64)))

    assert report.used is Clock.LOG
    assert re.search(why, report.why)
    assert report.header is not None
    assert report.header.unset == unset


@quick
@given(st.lists(st.integers(-(2**63), 2**63 - 1), max_size=300), st.integers(1, 200))
def test_arbitrary_stamps_cause_no_overflow(stamps: list[int], per_block: int) -> None:
    wild = np.array(stamps, dtype=np.int64)
    log_ns = steady(len(stamps))

    with np.errstate(all="raise"):
        forward = watch(table_of("/s", log_ns, wild, wild), per_block)
        backward = watch(table_of("/s", wild, log_ns, wild), per_block)

    for report in (forward, backward):
        for stamp in (report.log, report.header, report.publish):
            assert stamp is not None
            assert stamp.rows + stamp.absurd + stamp.unset == len(stamps)
            assert stamp.longest_step_ns is None or stamp.longest_step_ns >= 0


def test_memory_is_independent_of_log_length() -> None:
    def peak(blocks: int) -> int:
        clock_watch = ClockWatch()
        tracemalloc.start()
        for i in range(blocks):
            log_ns = steady(5000, 10 * MS) + i * 50 * SECOND_NS
            clock_watch.see(table_of("/s", log_ns, log_ns - MS))
        _, top = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        return top

    peak(2)
    assert peak(80) < 1.5 * peak(8)


def test_gaps_beyond_the_kept_ones_are_counted() -> None:
    steps = np.full(60_000, 10 * MS)
    steps[::10] = 100 * MS
    log = log_report(START_NS + np.cumsum(steps), 60_000)

    assert log.gaps == 6000 - 1


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
        "/camera: header stamp is 0 on 1,200 of 1,200 rows",
    )
    assert findings_of(with_header(np.full(1200, START_NS))) == (
        "/camera: header stamp is the same on all 1,200 rows",
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
