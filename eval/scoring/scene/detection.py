"""When a feature counts as detected: as published, at once; or confirmed by frames and by range.

As published, the first frame above the threshold counts, with any range. A spike of one frame, or a
range 100 m off, then is a detection, and a far one. Confirmed means: above the threshold for three
frames, the range within its own 95 % interval of the true one in each of them. The distance is that
at the first of these frames, so both definitions agree where nothing is spurious.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from crosscue.eval.scoring.columns import RangeRows

Definition = Literal["confirmed", "published"]
CONFIRM_FRAMES: Final = 3
SDS_95: Final = 1.959964
Flags = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Rule:
    """What a detection must show.

    Attributes:
        frames: For how many frames in a row it must hold.
        checks_range: The range must be right, where the truth has one.
        full_after_detection: An approach that is detected is in full from there on at the earliest.
    """

    frames: int
    checks_range: bool
    full_after_detection: bool


RULES: Final[dict[Definition, Rule]] = {
    "confirmed": Rule(CONFIRM_FRAMES, checks_range=True, full_after_detection=True),
    "published": Rule(1, checks_range=False, full_after_detection=False),
}


def held(holds: Flags, frames: int) -> Flags:
    """Where a stretch of at least ``frames`` begins or goes on for as long, shape (N,)."""
    found = holds.copy()
    for ahead in range(1, frames):
        found[:-ahead] &= holds[ahead:]
        found[-ahead:] = False
    return found


def is_range_right(
    rows: RangeRows,
    true_m: tuple[NDArray[np.float64], NDArray[np.float64]],
    number: int,
    t_ns: NDArray[np.int64],
) -> Flags:
    """Is the latest range at each time within its 95 % interval of the true one?

    Of the ranges to start and end one is enough.

    Args:
        rows: The run's.
        true_m: To start and end, at the times of ``rows``; NaN where unknown.
        number: The run's approach.
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
