"""Time segments of a drive, and a drive time that never runs backwards.

A segment ends where a log's clock was set back, or where the wheel speeds are missing for longer
than the vehicle file allows. *Drive time* (``t_ns`` everywhere) is the log's own clock while it
runs forward. After a set-back it is the log's clock plus a shift that moves the rows
``unknown_gap_s`` after all earlier rows, so that order is kept and nothing overlaps. ``log_t_ns``
is the stamp as recorded. A clock that jumps forward cannot be distinguished from a pause: its
stamps are unchanged, and the time between them is a gap.

``TimedLog`` yields a log's blocks in drive time, so that later stages never see a set-back.
"""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.base import EVERYTHING, Log, Selection
from crosscue.replay.columns import Block, Int64s
from crosscue.replay.ledger import Ledger, ReversedTimes
from crosscue.replay.safe_text import counted

STRAY_STAMP: Final = "stray time stamp"
BEGINNING: Final = int(np.iinfo(np.int64).min)


class SplitLimits(NamedTuple):
    """Limits at which a drive is split, see the vehicle file's ``[time]``."""

    max_silence_s: float = 1.0
    unknown_gap_s: float = 1.0


class Cause(StrEnum):
    """Cause of the start of a segment."""

    START = "start"
    SILENCE = "odometry silent"
    SET_BACK = "clock set back"


@dataclass(frozen=True, slots=True)
class TimeSegment:
    """A part of a drive without a gap.

    Attributes:
        number: Number from 0.
        begins_ns: Drive time of its beginning; later rows belong to it.
        start_ns: Drive time of its first wheel speed, or ``begins_ns`` without wheel speeds.
        end_ns: Drive time of its last wheel speed.
        log_start_ns: ``start_ns`` on the log's own clock.
        log_end_ns: ``end_ns`` on the log's own clock.
        cause: Cause of its beginning.
        gap_ns: Time from the last wheel speed before it to its first; None if unknown.
        by_ns: Step of the clock, negative; 0 for other causes.
        breaks_odometry: True if the wheel speeds are interrupted.
    """

    number: int
    begins_ns: int
    start_ns: int
    end_ns: int
    log_start_ns: int
    log_end_ns: int
    cause: Cause
    gap_ns: int | None = None
    by_ns: int = 0
    breaks_odometry: bool = True


@dataclass(frozen=True, slots=True)
class Epoch:
    """A part of one log between two set-backs of its clock.

    Attributes:
        begins_ns: Drive time of its beginning; later rows of the log belong to it.
        shift_ns: Drive time minus log time.
    """

    begins_ns: int
    shift_ns: int


@dataclass(frozen=True, slots=True)
class EpochMarks:
    """Starts of epochs among one topic's rows, and its strays.

    Attributes:
        entries: For each epoch but the first, its first row of the topic. None if the topic itself
            has no step; the epoch then starts at the first row after ``ends_ns``.
        ends_ns: For each epoch but the last, its last log time.
        strays: Half-open ranges of stray rows.
    """

    entries: tuple[int | None, ...] = ()
    ends_ns: tuple[int, ...] = ()
    strays: tuple[tuple[int, int], ...] = ()


@dataclass(frozen=True, slots=True)
class LogClock:
    """One log's clock relative to drive time."""

    epochs: tuple[Epoch, ...] = (Epoch(BEGINNING, 0),)
    topics: Mapping[str, EpochMarks] = field(default_factory=dict)

    def shift_at(self, drive_ns: Int64s) -> Int64s:
        """Return drive time minus log time at each drive time, shape (N,)."""
        begins = np.array([epoch.begins_ns for epoch in self.epochs], np.int64)
        shifts = np.array([epoch.shift_ns for epoch in self.epochs], np.int64)
        at: Int64s = shifts[np.searchsorted(begins, drive_ns, side="right") - 1]
        return at

    def log_times(self, drive_ns: Int64s) -> Int64s:
        """Return the stamps as recorded."""
        return drive_ns - self.shift_at(drive_ns)


UNSHIFTED: Final = LogClock()
WHOLE: Final = TimeSegment(0, BEGINNING, 0, 0, 0, 0, Cause.START)


@dataclass(frozen=True, slots=True)
class Timeline:
    """Segments of a drive and the clocks of its logs.

    Attributes:
        segments: Segments in order, at least one.
        clocks: One clock for each log.
    """

    segments: tuple[TimeSegment, ...] = (WHOLE,)
    clocks: tuple[LogClock, ...] = ()

    def clock(self, log: int) -> LogClock:
        """Return the clock of one log."""
        return self.clocks[log] if log < len(self.clocks) else UNSHIFTED

    def numbers(self, drive_ns: Int64s) -> NDArray[np.int32]:
        """Return the segment number at each drive time, shape (N,)."""
        begins = np.array([one.begins_ns for one in self.segments], np.int64)
        return (np.searchsorted(begins, drive_ns, side="right") - 1).astype(np.int32)

    def number_of_stamp(self, log_ns: int | None) -> int | None:
        """Return the segment number of a recorded stamp; None if it is not unique."""
        if len(self.segments) == 1:
            return 0
        if log_ns is None:
            return None
        fits = [one for one in self.segments if one.log_start_ns <= log_ns <= one.log_end_ns]
        return fits[0].number if len(fits) == 1 else None

    @property
    def has_gaps(self) -> bool:
        """True if there is more than one segment."""
        return len(self.segments) > 1

    @property
    def was_set_back(self) -> bool:
        """True if a clock of the drive was set back."""
        return any(one.cause is Cause.SET_BACK for one in self.segments)


ONE_SEGMENT: Final = Timeline()


def shift_of(timeline: Timeline, log: int) -> Callable[[Int64s], Int64s] | None:
    """Return ``shift_at`` of a log's clock, or None if the clock was never set back."""
    clock = timeline.clock(log)
    return clock.shift_at if len(clock.epochs) > 1 else None


@dataclass(frozen=True, slots=True)
class TimedLog:
    """A log read in drive time."""

    log: Log
    clock: LogClock

    def read(self, ledger: Ledger, selection: Selection = EVERYTHING) -> Iterator[Block]:
        """Yield the log's blocks in drive time; strays are skipped and counted in the ledger.

        ``selection`` is in the log's own time. It must be the selection that was scanned for the
        timeline, because rows are identified by counting.
        """
        seen: Counter[str] = Counter()
        epochs: Counter[str] = Counter()
        order = ReversedTimes()
        for block in self.log.read(ledger, selection):
            marks = self.clock.topics.get(block.topic)
            first = seen[block.topic]
            seen[block.topic] += len(block)
            if marks is None or not len(block):
                yield block
                continue
            order.follow(block)
            epoch = _epochs(block.log_ns, first, epochs[block.topic], marks)
            epochs[block.topic] = int(epoch[-1])
            yield self._placed(block, epoch, _is_stray(first, len(block), marks), ledger)
        order.report(ledger)

    def _placed(
        self, block: Block, epoch: Int64s, is_stray: NDArray[np.bool_], ledger: Ledger
    ) -> Block:
        shifts = np.array([one.shift_ns for one in self.clock.epochs], np.int64)[epoch]
        publish_ns = None if block.publish_ns is None else block.publish_ns + shifts
        placed = replace(block, log_ns=block.log_ns + shifts, publish_ns=publish_ns)
        if not is_stray.any():
            return placed
        ledger.skip(
            block.topic,
            STRAY_STAMP,
            int(is_stray.sum()),
            "far from the stamps of the rows before and after it",
            int(block.log_ns[is_stray][0]),
        )
        ledger.notice(
            f"{block.topic}: rows whose time stamp is far from those around it were skipped"
        )
        return placed.take(~is_stray)


def _epochs(log_ns: Int64s, first: int, epoch: int, marks: EpochMarks) -> Int64s:
    """Return the epoch of each row of a block that starts at the topic's row ``first``."""
    found = np.full(len(log_ns), epoch, np.int64)
    at = 0
    for number in range(epoch, len(marks.entries)):
        entry = marks.entries[number]
        if entry is None:
            later = np.flatnonzero(log_ns[at:] > marks.ends_ns[number])
            at = at + int(later[0]) if len(later) else len(log_ns)
        else:
            at = max(at, entry - first)
        if at >= len(log_ns):
            break
        found[at:] = number + 1
    return found


def _is_stray(first: int, rows: int, marks: EpochMarks) -> NDArray[np.bool_]:
    found = np.zeros(rows, np.bool_)
    for start, stop in marks.strays:
        if start < first + rows and stop > first:
            found[max(start - first, 0) : stop - first] = True
    return found


def gaps_text(segments: Sequence[TimeSegment]) -> list[str]:
    """Return one sentence about the gaps of a drive; an empty list without gaps."""
    later = segments[1:]
    if not later:
        return []
    silent = [one.gap_ns for one in later if one.gap_ns is not None]
    parts = []
    if silent:
        parts.append(
            f"{counted(len(silent), 'gap')} without odometry, {sum(silent) * 1e-9:.1f} s in all"
            + (f", the longest {max(silent) * 1e-9:.1f} s" if len(silent) > 1 else "")
        )
    back = [-one.by_ns * 1e-9 for one in later if one.cause is Cause.SET_BACK]
    if back:
        times = "once" if len(back) == 1 else counted(len(back), "time")
        parts.append(f"the log's clock was set back {times}, by up to {max(back):.1f} s")
    return [
        f"{counted(len(segments), 'time segment')}: {'; '.join(parts)}; "
        "distance counts measured motion only"
    ]
