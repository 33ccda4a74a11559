"""A recognised landmark as a measurement of the pose filter."""

from typing import NamedTuple

from crosscue.replay.columns import Floats


class Sighting(NamedTuple):
    """A landmark that reached the filter.

    Attributes:
        t_ns: Time of the update.
        name: Name of the landmark.
        xy_m: Shape (2,): measured position of the camera, moved to ``t_ns``.
        cov_m2: Covariance of the position, shape (2, 2).
        score: Highest score of the match.
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
