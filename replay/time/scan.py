"""Scan a drive's stamps to find its time segments.

The scan reads the topics that will be used and decodes only the wheel speeds. Its memory does not
grow with the log: it keeps set-backs, strays, and gaps in the wheel speeds.
"""

from bisect import bisect_right
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from operator import attrgetter, itemgetter
from typing import Final, TypeAlias

import numpy as np

from crosscue.replay.base import Log, Selection
from crosscue.replay.columns import Block
from crosscue.replay.ledger import Ledger
from crosscue.replay.signals.kinds import Samples, Signal, SignalPlan, SignalSource

from .segments import (
    BEGINNING,
    Cause,
    Epoch,
    EpochMarks,
    LogClock,
    SplitLimits,
    Timeline,
    TimeSegment,
)
from .stamp_watch import StampWatch

# Max difference of the set-backs of two topics or logs that count as one.
SAME_NS: Final = 2_000_000_000

# Reader of the wheel speeds of a block, see ``wheels_only`` in ``replay.signals.extractor``.
WheelReader: TypeAlias = Callable[[Block], Iterable[Samples]]


@dataclass(slots=True)
class _Run:
    """Wheel speeds without a gap: the era of their topic, their first and last time."""

    era: int
    first_ns: int
    last_ns: int


@dataclass(slots=True)
class _WheelRuns:
    """Incremental search for gaps in the wheel speeds."""

    read: WheelReader
    max_silence_ns: int
    watch: StampWatch
    runs: list[_Run] = field(default_factory=list)
    _waiting: list[tuple[int, Block]] = field(default_factory=list)
    _set_backs: int = 0
    _strays: int = 0

    def add(self, block: Block) -> None:
        """Add a block whose stamps were added to the watch."""
        self._waiting.append((self.watch.rows - len(block), block))
        self.settle()

    def settle(self) -> None:
        """Process the blocks whose rows are all decided."""
        while self._waiting:
            first, block = self._waiting[0]
            if self.watch.decided < first + len(block):
                return
            del self._waiting[0]
            self._settle(first, block)

    def _settle(self, first: int, block: Block) -> None:
        stop = first + len(block)
        cuts = {first, stop}
        while self._set_backs < len(self.watch.set_backs):
            row = self.watch.set_backs[self._set_backs].row
            if row >= stop:
                break
            cuts.add(row)
            self._set_backs += 1
        while self._strays < len(self.watch.strays):
            begin, end = self.watch.strays[self._strays]
            if begin >= stop:
                break
            cuts |= {begin, min(end, stop)}
            if end > stop:
                break
            self._strays += 1
        for begin, end in pairwise(sorted(cut for cut in cuts if first <= cut <= stop)):
            if self._is_stray(begin):
                continue
            era = bisect_right(self.watch.set_backs, begin, key=attrgetter("row"))
            part = (
                block
                if (begin, end) == (first, stop)
                else block.take(slice(begin - first, end - first))
            )
            for samples in self.read(part):
                self._see(samples, era)

    def _is_stray(self, row: int) -> bool:
        at = bisect_right(self.watch.strays, row, key=itemgetter(0))
        return at > 0 and row < self.watch.strays[at - 1][1]

    def _see(self, samples: Samples, era: int) -> None:
        if samples.signal is not Signal.WHEEL_SPEEDS:
            return
        rear = np.isfinite(samples.values[:, 2:]).all(axis=1)
        front = np.isfinite(samples.values[:, :2]).all(axis=1)
        times = np.sort(samples.t_ns[rear | front])
        if not len(times):
            return
        if not self.runs or self.runs[-1].era != era:
            self.runs.append(_Run(era, int(times[0]), int(times[0])))
        high_ns = self.runs[-1].last_ns
        times = times[times > high_ns]
        steps = np.diff(times, prepend=high_ns)
        for at in np.flatnonzero(steps > self.max_silence_ns).tolist():
            if at:
                self.runs[-1].last_ns = int(times[at - 1])
            self.runs.append(_Run(era, int(times[at]), int(times[at])))
        if len(times):
            self.runs[-1].last_ns = int(times[-1])


def scan(
    logs: Sequence[Log],
    planned: SignalPlan,
    limits: SplitLimits,
    selections: Sequence[Selection],
    wheels: Sequence[WheelReader],
    known: Timeline | None = None,
) -> Timeline:
    """Find a drive's time segments.

    Args:
        logs: All logs of the drive, open.
        planned: Plan of the topics that will be used.
        limits: Limits at which the drive is split.
        selections: Selection that will be read of each log.
        wheels: For each log, the reader of wheel speeds from its blocks.
        known: Earlier timeline of these logs. Its shifts are kept, so that the tables of both can
            be joined.
    """
    watch = DriveWatch(planned, limits, wheels)
    for one, log, selection in zip(watch.logs, logs, selections, strict=True):
        if selection.topics is None or selection.topics:
            for block in log.read(Ledger(""), selection):
                one.add(block)
    return watch.timeline(known)


class LogWatch:
    """Incremental scan of one log's stamps and wheel speeds, from its blocks in stored order."""

    def __init__(self, wheels: str | None, max_silence_ns: int, read: WheelReader) -> None:
        """Prepare the scan of a log with this topic of wheel speeds, if any."""
        self.topics: Final[dict[str, StampWatch]] = {}
        self._wheels: Final = wheels
        self._limit_ns: Final = max_silence_ns
        self._read: Final = read
        self._following: _WheelRuns | None = None

    def add(self, block: Block) -> None:
        """Add the next block."""
        if not len(block):
            return
        watch = self.topics.setdefault(block.topic, StampWatch())
        watch.add(block.log_ns)
        if block.topic != self._wheels:
            return
        if self._following is None:
            self._following = _WheelRuns(self._read, self._limit_ns, watch)
        self._following.add(block)

    def finish(self) -> list[_Run]:
        """Process the last rows, and return the runs of wheel speeds of the log, if any."""
        for watch in self.topics.values():
            watch.finish()
        if self._following is None:
            return []
        self._following.settle()
        return self._following.runs


class DriveWatch:
    """Incremental scan of a drive's logs.

    It serves callers that read the logs anyway; ``scan`` reads them for this purpose alone.
    """

    def __init__(
        self, planned: SignalPlan, limits: SplitLimits, wheels: Sequence[WheelReader]
    ) -> None:
        """Prepare the scan, with the reader of wheel speeds of each log."""
        self._wheels: Final = planned.source_of(Signal.WHEEL_SPEEDS)
        self._limit_ns: Final = round(limits.max_silence_s * 1e9)
        self._gap_ns: Final = round(limits.unknown_gap_s * 1e9)
        at = None if self._wheels is None else (self._wheels.log, self._wheels.topic.name)
        self.logs: Final = tuple(
            LogWatch(at[1] if at is not None and at[0] == number else None, self._limit_ns, read)
            for number, read in enumerate(wheels)
        )

    def timeline(self, known: Timeline | None = None) -> Timeline:
        """Return the time segments of completely scanned logs, in the plan's order."""
        runs = [run for one in self.logs for run in one.finish()]
        aligned = [_Aligned(one.topics) for one in self.logs]
        clocks = _clocks(aligned, self._gap_ns, known)
        return Timeline(_segments(aligned, clocks, runs, self._wheels, self._limit_ns), clocks)


class _Aligned:
    """One log's topics, with set-backs matched to those of the topic that has the most."""

    def __init__(self, watches: Mapping[str, StampWatch]) -> None:
        self.watches: Final = watches
        first = max(
            watches.values(), key=lambda one: (len(one.set_backs), one.rows), default=StampWatch()
        )
        self.events: Final = tuple(first.set_backs)
        self.entries: Final = {name: self._entries(one) for name, one in watches.items()}
        n = len(self.events) + 1
        lows: list[list[int]] = [[] for _ in range(n)]
        highs: list[list[int]] = [[] for _ in range(n)]
        for name, watch in watches.items():
            if None in self.entries[name] or not watch.eras:
                continue
            for epoch, era in enumerate(watch.eras[:n]):
                lows[epoch].append(era.first_ns)
                highs[epoch].append(era.last_ns)
        self.first_ns: Final = [min(some, default=0) for some in lows]
        self.last_ns: Final = [max(some, default=0) for some in highs]

    def _entries(self, watch: StampWatch) -> tuple[int | None, ...]:
        """Return the topic's row at each set-back of the log."""
        span_ns = sum(era.last_ns - era.first_ns for era in watch.eras)
        reach_ns = max(SAME_NS, 3 * span_ns // max(watch.rows, 1))
        entries: list[int | None] = [None] * len(self.events)
        at = 0
        for own in watch.set_backs:
            for number in range(at, len(self.events)):
                event = self.events[number]
                if (
                    abs(own.before_ns - event.before_ns) <= reach_ns
                    and abs(own.after_ns - event.after_ns) <= reach_ns
                ):
                    entries[number] = own.row
                    at = number + 1
                    break
        return tuple(entries)

    def marks(self) -> dict[str, EpochMarks]:
        """Return the marks for ``LogClock``; empty if no rows need to change."""
        return {
            name: EpochMarks(self.entries[name], tuple(self.last_ns[:-1]), tuple(watch.strays))
            for name, watch in self.watches.items()
            if self.events or watch.strays
        }

    def epoch_of(self, topic: str, era: int) -> int:
        """Return the epoch in which one of a topic's eras begins."""
        if era == 0:
            return 0
        row = self.watches[topic].set_backs[era - 1].row
        entries = self.entries[topic]
        matched = [i + 1 for i, entry in enumerate(entries) if entry is not None and entry <= row]
        return max(matched, default=0)


def _clocks(
    aligned: Sequence[_Aligned], gap_ns: int, known: Timeline | None
) -> tuple[LogClock, ...]:
    shifts: list[list[int]] = [[0] for _ in aligned]
    max_events = max((len(one.events) for one in aligned), default=0)
    for number in range(1, max_events + 1):
        for i, one in enumerate(aligned):
            if len(one.events) < number:
                continue
            if known is not None and number < len(known.clock(i).epochs):
                shifts[i].append(known.clock(i).epochs[number].shift_ns)
                continue
            together = [
                (other, shifts[j][number - 1])
                for j, other in enumerate(aligned)
                if len(other.events) >= number and _is_same(one, other, number - 1)
            ]
            end_ns = max(other.last_ns[number - 1] + shift for other, shift in together)
            start_ns = min(other.first_ns[number] for other, _ in together)
            shifts[i].append(end_ns + gap_ns - start_ns)
    clocks = []
    for i, (one, of_log) in enumerate(zip(aligned, shifts, strict=True)):
        earlier = () if known is None else known.clock(i).epochs
        # The earlier timeline may come from other topics, with another middle of the set-back.
        is_known = len(earlier) == len(of_log)
        epochs = earlier if is_known else tuple(_epochs(one, of_log))
        clocks.append(LogClock(epochs, one.marks()))
    return tuple(clocks)


def _is_same(one: _Aligned, other: _Aligned, number: int) -> bool:
    """Return whether the clocks of two logs were set back together."""
    first, second = one.events[number], other.events[number]
    steps_ns = (first.after_ns - first.before_ns) - (second.after_ns - second.before_ns)
    return abs(steps_ns) <= SAME_NS and abs(first.before_ns - second.before_ns) <= SAME_NS


def _epochs(one: _Aligned, shifts: Sequence[int]) -> list[Epoch]:
    epochs = [Epoch(BEGINNING, 0)]
    for number in range(1, len(shifts)):
        end_ns = one.last_ns[number - 1] + shifts[number - 1]
        start_ns = one.first_ns[number] + shifts[number]
        epochs.append(Epoch((end_ns + start_ns) // 2, shifts[number]))
    return epochs


def _segments(
    aligned: Sequence[_Aligned],
    clocks: Sequence[LogClock],
    runs: Sequence[_Run],
    wheels: SignalSource | None,
    limit_ns: int,
) -> tuple[TimeSegment, ...]:
    found: list[TimeSegment] = []
    if wheels is not None and runs:
        one, clock = aligned[wheels.log], clocks[wheels.log]
        found = _of_wheels(one, clock, wheels, runs, limit_ns)
    else:
        start_ns = min((one.first_ns[0] for one in aligned if one.watches), default=0)
        end_ns = max((one.last_ns[0] for one in aligned if one.watches), default=0)
        found = [TimeSegment(0, BEGINNING, start_ns, end_ns, start_ns, end_ns, Cause.START)]
    for one, clock in zip(aligned, clocks, strict=True):
        for number, epoch in enumerate(clock.epochs[1:], start=1):
            if any(abs(other.begins_ns - epoch.begins_ns) <= SAME_NS for other in found[1:]):
                continue
            run = _Run(0, one.first_ns[number], one.last_ns[number])
            found.append(replace(_set_back(one, number, run, epoch), breaks_odometry=False))
    found.sort(key=lambda segment: segment.begins_ns)
    return tuple(replace(segment, number=number) for number, segment in enumerate(found))


def _segment(begins_ns: int, run: _Run, epoch: Epoch, cause: Cause) -> TimeSegment:
    first_ns, last_ns = run.first_ns + epoch.shift_ns, run.last_ns + epoch.shift_ns
    return TimeSegment(0, begins_ns, first_ns, last_ns, run.first_ns, run.last_ns, cause)


def _set_back(one: _Aligned, number: int, run: _Run, epoch: Epoch) -> TimeSegment:
    event = one.events[number - 1]
    segment = _segment(epoch.begins_ns, run, epoch, Cause.SET_BACK)
    return replace(segment, by_ns=event.after_ns - event.before_ns)


def _in_epochs(one: _Aligned, topic: str, runs: Sequence[_Run]) -> Iterator[tuple[int, _Run]]:
    """Yield each run with its epoch, split at set-backs that are not visible in the topic."""
    entries, reached = one.entries[topic], 0
    for run in runs:
        number = max(one.epoch_of(topic, run.era), reached)
        first_ns = run.first_ns
        while number < len(entries) and entries[number] is None:
            ends_ns = one.last_ns[number]
            if not first_ns <= ends_ns < run.last_ns:
                break
            yield number, _Run(run.era, first_ns, ends_ns)
            number, first_ns = number + 1, ends_ns + 1
        yield number, _Run(run.era, first_ns, run.last_ns)
        reached = number


def _of_wheels(
    one: _Aligned, clock: LogClock, wheels: SignalSource, runs: Sequence[_Run], limit_ns: int
) -> list[TimeSegment]:
    found: list[TimeSegment] = []
    epoch_before = 0
    for number, run in _in_epochs(one, wheels.topic.name, runs):
        epoch = clock.epochs[number]
        first_ns, last_ns = run.first_ns + epoch.shift_ns, run.last_ns + epoch.shift_ns
        if not found:
            found.append(_segment(BEGINNING, run, epoch, Cause.START))
        elif number != epoch_before:
            found.append(_set_back(one, number, run, epoch))
        elif first_ns - found[-1].end_ns <= limit_ns:
            end_ns = max(found[-1].end_ns, last_ns)
            found[-1] = replace(found[-1], end_ns=end_ns, log_end_ns=end_ns - epoch.shift_ns)
        else:
            end_ns = found[-1].end_ns
            begins_ns = max(end_ns + 1, first_ns - limit_ns)
            silent = _segment(begins_ns, run, epoch, Cause.SILENCE)
            found.append(replace(silent, gap_ns=first_ns - end_ns))
        epoch_before = number
    return found
