"""Periods of a stream in bounded memory: quantiles from a histogram, and the exact longest ones."""

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
