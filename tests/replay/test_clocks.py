"""Clocks: the report recovers the faults of simulated streams."""

from __future__ import annotations

import re
import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crosscue.replay.clocks.clock import Clock, times_of
from crosscue.replay.clocks.order import forward_max, forward_min
from crosscue.replay.clocks.periods import PeriodSketch
from crosscue.replay.clocks.reports import ClockWatch, StampReport
from crosscue.replay.columns import Int64s
from support.clock_streams import SECOND_NS, START_NS, Stream, table_of, watch, watch_stream

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


def test_drift_error_matches_actual_error() -> None:
    scaled = []
    for seed in range(60):
        line = header_report(Stream(1200, drift_ppm=80.0, wait_ns=4 * MS, seed=seed)).line
        assert line is not None
        assert line.drift_ppm is not None
        assert line.drift_error_ppm is not None
        scaled.append((line.drift_ppm - 80.0) / line.drift_error_ppm)

    assert 0.6 < np.std(scaled) < 2.0


@quick
@given(
    rows=st.lists(st.integers(0, 11), unique=True, max_size=4),
    by_ms=st.lists(st.integers(60, 140) | st.integers(170, 40_000), min_size=4, max_size=4),
    signs=st.lists(st.sampled_from([-1, 1]), min_size=4, max_size=4),
    rows_per_block=st.sampled_from([17, 50, 700, 5000]),
)
def test_clock_jumps_are_counted_and_located(
    rows: list[int], by_ms: list[int], signs: list[int], rows_per_block: int
) -> None:
    jumps = {100 + 140 * r: m * MS * s for r, m, s in zip(sorted(rows), by_ms, signs, strict=False)}
    stream = Stream(1900, 50 * MS, 3 * SECOND_NS, 40.0, 2 * MS, jumps)

    header = header_report(stream, rows_per_block)

    log_ns = stream.log_ns()
    assert header.jumps == len(jumps)
    for step, (row, by_ns) in zip(header.jump_steps, jumps.items(), strict=True):
        assert step.at_log_ns == log_ns[row]
        assert abs(step.by_ns - by_ns) < 10 * MS
    # A clock set back by over three periods is detected; a smaller step might be late rows.
    assert header.resets == sum(by_ns < -160 * MS for by_ns in jumps.values())
    assert header.line is not None
    assert header.line.drift_ppm == pytest.approx(40.0, abs=60.0)


def test_stalled_recorder_is_not_reported_as_jump() -> None:
    stream = Stream(20_000, 1 * MS, wait_ns=MS // 10)
    log_ns = stream.log_ns()
    stalled = (log_ns > log_ns[8000]) & (log_ns < log_ns[8000] + SECOND_NS)
    log_ns[stalled] = log_ns[8000] + SECOND_NS

    header = watch(table_of("/s", log_ns, stream.header_ns())).header

    assert header is not None
    assert header.jumps == 0
    assert header.gaps == 0
    assert log_report(log_ns).gaps == 1


def test_report_does_not_depend_on_block_size() -> None:
    stream = Stream(9000, 10 * MS, 5 * MS, -30.0, MS, {4000: -SECOND_NS, 7000: 80 * MS})

    assert watch_stream(stream, 9000) == watch_stream(stream, 37) == watch_stream(stream, 1)


def test_report_is_available_before_the_end() -> None:
    stream = Stream(9000, 10 * MS, wait_ns=MS)
    block = table_of("/s", stream.log_ns(), stream.header_ns())
    clock_watch = ClockWatch()
    clock_watch.see(block.take(slice(0, 5000)))
    half = clock_watch.reports()["/s"]
    clock_watch.see(block.take(slice(5000, 9000)))

    assert half == watch(block.take(slice(0, 5000)), 5000)
    assert clock_watch.reports()["/s"].count == 9000


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


def test_gaps_beyond_the_kept_ones_are_counted() -> None:
    steps = np.full(60_000, 10 * MS)
    steps[::10] = 100 * MS
    log = log_report(START_NS + np.cumsum(steps), 60_000)

    assert log.gaps == 6000 - 1


@pytest.mark.slow
@quick
@given(
    rows=st.lists(st.integers(1, 180), unique=True, max_size=20),
    repeats=st.integers(1, 3),
    rows_per_block=st.sampled_from([1, 100, 2000]),
)
def test_duplicates_are_counted_exactly(rows: list[int], repeats: int, rows_per_block: int) -> None:
    log_ns = steady()
    repeated = np.repeat(
        log_ns, np.where(np.isin(np.arange(2000), [10 * r for r in rows]), 1 + repeats, 1)
    )

    assert log_report(repeated, rows_per_block).duplicates == repeats * len(rows)


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


def test_clock_restarted_at_zero_is_reset_without_gap() -> None:
    log_ns = np.concatenate([steady(500), np.arange(1, 501) * 10 * MS])

    log = log_report(log_ns)

    assert log.resets == 1
    assert log.reset_steps[0].at_log_ns == 10 * MS
    assert (log.gaps, log.late_rows, log.longest_step_ns) == (0, 0, 10 * MS)


def test_gap_after_reset_is_counted() -> None:
    after = np.arange(1, 501) * 10 * MS
    after[300:] += SECOND_NS
    log = log_report(np.concatenate([steady(500), after]))

    assert (log.resets, log.gaps) == (1, 1)
    assert log.longest_step_ns == SECOND_NS + 10 * MS


def test_changing_clock_rate_increases_drift_error() -> None:
    stream = Stream(1200, 50 * MS, wait_ns=MS)
    bent_ns = stream.header_ns()
    bent_ns[600:] += np.arange(600) * 10_000

    straight, bent = (
        header_report(stream).line,
        watch(table_of("/s", stream.log_ns(), bent_ns)).header,
    )

    assert straight is not None
    assert straight.drift_error_ppm is not None
    assert bent is not None
    assert bent.line is not None
    assert bent.line.drift_error_ppm is not None
    assert straight.drift_error_ppm < 5.0
    assert bent.line.drift_error_ppm == pytest.approx(200.0 / 4.0, rel=0.2)


def test_strictly_decreasing_times_yield_resets() -> None:
    log = log_report(steady(200_000)[::-1], 50_000)

    assert log.rows == 200_000
    assert log.resets == pytest.approx(200_000 / 128, rel=0.01)
    assert log_report(steady(20_000)[::-1], 5_000) == log_report(steady(20_000)[::-1], 777)


@pytest.mark.parametrize(
    ("header", "unset", "why"),
    [
        (np.zeros(2000, dtype=np.int64), 2000, "is never set"),
        (np.full(2000, START_NS), 0, "never changes"),
        (np.where(np.arange(2000) % 2, steady(), 0), 1000, "missing on 1000 of 2000"),
        (steady() - START_NS, 1, "off the log clock"),
        (steady()[::-1], 0, "was set back"),
        (steady() + np.arange(2000) * 20_000, 0, r"drifts \+2000 ppm"),
        (np.concatenate([steady()[:900], steady()[900:] + SECOND_NS]), 0, "jumps 1 times"),
    ],
    ids=["zero", "constant", "half", "boot", "backwards", "drift", "jump"],
)
def test_inconsistent_header_stamp_is_not_used(header: Int64s, unset: int, why: str) -> None:
    report = watch(table_of("/s", steady(), header.astype(np.int64)))

    assert report.used is Clock.LOG
    assert re.search(why, report.why)
    assert report.header is not None
    assert report.header.unset == unset


def test_header_stamp_is_preferred_then_publish_time() -> None:
    log_ns = steady()
    good, bad = log_ns - 3 * MS, log_ns - 37 * SECOND_NS

    assert watch(table_of("/s", log_ns, good, good)).used is Clock.HEADER
    assert watch(table_of("/s", log_ns, bad, good)).used is Clock.PUBLISH
    assert "header stamp is -37.0" in watch(table_of("/s", log_ns, bad, good)).why
    assert watch(table_of("/s", log_ns, bad, log_ns)).used is Clock.LOG
    assert watch(table_of("/s", log_ns, bad, bad)).used is Clock.LOG
    assert watch(table_of("/s", log_ns)).why == "no other clock in the log"


def test_unset_header_stamps_fall_back_to_log_time() -> None:
    log_ns = steady(4)
    header = log_ns - 7
    header[1], header[2] = 0, -5
    block = table_of("/s", log_ns, header)

    np.testing.assert_array_equal(
        times_of(block, Clock.HEADER), [header[0], log_ns[1], log_ns[2], header[3]]
    )
    np.testing.assert_array_equal(times_of(block, Clock.PUBLISH), log_ns)


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


@quick
@given(st.lists(st.integers(-(2**63), 2**63 - 1), min_size=1, max_size=60), st.integers(1, 70))
def test_forward_windows_return_max_and_min(values: list[int], width: int) -> None:
    column = np.array(values, dtype=np.int64)

    assert forward_max(column, width).tolist() == [
        max(values[i : i + width]) for i in range(len(values))
    ]
    assert forward_min(column, width).tolist() == [
        min(values[i : i + width]) for i in range(len(values))
    ]


@quick
@given(st.lists(st.integers(0, 2**61), min_size=1, max_size=300), st.floats(0.0, 1.0))
def test_quantile_is_accurate_to_one_bin(steps: list[int], fraction: float) -> None:
    sketch = PeriodSketch()
    sketch.add(np.array(steps, dtype=np.int64), np.arange(len(steps), dtype=np.int64))

    exact = sorted(steps)[int(fraction * (len(steps) - 1))]
    assert sketch.quantile_ns(fraction) == pytest.approx(exact, rel=0.023, abs=1.0)


def test_irregular_stream_has_no_gaps() -> None:
    steps = np.random.default_rng(3).exponential(2 * MS, 50_000).astype(np.int64)
    log = log_report(START_NS + np.cumsum(steps), 50_000)

    assert not log.is_steady
    assert log.gaps == 0


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
