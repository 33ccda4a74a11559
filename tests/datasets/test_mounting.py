"""The mounting of a body in its car, estimated from its travel."""

import numpy as np
import pytest
from numpy.typing import NDArray

from crosscue.datasets.truth.tum import Trajectory, planar, turned_by


def _body(kappa_per_m: NDArray[np.float64], speed_mps: float, ahead_m: float) -> Trajectory:
    """Return the path of a body with a yaw of 0.02 rad, ahead of the rear axle, without slip."""
    heading = np.cumsum(kappa_per_m * speed_mps * 0.1)
    x, y = (np.cumsum(speed_mps * 0.1 * part(heading)) for part in (np.cos, np.sin))
    t_ns = np.arange(len(heading), dtype=np.int64) * 100_000_000
    x, y = x + ahead_m * np.cos(heading), y + ahead_m * np.sin(heading)
    return planar(t_ns, x, y, heading + 0.02)


@pytest.mark.parametrize("ahead_m", [-0.05, 2.1])
def test_mounting_yaw_is_estimated_from_travel(ahead_m: float) -> None:
    weave = 0.02 * np.sin(np.arange(300) * 0.05)

    found = turned_by(_body(weave, 12.0, ahead_m))

    assert found is not None
    assert abs(found.yaw_rad - 0.02) < 3 * found.sd_rad < 0.006


@pytest.mark.parametrize(
    ("kappa_per_m", "speed_mps", "rows"), [(0.0, 1.0, 300), (0.0, 12.0, 25), (0.05, 12.0, 300)]
)
def test_mounting_yaw_is_unknown_for_slow_short_or_curved_drive(
    kappa_per_m: float, speed_mps: float, rows: int
) -> None:
    assert turned_by(_body(np.full(rows, kappa_per_m), speed_mps, 1.5)) is None
