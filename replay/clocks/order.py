"""Analyze the order of one clock's stamps: duplicates, late rows, resets and periods.

Rows arrive in stored order. A row is *late* if its stamp is below an earlier one; a run of late
rows is a stretch. A backward step is a *reset* (the clock was set back or restarted) if the stamps
continue from there. That is the case if no later step within ``LOOK_AHEAD`` rows jumps forward by
half as much, as it does after late rows. Two resets within ``LOOK_AHEAD`` rows count as one.

Periods are computed from the sorted stamps between resets, so that late rows cause no gaps.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

BINS_PER_OCTAVE: Final = 32
_BINS: Final = 2 + 63 * BINS_PER_OCTAVE
LONGEST_KEPT: Final = 1024


class PeriodSketch:
    """Histogram of a clock's steps that also keeps the longest steps with their times.

    A quantile is the mean of the steps in its bin. It is exact to the width of a bin (2.2 %), and
    much better for a steady stream, whose steps are all in one bin.
    """

    def __init__(self) -> None:
        self.count = 0
        self._counts: NDArray[np.int64] = np.zeros(_BINS, dtype=np.int64)
        self._sums: NDArray[np.float64] = np.zeros(_BINS)
        self._long_ns: NDArray[np.int64] = np.zeros(0, dtype=np.int64)
        self._long_at_ns: NDArray[np.int64] = np.zeros(0, dtype=np.int64)
        self._floor_ns = -1

    def add(self, steps_ns: NDArray[np.int64], at_ns: NDArray[np.int64]) -> None:
        """Add steps.

        Args:
            steps_ns: Shape (N,), not negative.
            at_ns: Shape (N,): the stamp at which each step begins.
        """
        if not len(steps_ns):
            return
        self.count += len(steps_ns)
        bins = _bin_of(steps_ns)
        self._counts += np.bincount(bins, minlength=_BINS)
        self._sums += np.bincount(bins, weights=steps_ns, minlength=_BINS)
        self._keep_longest(steps_ns, at_ns)

    def quantile_ns(self, fraction: float) -> int | None:
        """Return a quantile of the steps, or None if there are no steps."""
        if not self.count:
            return None
        rank = int(fraction * (self.count - 1))
        bin_ = int(np.searchsorted(np.cumsum(self._counts), rank, side="right"))
        return round(float(self._sums[bin_]) / int(self._counts[bin_]))

    def count_over(self, limit_ns: int) -> int:
        """Return the number of steps that exceed ``limit_ns``.

        The number is exact up to ``LONGEST_KEPT`` steps; beyond that, steps in the bin of the limit
        are not counted.
        """
        kept = int(np.count_nonzero(self._long_ns > limit_ns))
        if len(self._long_ns) == self.count or limit_ns >= self._floor_ns:
            return kept
        limit_bin = int(_bin_of(np.array([max(limit_ns, 0)], dtype=np.int64))[0])
        return max(kept, int(self._counts[limit_bin + 1 :].sum()))

    def longest(self) -> tuple[int, int] | None:
        """Return the longest step and the stamp at which it begins; the earliest of equal steps."""
        if not len(self._long_ns):
            return None
        longest = int(self._long_ns.max())
        return longest, int(self._long_at_ns[self._long_ns == longest].min())

    def _keep_longest(self, steps_ns: NDArray[np.int64], at_ns: NDArray[np.int64]) -> None:
        longer = steps_ns > self._floor_ns
        if not longer.any():
            return
        long_ns = np.concatenate([self._long_ns, steps_ns[longer]])
        long_at_ns = np.concatenate([self._long_at_ns, at_ns[longer]])
        if len(long_ns) > LONGEST_KEPT:
            keep = np.argpartition(long_ns, len(long_ns) - LONGEST_KEPT)[-LONGEST_KEPT:]
            long_ns, long_at_ns = long_ns[keep], long_at_ns[keep]
            self._floor_ns = int(long_ns.min())
        self._long_ns, self._long_at_ns = long_ns, long_at_ns


def _bin_of(steps_ns: NDArray[np.int64]) -> NDArray[np.intp]:
    """Return bins: bin 0 holds steps of 0, bin k those from 2 ** ((k - 1) / BINS_PER_OCTAVE) ns."""
    octaves = np.log2(np.maximum(steps_ns, 1).astype(np.float64))
    return np.where(steps_ns == 0, 0, 1 + (octaves * BINS_PER_OCTAVE).astype(np.intp))


LOOK_AHEAD: Final = 128
EVENTS_KEPT: Final = 32
# Rows required after a reset. A backward step closer to the end counts as a late row, because the
# two cannot be distinguished.
_ROWS_TO_BELIEVE: Final = 3


@dataclass(frozen=True, slots=True)
class ClockStep:
    """A step of a clock that was set.

    Attributes:
        at_log_ns: Log time of the first row after the step.
        by_ns: Size of the step; negative if the clock was set back.
    """

    at_log_ns: int
    by_ns: int


class OrderWatch:
    """Incremental count of rows that are out of order, from stamps in stored order."""

    def __init__(self) -> None:
        self.count = 0
        self.first_ns: int | None = None
        self.last_ns: int | None = None
        self.min_ns: int | None = None
        self.max_ns: int | None = None
        self.duplicates = 0
        self.resets = 0
        self.reset_steps: list[ClockStep] = []
        self.late_rows = 0
        self.late_stretches = 0
        self.worst_late_ns = 0
        self.periods = PeriodSketch()
        self._undecided: NDArray[np.int64] = np.zeros(0, dtype=np.int64)
        self._undecided_log: NDArray[np.int64] = np.zeros(0, dtype=np.int64)
        self._before_ns: int | None = None
        self._high_ns: int | None = None
        self._in_stretch = False
        self._rows_since_reset = LOOK_AHEAD
        self._sorted: NDArray[np.int64] = np.zeros(0, dtype=np.int64)
        self._emitted_ns: int | None = None

    def add(self, stamps_ns: NDArray[np.int64], log_ns: NDArray[np.int64]) -> None:
        """Add the next rows: their stamps and log times, shape (N,) each."""
        if not len(stamps_ns):
            return
        self.count += len(stamps_ns)
        low, high = int(stamps_ns.min()), int(stamps_ns.max())
        self.min_ns = low if self.min_ns is None else min(self.min_ns, low)
        self.max_ns = high if self.max_ns is None else max(self.max_ns, high)
        self.first_ns = int(stamps_ns[0]) if self.first_ns is None else self.first_ns
        self.last_ns = int(stamps_ns[-1])
        rows = np.concatenate([self._undecided, stamps_ns])
        log = np.concatenate([self._undecided_log, log_ns])
        self._decide(rows, log, max(len(rows) - LOOK_AHEAD, 0))

    def finish(self) -> None:
        """Process the last rows; no rows may follow."""
        self._decide(self._undecided, self._undecided_log, len(self._undecided))
        self._emit_periods(hold=0)

    def _decide(self, rows: NDArray[np.int64], log: NDArray[np.int64], n: int) -> None:
        """Process the first ``n`` of ``rows``, looking ahead into the rest, which are kept."""
        self._undecided, self._undecided_log = rows[n:].copy(), log[n:].copy()
        if not n:
            return
        before = rows[0] if self._before_ns is None else np.int64(self._before_ns)
        steps = np.diff(rows, prepend=before)
        self.duplicates += int(np.count_nonzero(steps[:n] == 0)) - (self._before_ns is None)
        self._before_ns = int(rows[n - 1])
        start = 0
        for stop in self._reset_rows(steps, n):
            self._era(rows[start:stop])
            self._reset(ClockStep(int(log[stop]), int(steps[stop])))
            start = stop
        self._era(rows[start:n])

    def _reset_rows(self, steps: NDArray[np.int64], n: int) -> Iterator[int]:
        """Yield the rows below ``n`` at which the clock was set back."""
        back = np.flatnonzero(steps[:n] < 0)
        if len(back):
            leap = forward_max(np.append(steps[1:], 0), LOOK_AHEAD)[back]
            # The backward step is halved because doubling the forward step could overflow.
            back = back[(leap < -(steps[back] // 2)) & (back + _ROWS_TO_BELIEVE < len(steps))]
        previous = -self._rows_since_reset
        for row in back.tolist():
            if row - previous >= LOOK_AHEAD:
                previous = row
                yield row
        self._rows_since_reset = min(n - previous, LOOK_AHEAD)

    def _reset(self, step: ClockStep) -> None:
        self.resets += 1
        if len(self.reset_steps) < EVENTS_KEPT:
            self.reset_steps.append(step)
        self._emit_periods(hold=0)
        self._emitted_ns = None
        self._high_ns = None
        self._in_stretch = False

    def _era(self, stamps: NDArray[np.int64]) -> None:
        """Process rows between two resets, or a part of them."""
        if not len(stamps):
            return
        if self._high_ns is None:
            self._high_ns = int(stamps[0])
        high = np.maximum(np.maximum.accumulate(stamps), self._high_ns)
        late = stamps < high
        if late.any():
            begins = late & ~np.concatenate([[self._in_stretch], late[:-1]])
            self.late_rows += int(np.count_nonzero(late))
            self.late_stretches += int(np.count_nonzero(begins))
            self.worst_late_ns = max(self.worst_late_ns, int((high - stamps).max()))
            stamps = np.sort(stamps)
        self._in_stretch = bool(late[-1])
        self._high_ns = int(high[-1])
        if len(self._sorted) and len(stamps) and stamps[0] < self._sorted[-1]:
            self._sorted = np.sort(np.concatenate([self._sorted, stamps]), kind="stable")
        else:
            self._sorted = np.concatenate([self._sorted, stamps])
        self._emit_periods(hold=LOOK_AHEAD)

    def _emit_periods(self, hold: int) -> None:
        """Add the steps of the sorted stamps, except the last ``hold``, which may yet change."""
        ready = self._sorted[: max(len(self._sorted) - hold, 0)]
        self._sorted = self._sorted[len(ready) :].copy()
        if self._emitted_ns is not None:
            ready = ready[ready >= self._emitted_ns]
            ready = np.concatenate([[np.int64(self._emitted_ns)], ready])
        if len(ready):
            self.periods.add(np.diff(ready), ready[:-1])
            self._emitted_ns = int(ready[-1])


def forward_max(values: NDArray[np.int64], width: int) -> NDArray[np.int64]:
    """Return the maximum of each value and the ``width - 1`` after it, in linear time.

    Every window combines two running maxima, from either end of intervals of length ``width``
    (M. van Herk, "A fast algorithm for local minimum and maximum filters", 1992).
    """
    n = len(values)
    padding = np.full(-n % width + width, np.iinfo(np.int64).min, dtype=np.int64)
    stretches = np.concatenate([values, padding]).reshape(-1, width)
    to_here = np.maximum.accumulate(stretches, axis=1).ravel()
    from_here = np.maximum.accumulate(stretches[:, ::-1], axis=1)[:, ::-1].ravel()
    largest: NDArray[np.int64] = np.maximum(from_here[:n], to_here[width - 1 : width - 1 + n])
    return largest


def forward_min(values: NDArray[np.int64], width: int) -> NDArray[np.int64]:
    """Return the minimum of each value and the ``width - 1`` after it."""
    # The complement reverses the order without overflow.
    return ~forward_max(~values, width)
