"""Report on the three clocks of every topic, and choose one of them.

A recording may store up to three times for a row: the *log time* (when the recorder stored it), the
*publish time* (when the sender sent it) and the *header stamp* (of the sensor). ``ClockWatch``
accepts blocks as they are read, in bounded memory, and creates a ``ClockReport`` for every topic.

``choose_clock`` implements the rule. The header stamp is used if it agrees with the log clock, else
the publish time if it agrees, else the log time. A clock agrees if

* at least 99 % of the rows carry it, and it moves;
* it was never set back, never jumps, and at most 1 % of its rows are late;
* it is within one second of the log clock, and drifts less than 1000 ppm from it.

A publish time that always equals the log time carries no information and is ignored.

All times are int64 nanoseconds; differences are computed before any conversion to float.
"""

import copy
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from crosscue.replay.columns import Block, Int64s
from crosscue.replay.safe_text import counted

from .clock import LATEST_NS, Clock
from .offset import ClockLine, OffsetWatch
from .order import ClockStep, OrderWatch

GAP_PERIODS: Final = 5
MAX_OFFSET_NS: Final = 1_000_000_000
MAX_DRIFT_PPM: Final = 1000.0
MIN_SHARE: Final = 0.99
MAX_LATE_SHARE: Final = 0.01

_STEADY_RATIO: Final = 2.5
_PERIODS_FOR_GAPS: Final = 8
_BATCH_ROWS: Final = 4096


@dataclass(frozen=True, slots=True)
class StampReport:
    """One clock of one topic.

    Attributes:
        rows: Rows with a usable stamp.
        unset: Rows whose stamp is 0, which means unset for publish times and header stamps.
        absurd: Rows whose stamp is negative or after the year 2115.
        first_ns: Stamp of the first row, in stored order; None without rows, as all below.
        last_ns: Stamp of the last row.
        min_ns: The lowest stamp.
        max_ns: The highest stamp.
        is_constant: True if there are several rows and all have the same stamp.
        duplicates: Rows with the stamp of the previous row.
        resets: Number of times that the clock was set back.
        reset_steps: The first resets.
        late_rows: Rows with a stamp below that of an earlier row, without resets.
        late_stretches: Runs of late rows.
        worst_late_ns: Largest delay of a late row.
        median_period_ns: Median step between sorted stamps.
        is_steady: True if nine of ten steps are below 2.5 median periods, unlike bursts.
        gap_over_ns: Min length of a gap: 5 median periods, or, if the topic is not steady, 5 times
            its 99th percentile; None with fewer than 8 periods.
        gaps: Number of steps longer than ``gap_over_ns``.
        longest_step_ns: The longest step.
        longest_step_at_ns: The stamp at which the longest step begins.
        line: Offset and drift relative to the log clock; None for the log clock itself.
        jumps: Number of jumps of its offset, including resets.
        jump_steps: The first jumps.
        equals_log: True if every stamp equals its row's log time.
    """

    rows: int
    unset: int
    absurd: int
    first_ns: int | None
    last_ns: int | None
    min_ns: int | None
    max_ns: int | None
    is_constant: bool
    duplicates: int
    resets: int
    reset_steps: tuple[ClockStep, ...]
    late_rows: int
    late_stretches: int
    worst_late_ns: int
    median_period_ns: int | None
    is_steady: bool
    gap_over_ns: int | None
    gaps: int
    longest_step_ns: int | None
    longest_step_at_ns: int | None
    line: ClockLine | None
    jumps: int
    jump_steps: tuple[ClockStep, ...]
    equals_log: bool


@dataclass(frozen=True, slots=True)
class ClockReport:
    """The clocks of one topic.

    Attributes:
        topic: Name of the topic.
        count: Number of rows.
        used: The clock to use.
        why: Reason for the choice, in plain English.
        log: The log time.
        publish: The publish time, or None if the format has none.
        header: The header stamp, or None if the rows have none.
    """

    topic: str
    count: int
    used: Clock
    why: str
    log: StampReport
    publish: StampReport | None
    header: StampReport | None

    @property
    def of_used(self) -> StampReport:
        """Report on the clock that is used."""
        by_clock = {Clock.LOG: self.log, Clock.PUBLISH: self.publish, Clock.HEADER: self.header}
        return by_clock[self.used] or self.log

    @property
    def duration_ns(self) -> int:
        """Time from the lowest to the highest stamp of the clock that is used."""
        stamps = self.of_used
        return (stamps.max_ns or 0) - (stamps.min_ns or 0)

    @property
    def rate_hz(self) -> float | None:
        """Mean rate over the duration, or None if it is undefined."""
        rows, span_ns = self.of_used.rows, self.duration_ns
        return (rows - 1) / (span_ns * 1e-9) if rows > 1 and span_ns > 0 else None


class ClockWatch:
    """Incremental analysis of the clocks of every topic of one log."""

    def __init__(self) -> None:
        self._topics: dict[str, _TopicWatch] = {}

    def see(self, block: Block) -> None:
        """Add a block; the blocks of a topic must be in stored order."""
        if block.topic not in self._topics:
            self._topics[block.topic] = _TopicWatch()
        self._topics[block.topic].see(block)

    def reports(self) -> Mapping[str, ClockReport]:
        """Return the reports so far, by topic; more blocks may follow."""
        return {name: copy.deepcopy(t).finish(name) for name, t in self._topics.items()}


def choose_clock(
    count: int, log: StampReport, publish: StampReport | None, header: StampReport | None
) -> tuple[Clock, str]:
    """Return the clock to use for a topic of ``count`` rows, and the reason in plain English.

    The rule is described at the head of this module. ``log`` is used if no other clock agrees.
    """
    against: list[str] = []
    for clock, stamps in ((Clock.HEADER, header), (Clock.PUBLISH, publish)):
        if stamps is None or stamps.equals_log:
            continue
        reason = _disagreement(count, stamps)
        if reason is None:
            return clock, "; ".join([*against, f"{clock.value} agrees with the log clock"])
        against.append(f"{clock.value} {reason}")
    if not log.rows:
        against.append("no usable time")
    return Clock.LOG, "; ".join(against) or "no other clock in the log"


def _disagreement(count: int, stamps: StampReport) -> str | None:
    """Return the reason why a clock cannot replace the log clock, or None."""
    line = stamps.line
    if not stamps.rows or line is None:
        return "is never set"
    if stamps.rows < MIN_SHARE * count:
        return f"is missing on {count - stamps.rows:,} of {counted(count, 'row')}"
    if stamps.is_constant:
        return "never changes"
    if stamps.resets:
        return f"was set back {counted(stamps.resets, 'time')}"
    if stamps.jumps:
        return f"jumps {counted(stamps.jumps, 'time')} against the log clock"
    if stamps.late_rows > MAX_LATE_SHARE * stamps.rows:
        return f"is out of order on {counted(stamps.late_rows, 'row')}"
    if abs(line.offset_ns) > MAX_OFFSET_NS:
        return f"is {line.offset_ns * 1e-9:+.3f} s off the log clock"
    if line.drift_ppm is not None and abs(line.drift_ppm) > MAX_DRIFT_PPM:
        return f"drifts {line.drift_ppm:+.0f} ppm"
    return None


@dataclass(slots=True)
class _StampWatch:
    """Incremental analysis of one clock of one topic."""

    is_log: bool = False
    order: OrderWatch = field(default_factory=OrderWatch)
    offset: OffsetWatch = field(default_factory=OffsetWatch)
    unset: int = 0
    absurd: int = 0
    equals_log: bool = True

    def add(self, log_ns: Int64s, stamps_ns: Int64s) -> None:
        """Add rows, shape (N,) each."""
        usable = (stamps_ns >= 0) & (stamps_ns < LATEST_NS)
        self.absurd += len(stamps_ns) - int(np.count_nonzero(usable))
        if not self.is_log:
            is_set = stamps_ns != 0
            self.unset += len(stamps_ns) - int(np.count_nonzero(is_set))
            usable &= is_set
            self.equals_log = self.equals_log and bool(np.array_equal(log_ns, stamps_ns))
        if not usable.all():
            log_ns, stamps_ns = log_ns[usable], stamps_ns[usable]
        self.order.add(stamps_ns, log_ns)
        if not self.is_log:
            both = (log_ns >= 0) & (log_ns < LATEST_NS)
            self.offset.add(log_ns[both], stamps_ns[both])

    def finish(self) -> StampReport:
        """Return the report; no rows may follow."""
        order, offset = self.order, self.offset
        order.finish()
        if not self.is_log:
            offset.finish()
        gap_over_ns, is_steady = _gap_limit(order)
        longest_ns, longest_at_ns = order.periods.longest() or (None, None)
        return StampReport(
            rows=order.count,
            unset=self.unset,
            absurd=self.absurd,
            first_ns=order.first_ns,
            last_ns=order.last_ns,
            min_ns=order.min_ns,
            max_ns=order.max_ns,
            is_constant=order.count > 1 and order.min_ns == order.max_ns,
            duplicates=order.duplicates,
            resets=order.resets,
            reset_steps=tuple(order.reset_steps),
            late_rows=order.late_rows,
            late_stretches=order.late_stretches,
            worst_late_ns=order.worst_late_ns,
            median_period_ns=order.periods.quantile_ns(0.5),
            is_steady=is_steady,
            gap_over_ns=gap_over_ns,
            gaps=0 if gap_over_ns is None else order.periods.count_over(gap_over_ns),
            longest_step_ns=longest_ns,
            longest_step_at_ns=longest_at_ns,
            line=offset.line(),
            jumps=offset.jumps,
            jump_steps=tuple(offset.jump_steps),
            equals_log=self.equals_log,
        )


class _TopicWatch:
    """Incremental analysis of one topic's clocks, which collects small blocks first."""

    def __init__(self) -> None:
        self._count = 0
        self._stamps = {Clock.LOG: _StampWatch(is_log=True)}
        self._waiting: list[dict[Clock, Int64s]] = []
        self._waiting_rows = 0

    def see(self, block: Block) -> None:
        """Add a block's times; its rows are not kept."""
        columns = {
            Clock.LOG: block.log_ns,
            Clock.PUBLISH: block.publish_ns,
            Clock.HEADER: block.header_ns,
        }
        self._count += len(block)
        self._waiting.append({clock: c.copy() for clock, c in columns.items() if c is not None})
        self._waiting_rows += len(block)
        if self._waiting_rows >= _BATCH_ROWS:
            self._process()

    def finish(self, topic: str) -> ClockReport:
        """Return the report; no block may follow."""
        self._process()
        reports = {clock: watch.finish() for clock, watch in self._stamps.items()}
        log = reports[Clock.LOG]
        publish, header = reports.get(Clock.PUBLISH), reports.get(Clock.HEADER)
        used, why = choose_clock(self._count, log, publish, header)
        return ClockReport(topic, self._count, used, why, log, publish, header)

    def _process(self) -> None:
        for clock in Clock:
            given = [times for times in self._waiting if clock in times]
            if given:
                watch = self._stamps.setdefault(clock, _StampWatch())
                watch.add(
                    np.concatenate([times[Clock.LOG] for times in given]),
                    np.concatenate([times[clock] for times in given]),
                )
        self._waiting, self._waiting_rows = [], 0


def _gap_limit(order: OrderWatch) -> tuple[int | None, bool]:
    """Return the min length of a gap, and whether the stream is steady."""
    median_ns = order.periods.quantile_ns(0.5)
    if median_ns is None or order.periods.count < _PERIODS_FOR_GAPS:
        return None, True
    # The median is meaningless if most rows arrive in bursts at one instant.
    is_steady = 0 < (order.periods.quantile_ns(0.9) or 0) <= _STEADY_RATIO * median_ns
    usual_ns = median_ns if is_steady else order.periods.quantile_ns(0.99)
    return (GAP_PERIODS * usual_ns if usual_ns else None), is_steady
