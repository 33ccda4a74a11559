"""A landmark recognised in a frame, as the pose filter takes it."""

from __future__ import annotations

from typing import NamedTuple

from crosscue.replay.columns import Floats


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
    xy_m: Floats
    cov_m2: Floats
    score: float
    nis: float
    outcome: int
