"""Definitions of a detection: as published, or confirmed by several frames and by range.

As published, the first frame above the threshold counts, with any range. A spike of one frame, or a
range that is wrong by 100 m, is then also a detection, at a long distance. A confirmed detection is
above the threshold for three frames, and its range is within its 95 % interval of the true range in
each of them. The distance is that of the first of these frames, so both definitions agree if there
is no spurious detection.
"""

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from crosscue.eval.scoring.columns import RangeRows
from crosscue.replay.columns import Floats, Int64s

Definition = Literal["confirmed", "published"]
CONFIRM_FRAMES: Final = 3
SDS_95: Final = 1.959964
Flags = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Rule:
    """Conditions of a detection.

    Attributes:
        frames: Min number of consecutive frames.
        checks_range: True if the range must be correct, where the truth has one.
        full_after_detection: True if full detection is possible only after detection.
    """

    frames: int
    checks_range: bool
    full_after_detection: bool


RULES: Final[dict[Definition, Rule]] = {
    "confirmed": Rule(CONFIRM_FRAMES, checks_range=True, full_after_detection=True),
    "published": Rule(1, checks_range=False, full_after_detection=False),
}


def held(holds: Flags, frames: int) -> Flags:
    """Return the frames from which on ``holds`` is True for ``frames`` frames, shape (N,)."""
    found = holds.copy()
    for ahead in range(1, frames):
        found[:-ahead] &= holds[ahead:]
        found[-ahead:] = False
    return found


def is_range_right(
    rows: RangeRows, true_m: tuple[Floats, Floats], number: int, t_ns: Int64s
) -> Flags:
    """Return whether the latest range at each time is within its 95 % interval of the true range.

    Either the range to the start or the range to the end is sufficient.

    Args:
        rows: Ranges of the run.
        true_m: True ranges to start and end, at the times of ``rows``; NaN where unknown.
        number: Number of the run's approach.
        t_ns: Shape (N,).
    """
    right = np.zeros(len(t_ns), np.bool_)
    is_known = right.copy()
    for reference, true in zip(("start", "end"), true_m, strict=True):
        mine = np.flatnonzero(
            (rows.approach == number) & (rows.reference == reference) & np.isfinite(rows.range_m)
        )
        mine = mine[np.argsort(rows.t_ns[mine], kind="stable")]
        latest = np.searchsorted(rows.t_ns[mine], t_ns, side="right") - 1
        exists = latest >= 0
        at = mine[latest[exists]]
        error_m = np.abs(rows.range_m[at] - true[at])
        is_known[exists] |= np.isfinite(error_m)
        right[exists] |= error_m <= SDS_95 * np.sqrt(rows.var_m2[at])
    return right | ~is_known
