"""Measured positions of a point of the car: GNSS, a true track, or landmarks."""

from dataclasses import dataclass
from typing import Final

import numpy as np

from crosscue.replay.columns import ColumnSet, Floats, Int64s


@dataclass(frozen=True, slots=True, eq=False)
class Fixes(ColumnSet):
    """N positions of a camera or an antenna.

    Attributes:
        t_ns: Shape (N,), int64.
        xy_m: Shape (N, 2).
        cov_m2: Shape (N, 2, 2).
    """

    t_ns: Int64s
    xy_m: Floats
    cov_m2: Floats


NO_FIXES: Final = Fixes(np.empty(0, np.int64), np.empty((0, 2)), np.empty((0, 2, 2)))
