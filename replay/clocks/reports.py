"""The three clocks of every topic, and which one to use.

A recording may give up to three times for a row: the *log time* (when the recorder stored it), the
*publish time* (when the sender sent it) and the *header stamp* (the sensor's own). ``ClockWatch``
is fed blocks as they are read, in bounded memory, and makes a ``ClockReport`` for every topic.

The rule, in ``choose`` and nowhere else. The header stamp is used when it agrees with the log
clock, else the publish time when it does, else the log time. A clock agrees when

* at least 99 % of the rows carry it, and it moves;
* it was never set back, never jumps, and at most 1 % of its rows are late;
* it is within one second of the log clock, and drifts less than 1000 ppm from it.

A publish time that always equals the log time says nothing and is passed over.

All times are int64 nanoseconds; a difference is taken before anything becomes a float.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from crosscue.replay.columns import Block, Int64s

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
        unset: Rows whose stamp is 0, which for publish times and header stamps means none.
        absurd: Rows whose stamp is negative or past the year 2115.
        first_ns: Stamp of the first row, in stored order; None without rows, as all below.
        last_ns: Stamp of the last row.
        min_ns: The lowest stamp.
        max_ns: The highest stamp.
        is_constant: More than one row, and all carry the same stamp.
        duplicates: Rows with the stamp of the row before.
        resets: How often the clock was set back.
        reset_steps: The first of these.
        late_rows: Rows stamped below an earlier row, resets aside.
        late_stretches: Runs of such rows.
        worst_late_ns: How far the latest of them is below.
        median_period_ns: Median step between sorted stamps.
        is_steady: Nine of ten steps are below 2.5 median periods: not a stream of bursts.
        gap_over_ns: What counts as a gap: over 5 median periods, or, where the topic is not steady,
            over 5 times its 99th percentile; None with fewer than 8 periods.
        gaps: Steps longer than that.
        longest_step_ns: The longest step.
        longest_step_at_ns: The stamp where it begins.
        line: Offset and drift against the log clock; None for the log clock itself.
        jumps: How often its offset stepped, resets included.
        jump_steps: The first of these.
        equals_log: Every stamp equals its row's log time.
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
        count: Rows seen.
        used: The clock to use.
        why: Why that one, in plain words.
        log: The log time.
        publish: The publish time, or None where the format has none.
        header: The header stamp, or None where the rows carry none.
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
        """The report on the clock that is used."""
        by_clock = {Clock.LOG: self.log, Clock.PUBLISH: self.publish, Clock.HEADER: self.header}
        return by_clock[self.used] or self.log

    @property
    def duration_ns(self) -> int:
        """From the lowest to the highest time on the clock that is used."""
        stamps = self.of_used
        return (stamps.max_ns or 0) - (stamps.min_ns or 0)

    @property
    def rate_hz(self) -> float | None:
        """Mean rate over the duration, or None where it cannot be said."""
        rows, span_ns = self.of_used.rows, self.duration_ns
        return (rows - 1) / (span_ns * 1e-9) if rows > 1 and span_ns > 0 else None


class ClockWatch:
    """Follows the clocks of every topic of one log, block by block."""

    def __init__(self) -> None:
        self._topics: dict[str, _TopicWatch] = {}

    def see(self, block: Block) -> None:
        """Take in a block; blocks of a topic come in stored order."""
        if block.topic not in self._topics:
            self._topics[block.topic] = _TopicWatch()
        self._topics[block.topic].see(block)

    def reports(self) -> Mapping[str, ClockReport]:
        """What has been seen so far, by topic; more blocks may follow."""
        return {name: copy.deepcopy(t).finish(name) for name, t in self._topics.items()}


def choose(
    count: int, log: StampReport, publish: StampReport | None, header: StampReport | None
) -> tuple[Clock, str]:
    """The clock to use for a topic of ``count`` rows, and why, in plain words.

    This is the rule of the module's text. ``log`` is what remains when no other clock agrees.
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
    """Why a clock cannot stand in for the log clock, or None."""
    line = stamps.line
    if not stamps.rows or line is None:
        return "is never set"
    if stamps.rows < MIN_SHARE * count:
        return f"is missing on {count - stamps.rows} of {count} rows"
    if stamps.is_constant:
        return "never changes"
    if stamps.resets:
        return f"was set back {stamps.resets} times"
    if stamps.jumps:
        return f"jumps {stamps.jumps} times against the log clock"
    if stamps.late_rows > MAX_LATE_SHARE * stamps.rows:
        return f"is out of order on {stamps.late_rows} rows"
    if abs(line.offset_ns) > MAX_OFFSET_NS:
        return f"is {line.offset_ns * 1e-9:+.3f} s off the log clock"
    if line.drift_ppm is not None and abs(line.drift_ppm) > MAX_DRIFT_PPM:
        return f"drifts {line.drift_ppm:+.0f} ppm"
    return None


@dataclass(slots=True)
class _StampWatch:
    """One clock of one topic, as it is being read."""

    is_log: bool = False
    order: OrderWatch = field(default_factory=OrderWatch)
    offset: OffsetWatch = field(default_factory=OffsetWatch)
    unset: int = 0
    absurd: int = 0
    equals_log: bool = True

    def add(self, log_ns: Int64s, stamps_ns: Int64s) -> None:
        """Take in rows, shape (N,) each."""
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
        """The report; no rows may follow."""
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
    """The clocks of one topic; small blocks are gathered before they are examined."""

    def __init__(self) -> None:
        self._count = 0
        self._stamps = {Clock.LOG: _StampWatch(is_log=True)}
        self._waiting: list[dict[Clock, Int64s]] = []
        self._waiting_rows = 0

    def see(self, block: Block) -> None:
        """Take in a block's times; its rows are not kept."""
        columns = {
            Clock.LOG: block.log_ns,
            Clock.PUBLISH: block.publish_ns,
            Clock.HEADER: block.header_ns,
        }
        self._count += len(block)
        self._waiting.append({clock: c.copy() for clock, c in columns.items() if c is not None})
        self._waiting_rows += len(block)
        if self._waiting_rows >= _BATCH_ROWS:
            self._take_in()

    def finish(self, topic: str) -> ClockReport:
        """The report; no block may follow."""
        self._take_in()
        reports = {clock: watch.finish() for clock, watch in self._stamps.items()}
        log = reports[Clock.LOG]
        publish, header = reports.get(Clock.PUBLISH), reports.get(Clock.HEADER)
        used, why = choose(self._count, log, publish, header)
        return ClockReport(topic, self._count, used, why, log, publish, header)

    def _take_in(self) -> None:
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
    """What counts as a gap, and whether the stream is steady."""
    median_ns = order.periods.quantile_ns(0.5)
    if median_ns is None or order.periods.count < _PERIODS_FOR_GAPS:
        return None, True
    # Where most rows come in bursts at one instant the median says nothing.
    is_steady = 0 < (order.periods.quantile_ns(0.9) or 0) <= _STEADY_RATIO * median_ns
    usual_ns = median_ns if is_steady else order.periods.quantile_ns(0.99)
    return (GAP_PERIODS * usual_ns if usual_ns else None), is_steady
