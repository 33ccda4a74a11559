"""Estimate offset, drift and jumps of a topic's clock relative to the log clock.

The delay of a row is its log time minus its stamp. It is the sum of the difference between the two
clocks and of transport and waiting, which vary and are never negative. The *lower envelope* of the
delays therefore shows the clocks alone. Its line is fitted with the Theil-Sen median of slopes
(P. K. Sen, 1968) through the smallest delays of up to 128 intervals of equal size. A few stalled
intervals do not affect the median.

A *jump* is a step of that envelope: the smallest delays of the two seconds before and after a row
differ by more than 10 ms and six times the usual waiting, and half of the step occurs within four
rows on either side. A slow drift is therefore not a jump, and neither is a stalled recorder whose
queue empties within two seconds. Offset and drift are those of the longest interval without a jump.
"""

from dataclasses import dataclass
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from .order import EVENTS_KEPT, ClockStep, forward_min

Floats: TypeAlias = NDArray[np.float64]
Int64s: TypeAlias = NDArray[np.int64]

JUMP_FLOOR_NS: Final = 10_000_000
JUMP_WINDOW_NS: Final = 2_000_000_000
_JUMP_OVER_WAIT: Final = 6
_SHARP_ROWS: Final = 4
# Rows required on either side of a jump; with fewer, a ramp looks the same.
_ROWS_BESIDE: Final = 16
_SHORTEST_SIDE_NS: Final = 100_000_000
_WINDOW_ROWS: Final = (_ROWS_BESIDE, 8192)
_ENVELOPE_BINS: Final = 1024
_FIRST_BIN_NS: Final = 1_000_000
_FIT_GROUPS: Final = 128
_ROWS_PER_GROUP: Final = 8
_FIT_SPAN_NS: Final = 2_000_000_000


@dataclass(frozen=True, slots=True)
class ClockLine:
    """Offset and drift of a clock relative to the log clock.

    Attributes:
        rows: Number of rows of the fitted interval.
        start_log_ns: Log time of its first row.
        end_log_ns: Log time of its last row.
        offset_ns: Stamp minus log time at its first row, without waiting.
        drift_ppm: Excess rate of the clock over the log clock, or None if the interval is too
            short.
        drift_error_ppm: One standard error of the drift, enlarged if the clock's line bends.
    """

    rows: int
    start_log_ns: int
    end_log_ns: int
    offset_ns: int
    drift_ppm: float | None
    drift_error_ppm: float | None


class OffsetWatch:
    """Fit of one clock to the log clock, from log times and stamps in stored order."""

    def __init__(self) -> None:
        self.jumps = 0
        self.jump_steps: list[ClockStep] = []
        self._log: Int64s = np.zeros(0, dtype=np.int64)
        self._delay: Int64s = np.zeros(0, dtype=np.int64)
        self._decided = 0
        self._window = 0
        self._rows_since_jump = _ROWS_BESIDE
        self._envelope: _Envelope | None = None
        self._longest: ClockLine | None = None

    def add(self, log_ns: Int64s, stamps_ns: Int64s) -> None:
        """Add the next rows: shape (N,) each, both between 0 and 2 ** 62."""
        self._log = np.concatenate([self._log, log_ns])
        self._delay = np.concatenate([self._delay, log_ns - stamps_ns])
        if not self._window and len(self._log) >= _WINDOW_ROWS[0]:
            self._window = _window_rows(self._log)
        if self._window and len(self._log) >= self._decided + 3 * self._window:
            self._decide(len(self._log) - self._window)

    def finish(self) -> None:
        """Process the last rows; no rows may follow."""
        self._window = self._window or _WINDOW_ROWS[0]
        self._decide(len(self._log))
        self._close_envelope()

    def line(self) -> ClockLine | None:
        """Return the line of the longest interval without a jump, or None if there are no rows."""
        return self._longest

    def _decide(self, n: int) -> None:
        """Process rows up to ``n``, and keep the earlier rows that the next ones refer to."""
        start = self._decided
        for row, by_ns in self._jump_rows(start, n):
            self._grow_envelope(start, row)
            self._close_envelope()
            self.jumps += 1
            if len(self.jump_steps) < EVENTS_KEPT:
                self.jump_steps.append(ClockStep(int(self._log[row]), -by_ns))
            start = row
        self._grow_envelope(start, n)
        drop = max(n - self._window, 0)
        self._log, self._delay = self._log[drop:].copy(), self._delay[drop:].copy()
        self._decided = n - drop

    def _jump_rows(self, start: int, n: int) -> list[tuple[int, int]]:
        """Return the rows from ``start`` to ``n`` at which the delay jumps, with the step."""
        delay, width = self._delay, self._window
        if len(delay) < 2 * _ROWS_BESIDE:
            return []
        after, before = forward_min(delay, width), _backward_min(delay, width)
        usual_wait_ns = int(_median(delay - after))
        over_ns = max(JUMP_FLOOR_NS, _JUMP_OVER_WAIT * usual_wait_ns)
        by = after - before
        sharp = forward_min(delay, _SHARP_ROWS) - _backward_min(delay, _SHARP_ROWS)
        is_jump = (np.abs(by) > over_ns) & (np.sign(sharp) == np.sign(by))
        is_jump &= np.abs(sharp) >= np.abs(by) // 2
        is_jump[: max(start, _ROWS_BESIDE)] = False
        is_jump[min(n, len(delay) - _ROWS_BESIDE + 1) :] = False
        return self._one_per_run(np.flatnonzero(is_jump), by, start, n)

    def _one_per_run(
        self, rows: NDArray[np.intp], by: Int64s, start: int, n: int
    ) -> list[tuple[int, int]]:
        """Reduce each run of rows to one: a rise begins at its row, a fall ends at its row."""
        jumps: list[tuple[int, int]] = []
        previous = start - self._rows_since_jump
        for run in np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1) if len(rows) else []:
            row = int(run[0] if by[run[0]] > 0 else run[-1])
            if row - previous >= _ROWS_BESIDE and self._lasts(row):
                jumps.append((row, int(by[row])))
                previous = row
        self._rows_since_jump = min(n - previous, _ROWS_BESIDE)
        return jumps

    def _lasts(self, row: int) -> bool:
        """Return whether the rows on both sides span some time, unlike a queue emptied at once."""
        first, last = max(row - self._window, 0), min(row + self._window, len(self._log)) - 1
        before_ns, after_ns = (
            self._log[row - 1] - self._log[first],
            self._log[last] - self._log[row],
        )
        return bool(min(before_ns, after_ns) >= _SHORTEST_SIDE_NS)

    def _grow_envelope(self, start: int, stop: int) -> None:
        if stop > start:
            if self._envelope is None:
                self._envelope = _Envelope(int(self._log[start]), int(self._delay[start]))
            self._envelope.add(self._log[start:stop], self._delay[start:stop])

    def _close_envelope(self) -> None:
        if self._envelope is not None:
            line = self._envelope.line()
            if self._longest is None or line.rows > self._longest.rows:
                self._longest = line
        self._envelope = None


class _Envelope:
    """The smallest delay in each of up to ``_ENVELOPE_BINS`` intervals, which widen over time."""

    def __init__(self, start_ns: int, base_ns: int) -> None:
        self._start_ns, self._base_ns = start_ns, base_ns
        self._end_ns = start_ns
        self._width_ns = _FIRST_BIN_NS
        self._rows: Int64s = np.zeros(_ENVELOPE_BINS, dtype=np.int64)
        self._delay: Int64s = np.full(_ENVELOPE_BINS, np.iinfo(np.int64).max, dtype=np.int64)
        self._at: Int64s = np.zeros(_ENVELOPE_BINS, dtype=np.int64)

    def add(self, log_ns: Int64s, delay_ns: Int64s) -> None:
        """Add rows, shape (N,) each."""
        since = np.maximum(log_ns - self._start_ns, 0)
        self._end_ns = max(self._end_ns, self._start_ns + int(since.max()))
        while int(since.max()) >= self._width_ns * _ENVELOPE_BINS:
            self._halve()
        bins = since // self._width_ns
        order = np.lexsort((delay_ns, bins))
        first = np.flatnonzero(np.diff(bins[order], prepend=-1))
        smallest, used = order[first], bins[order[first]]
        self._rows += np.bincount(bins, minlength=_ENVELOPE_BINS)
        lower = delay_ns[smallest] < self._delay[used]
        self._delay[used[lower]] = delay_ns[smallest][lower]
        self._at[used[lower]] = since[smallest][lower]

    def _halve(self) -> None:
        """Merge neighbouring intervals, so that twice the time fits."""
        half = _ENVELOPE_BINS // 2
        pairs = self._delay.reshape(half, 2)
        pick = np.argmin(pairs, axis=1)[:, None]
        empty = np.zeros(half, dtype=np.int64)
        at = np.take_along_axis(self._at.reshape(half, 2), pick, axis=1).ravel()
        delay = np.take_along_axis(pairs, pick, axis=1).ravel()
        self._rows = np.concatenate([self._rows.reshape(half, 2).sum(axis=1), empty])
        self._delay = np.concatenate([delay, empty + np.iinfo(np.int64).max])
        self._at = np.concatenate([at, empty])
        self._width_ns *= 2

    def line(self) -> ClockLine:
        """Return the envelope's line; its drift is None if the time span is too short."""
        used = np.flatnonzero(self._rows)
        total = int(self._rows.sum())
        per_group = max(_ROWS_PER_GROUP, -(-total // _FIT_GROUPS))
        group = (np.cumsum(self._rows[used]) - 1) // per_group
        order = np.lexsort((self._delay[used], group))
        pick = used[order[np.flatnonzero(np.diff(group[order], prepend=-1))]]
        at_s = self._at[pick].astype(np.float64) * 1e-9
        delay_ns = (self._delay[pick] - self._base_ns).astype(np.float64)
        slope, error, at_start_ns = 0.0, 0.0, float(delay_ns.min())
        reported = len(pick) >= 3 and self._end_ns - self._start_ns >= _FIT_SPAN_NS
        if reported:
            slope, error, at_start_ns = theil_sen(at_s, delay_ns)
            error = max(error, _bend(at_s, delay_ns))
        return ClockLine(
            rows=total,
            start_log_ns=self._start_ns,
            end_log_ns=self._end_ns,
            offset_ns=-(self._base_ns + round(at_start_ns)),
            drift_ppm=-slope * 1e-3 if reported else None,
            drift_error_ppm=error * 1e-3 if reported else None,
        )


def theil_sen(x: Floats, y: Floats) -> tuple[float, float, float]:
    """Return the median of slopes, its standard error, and the line's value at ``x = 0``.

    The error estimates the residuals' scatter from their median absolute deviation and assumes that
    they are independent.
    """
    i, j = np.triu_indices(len(x), k=1)
    run = x[j] - x[i]
    slope = _median((y[j] - y[i])[run != 0] / run[run != 0])
    residual = y - slope * x
    at_zero = _median(residual)
    scatter = 1.4826 * _median(np.abs(residual - at_zero))
    spread = float(np.sqrt(np.sum((x - x.mean()) ** 2)))
    return slope, scatter / spread, at_zero


def _median(values: NDArray[np.generic]) -> float:
    """Return the median of finite numbers, NaN without any; NumPy's imports masked arrays."""
    if not len(values):
        return float("nan")
    middle = [(len(values) - 1) // 2, len(values) // 2]
    return float(np.partition(values, middle)[middle].mean())


def _bend(x: Floats, y: Floats) -> float:
    """Return the standard error of a slope that the difference of the two halves' slopes implies.

    With half as many points over half the span, a slope has 2.8 times the error, and the difference
    of two such slopes has 4 times the error.
    """
    half = len(x) // 2
    if half < 3:
        return 0.0
    first, second = theil_sen(x[:half], y[:half]), theil_sen(x[-half:], y[-half:])
    return abs(first[0] - second[0]) / 4.0


def _backward_min(values: Int64s, width: int) -> Int64s:
    """Return the smallest of the ``width`` values before each one; the first value is repeated."""
    smallest = forward_min(values[::-1], width)[::-1]
    return np.concatenate([values[:1], smallest[:-1]])


def _window_rows(log_ns: Int64s) -> int:
    """Return the number of rows in two seconds of this topic, within bounds."""
    span_ns = max(int(log_ns.max()) - int(log_ns.min()), 1)
    rows = JUMP_WINDOW_NS * (len(log_ns) - 1) // span_ns
    return int(np.clip(rows, *_WINDOW_ROWS))
