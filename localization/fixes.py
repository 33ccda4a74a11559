"""Measured positions of a point of the car: GNSS, a true track, or landmarks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True, eq=False)
class Fixes:
    """N positions of a camera or an antenna.

    Attributes:
        t_ns: Shape (N,), int64.
        xy_m: Shape (N, 2).
        cov_m2: Shape (N, 2, 2).
    """

    t_ns: NDArray[np.int64]
    xy_m: NDArray[np.float64]
    cov_m2: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.t_ns)

    def take(self, index: NDArray[np.intp] | NDArray[np.bool_] | slice) -> Fixes:
        """Select fixes by ``index``."""
        return Fixes(self.t_ns[index], self.xy_m[index], self.cov_m2[index])


NO_FIXES: Final = Fixes(np.empty(0, np.int64), np.empty((0, 2)), np.empty((0, 2, 2)))
