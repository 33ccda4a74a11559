"""Describe faults of a log's clocks in plain English."""

from collections.abc import Iterator, Mapping
from datetime import UTC, datetime, timedelta
from typing import Final

from crosscue.replay.clocks.clock import Clock
from crosscue.replay.safe_text import counted

from .order import ClockStep
from .reports import MAX_OFFSET_NS, ClockReport, StampReport

SECOND_NS: Final = 1_000_000_000
DRIFT_WORTH_TELLING_PPM: Final = 50.0
DRIFT_ERRORS_WORTH_TELLING: Final = 5.0
DUPLICATES_WORTH_TELLING: Final = 0.01
# Min number of rows for a report of a clock's offset. One or two messages sent long before the
# recorder started are latched messages, not a wrong clock.
ROWS_FOR_OFFSET: Final = 3
# Distance between the times of two topics beyond which they share no clock.
APART_NS: Final = SECOND_NS

# Start of the year 2000; lower stamps do not count from 1970.
_FIRST_UTC_NS: Final = 946_684_800 * SECOND_NS
_GPS_EPOCH_S: Final = 315_964_800
_KNOWN_OFFSETS_S: Final[Mapping[int, str]] = {
    18: "GPS time counted from 1970, without leap seconds",
    37: "TAI, without leap seconds",
    18 - _GPS_EPOCH_S: "GPS time counted from 1980",
}


def is_date(t_ns: int) -> bool:
    """Return whether a log's time is a date; a clock that starts at boot counts from 0."""
    return t_ns > _FIRST_UTC_NS


def findings(reports: Mapping[str, ClockReport]) -> tuple[str, ...]:
    """Return one sentence for each fault, topic by topic.

    Times are seconds after the log's first row.
    """
    starts = [r.log.min_ns for r in reports.values() if r.log.min_ns is not None]
    start_ns = min(starts, default=0)
    reported = [s for name in sorted(reports) for s in _of_topic(reports[name], start_ns)]
    spans = {
        name: (r.log.min_ns, r.log.max_ns)
        for name, r in reports.items()
        if r.log.rows > 1 and r.log.min_ns is not None and r.log.max_ns is not None
    }
    return (*reported, *apart(spans))


def apart(spans: Mapping[str, tuple[int, int]]) -> tuple[str, ...]:
    """Return sentences about names whose time span is far from all others.

    Args:
        spans: First and last time by name.
    """
    alone = [
        name
        for name, (first, last) in spans.items()
        if all(
            other_first - last > APART_NS or first - other_last > APART_NS
            for other, (other_first, other_last) in spans.items()
            if other != name
        )
    ]
    if len(spans) < 2 or not alone:
        return ()
    if len(alone) == len(spans):
        listed = "; ".join(f"{name} {span_text(*spans[name])}" for name in sorted(spans))
        return (f"no two share a clock, or they were recorded one after the other: {listed}",)
    return tuple(
        f"{name}: overlaps in time with no other: {span_text(*spans[name])}"
        for name in sorted(alone)
    )


def span_text(first_ns: int, last_ns: int) -> str:
    """Format a span of absolute times, as dates where they count from 1970, else in seconds."""
    return f"{instant_text(first_ns)} to {instant_text(last_ns)}"


def instant_text(t_ns: int) -> str:
    """Format an absolute time, as a UTC date-time where it counts from 1970, else in seconds."""
    if t_ns < _FIRST_UTC_NS:
        return f"{t_ns / SECOND_NS:.3f} s"
    whole_s, rest_ns = divmod(t_ns, SECOND_NS)
    date = datetime.fromtimestamp(0, UTC) + timedelta(seconds=whole_s)
    return f"{date:%Y-%m-%d %H:%M:%S}.{rest_ns // 1_000_000:03d} UTC"


def duration_text(ns: float) -> str:
    """Format a duration with three digits and a suitable unit."""
    size = abs(ns)
    for unit, scale_ns in (("s", 1e9), ("ms", 1e6), ("us", 1e3)):
        if size >= scale_ns * 0.9995:
            scaled = ns / scale_ns
            return f"{scaled:.0f} {unit}" if abs(scaled) >= 999.5 else f"{scaled:.3g} {unit}"
    return f"{ns:.0f} ns"


def _of_topic(report: ClockReport, start_ns: int) -> Iterator[str]:
    name = report.topic
    yield from (f"{name}: {s}" for s in _of_order(report.log, Clock.LOG, start_ns))
    if report.log.absurd:
        rows = counted(report.log.absurd, "row")
        yield f"{name}: {rows} with a log time before 1970 or after 2115"
    gaps = report.of_used
    if gaps.gaps and gaps.longest_step_ns and gaps.longest_step_at_ns and gaps.gap_over_ns:
        offset_ns = gaps.line.offset_ns if gaps.line else 0
        at_s = (gaps.longest_step_at_ns - offset_ns - start_ns) / SECOND_NS
        yield (
            f"{name}: {counted(gaps.gaps, 'gap')} over {duration_text(gaps.gap_over_ns)}"
            f"{' (5 periods)' if gaps.is_steady else ''}, "
            f"the longest {duration_text(gaps.longest_step_ns)} at {at_s:.2f} s"
        )
    for clock, stamps in ((Clock.PUBLISH, report.publish), (Clock.HEADER, report.header)):
        if stamps is not None and not stamps.equals_log:
            yield from (f"{name}: {s}" for s in _of_other(stamps, clock, report, start_ns))


def _of_order(stamps: StampReport, clock: Clock, start_ns: int) -> Iterator[str]:
    if stamps.resets:
        yield f"{clock.value} was set back {_steps(stamps.resets, stamps.reset_steps, start_ns)}"
    if stamps.late_rows:
        yield (
            f"{counted(stamps.late_rows, 'row')} in "
            f"{counted(stamps.late_stretches, 'stretch', 'stretches')} out of "
            f"order on {clock.value}, by up to {duration_text(stamps.worst_late_ns)}"
        )
    # A recorder often stores a burst at one instant, but a sensor should not repeat a stamp.
    worth = DUPLICATES_WORTH_TELLING * stamps.rows if clock is Clock.LOG else 0
    if stamps.duplicates > worth and stamps.is_steady and not stamps.is_constant:
        yield f"{counted(stamps.duplicates, 'row')} with the {clock.value} of the row before"
    if stamps.is_constant:
        yield f"{clock.value} is the same on all {counted(stamps.rows, 'row')}"


def _of_other(
    stamps: StampReport, clock: Clock, report: ClockReport, start_ns: int
) -> Iterator[str]:
    if stamps.unset:
        yield f"{clock.value} is 0 on {stamps.unset:,} of {counted(report.count, 'row')}"
    if stamps.absurd:
        yield f"{clock.value} is absurd on {stamps.absurd:,} of {counted(report.count, 'row')}"
    yield from _of_order(stamps, clock, start_ns)
    if stamps.jumps > stamps.resets:
        steps = _steps(stamps.jumps, stamps.jump_steps, start_ns)
        yield f"{clock.value} jumps against the log clock {steps}"
    line = stamps.line
    if line is None or stamps.is_constant or stamps.rows < ROWS_FOR_OFFSET:
        return
    if abs(line.offset_ns) > MAX_OFFSET_NS:
        yield f"{clock.value} {_offset_words(line.offset_ns, line.start_log_ns)}"
    if line.drift_ppm is not None and line.drift_error_ppm is not None:
        reported = max(DRIFT_WORTH_TELLING_PPM, DRIFT_ERRORS_WORTH_TELLING * line.drift_error_ppm)
        if abs(line.drift_ppm) > reported:
            way = "fast" if line.drift_ppm > 0 else "slow"
            yield (
                f"{clock.value} runs {abs(line.drift_ppm):.0f} ppm {way} against the log clock "
                f"({abs(line.drift_ppm) * 0.06:.3g} ms a minute)"
            )


def _offset_words(offset_ns: int, log_ns: int) -> str:
    stamp_ns = log_ns + offset_ns
    if (stamp_ns < _FIRST_UTC_NS) != (log_ns < _FIRST_UTC_NS):
        names = ("counts from boot or start", "counts from 1970")
        first, second = names if stamp_ns < _FIRST_UTC_NS else names[::-1]
        return f"{first}, log time {second}: {duration_text(abs(offset_ns))} apart"
    way = "ahead of" if offset_ns > 0 else "behind"
    words = f"is {abs(offset_ns) / SECOND_NS:.3f} s {way} log time"
    nearest_s = round(offset_ns / SECOND_NS)
    for known_s, meaning in _KNOWN_OFFSETS_S.items():
        if abs(nearest_s - known_s) <= 1:
            return f"{words}: looks like {meaning}"
    hours, rest_s = divmod(abs(nearest_s), 3600)
    if 0 < hours <= 14 and rest_s <= 2:
        return f"{words}: looks like local time interpreted as UTC"
    return words


def _steps(count: int, steps: tuple[ClockStep, ...], start_ns: int) -> str:
    first = steps[0]
    at_s = (first.at_log_ns - start_ns) / SECOND_NS
    times = "once" if count == 1 else f"{count} times, first"
    return f"{times} by {duration_text(first.by_ns)} at {at_s:.2f} s"
