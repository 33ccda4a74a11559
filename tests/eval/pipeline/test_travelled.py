"""Motion between two times, read from the stored odometry of a run."""

from __future__ import annotations

import numpy as np
import pytest

from crosscue.eval.runs.tables.travelled import Odometer, Way

SECOND = 1_000_000_000


def _odometer() -> Odometer:
    """Odometry at 10 m/s: two seconds, an assumed gap of two seconds, and two more seconds."""
    start = np.array([0, 1, 2, 4, 5]) * SECOND
    stop = np.array([1, 2, 4, 5, 6]) * SECOND
    distance_m = np.array([10.0, 10.0, 20.0, 10.0, 10.0])
    is_gap = np.array([False, False, True, False, False])
    return Odometer(iter([(start, stop, distance_m, 0.1 * distance_m, 0.01 * distance_m, is_gap)]))


def test_distance_across_gap_is_reported_as_assumed() -> None:
    odometer = _odometer()

    assert odometer.until(SECOND) == Way(10.0, 0.1, 1.0, SECOND)
    assert odometer.until(3 * SECOND) == Way(20.0, 0.2, 2.0, 2 * SECOND, SECOND, 10.0)
    rest = odometer.until(6 * SECOND)
    assert (rest.distance_m, rest.assumed_m) == pytest.approx((30.0, 10.0))


def test_distance_before_skip_is_not_counted() -> None:
    odometer = _odometer()

    odometer.skip_to(3 * SECOND)

    assert odometer.until(5 * SECOND) == Way(10.0, 0.1, 1.0, SECOND)
