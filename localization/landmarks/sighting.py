"""A landmark recognised in a frame, as the pose filter takes it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class Sighting(NamedTuple):
    """A landmark that reached the filter.

    Attributes:
        t_ns: When it was weighed in.
        name: The landmark's.
        xy_m: Shape (2,): the camera's position as measured, carried to ``t_ns``.
        cov_m2: Shape (2, 2).
        score: At its best.
        nis: Normalised innovation squared, chi-square with two degrees of freedom.
        outcome: ``ACCEPTED`` or ``REJECTED`` by the gate.
    """

    t_ns: int
    name: str
    xy_m: NDArray[np.float64]
    cov_m2: NDArray[np.float64]
    score: float
    nis: float
    outcome: int
