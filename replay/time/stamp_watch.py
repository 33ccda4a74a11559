"""Find set-backs of a topic's log clock, and its stray stamps.

Rows arrive in stored order. A backward step of ``MIN_SET_BACK_NS`` or more is one of three things:

* *late rows*: within ``LOOK_AHEAD`` rows the stamps return to their earlier course; the clock is
  unaffected, and a merge by time restores the order;
* a *stray*: at most ``MAX_STRAY_ROWS`` rows far from both neighbours, while the neighbours are
  close together; the rows are wrong, not the clock;
* a *set-back*: the stamps continue from there.

Smaller backward steps are disorder. The first rows after a set-back are decisive, so a set-back
within the last ``ROWS_TO_BELIEVE`` rows of a log is treated as late rows.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

MIN_SET_BACK_NS: Final = 100_000_000
# Min distance of a stray from both its neighbours.
STRAY_NS: Final = 1_000_000_000
MAX_STRAY_ROWS: Final = 8
LOOK_AHEAD: Final = 128
ROWS_TO_BELIEVE: Final = 3
# Max number of set-backs and strays of one topic; later ones are treated as late rows.
MAX_FINDINGS: Final = 10_000


@dataclass(frozen=True, slots=True)
class SetBack:
    """A set-back of a clock.

    Attributes:
        row: The first row after it, counted from 0 in stored order.
        before_ns: Stamp of the previous row.
        after_ns: Stamp of the row.
    """

    row: int
    before_ns: int
    after_ns: int


@dataclass(slots=True)
class Era:
    """Rows between two set-backs: their lowest and highest stamp without strays."""

    first_ns: int
    last_ns: int


class StampWatch:
    """Incremental search of one topic's stamps, which keeps only the rows needed to look ahead."""

    def __init__(self) -> None:
        self.rows = 0
        self.set_backs: list[SetBack] = []
        self.strays: list[tuple[int, int]] = []
        """Half-open ranges of rows."""
        self.eras: list[Era] = []
        self._held: NDArray[np.int64] = np.empty(0, np.int64)
        self._decided = 0
        self._before_ns: int | None = None
        self._step_ns = 0

    @property
    def decided(self) -> int:
        """Number of rows that are decided."""
        return self._decided

    def add(self, stamps_ns: NDArray[np.int64]) -> None:
        """Add the next rows, shape (N,)."""
        self.rows += len(stamps_ns)
        self._held = np.concatenate([self._held, stamps_ns])
        self._decide(len(self._held) - LOOK_AHEAD)

    def finish(self) -> None:
        """Process the last rows; no rows may follow."""
        self._decide(len(self._held))

    def _decide(self, n: int) -> None:
        """Decide the first ``n`` pending rows; the rest is used to look ahead."""
        if n <= 0:
            return
        rows = self._held
        if self._before_ns is None:
            self._before_ns = int(rows[0])
            self.eras.append(Era(self._before_ns, self._before_ns))
        at = 0
        steps = np.diff(rows, prepend=self._before_ns)
        jumps = np.flatnonzero((steps < -MIN_SET_BACK_NS) | (steps > STRAY_NS))
        for jump in jumps.tolist():
            if jump < at:
                continue
            if jump >= n:
                break
            self._accept(rows[at:jump])
            at = self._judge(rows, jump)
        self._accept(rows[at : max(n, at)])
        done = max(n, at)
        self._held = rows[done:].copy()
        self._decided += done

    def _accept(self, rows: NDArray[np.int64]) -> None:
        """Add rows to the current era."""
        if not len(rows):
            return
        era = self.eras[-1]
        era.first_ns = min(era.first_ns, int(rows.min()))
        era.last_ns = max(era.last_ns, int(rows.max()))
        before = int(rows[-2]) if len(rows) > 1 else self._before_ns
        self._step_ns = abs(int(rows[-1]) - int(before or rows[-1]))
        self._before_ns = int(rows[-1])

    def _judge(self, rows: NDArray[np.int64], jump: int) -> int:
        """Classify the step before row ``jump``, and return the row at which to continue."""
        before_ns = self._before_ns
        assert before_ns is not None
        is_full = len(self.strays) + len(self.set_backs) >= MAX_FINDINGS
        stop = self._stray_until(rows, jump, before_ns)
        if stop is not None and not is_full:
            self.strays.append((self._decided + jump, self._decided + stop))
            return stop
        step_ns = int(rows[jump]) - before_ns
        if step_ns < -MIN_SET_BACK_NS and not is_full and _goes_on(rows, jump, before_ns, step_ns):
            after_ns = int(rows[jump])
            self.set_backs.append(SetBack(self._decided + jump, before_ns, after_ns))
            self.eras.append(Era(after_ns, after_ns))
            self._before_ns = after_ns
        self._accept(rows[jump : jump + 1])
        return jump + 1

    def _stray_until(self, rows: NDArray[np.int64], jump: int, before_ns: int) -> int | None:
        """Return the row after a stray that begins at ``jump``, or None if none begins there."""
        reach_ns = max(STRAY_NS, 5 * self._step_ns // 2)
        ahead = rows[jump : jump + MAX_STRAY_ROWS + 1]
        near = (ahead >= before_ns - MIN_SET_BACK_NS) & (ahead <= before_ns + reach_ns)
        if not near.any() or near[0]:
            return None
        length = int(near.argmax())
        low_ns, high_ns = before_ns - STRAY_NS, int(ahead[length]) + STRAY_NS
        strays = ahead[:length]
        is_far = bool(((strays < low_ns) | (strays > high_ns)).all())
        return jump + length if is_far else None


def _goes_on(rows: NDArray[np.int64], jump: int, before_ns: int, step_ns: int) -> bool:
    """Return whether the stamps continue from row ``jump``, without returning to their course."""
    ahead = rows[jump : jump + LOOK_AHEAD]
    if len(ahead) <= ROWS_TO_BELIEVE:
        return False
    leaps = np.diff(ahead)
    returns = (leaps > -step_ns // 2) & (ahead[1:] >= before_ns - MIN_SET_BACK_NS)
    return not bool(returns.any())
