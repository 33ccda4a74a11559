"""Scalar Kalman filter of the distance to an intersection, as pure functions.

The state is the distance in metres, along the path, from the rear axle to the start of the
intersection (measured by a stop sign) or to its end (measured by a traffic light). The two are
never mixed. Equation numbers are those of Chipka (2018), chapter 3. filterpy computes them, with
the variance in Joseph's form, which remains positive. It is imported at the first range, because
the import takes longer than the estimation of a short drive without ranges.
"""

from collections.abc import Sequence
from enum import StrEnum
from typing import NamedTuple

import numpy as np


class Reference(StrEnum):
    """Reference point of a range."""

    START = "start"
    END = "end"


class RangeBelief(NamedTuple):
    """A Gaussian over the distance to one reference.

    Attributes:
        mean_m: Mean distance; negative once the rear axle is past the reference.
        var_m2: Variance of the distance, positive.
    """

    mean_m: float
    var_m2: float


def initialise(measured_m: float, sensor_var_m2: float) -> RangeBelief:
    """Initialise the belief with the first measurement.

    Raises:
        ValueError: ``sensor_var_m2`` is not positive.
    """
    if not sensor_var_m2 > 0.0:
        raise ValueError(f"sensor_var_m2: expected > 0, got {sensor_var_m2}")
    return RangeBelief(measured_m, sensor_var_m2)


def predict(belief: RangeBelief, travelled_m: float, odometry_var_m2: float) -> RangeBelief:
    """Predict over ``travelled_m`` (negative in reverse) and add its variance (eq. 8 and 9).

    Raises:
        ValueError: ``odometry_var_m2`` is negative.
    """
    if not odometry_var_m2 >= 0.0:
        raise ValueError(f"odometry_var_m2: expected >= 0, got {odometry_var_m2}")
    from filterpy.kalman import predict as kalman_predict

    mean_m, var_m2 = kalman_predict(
        x=belief.mean_m, P=belief.var_m2, u=travelled_m, B=-1.0, Q=odometry_var_m2
    )
    return RangeBelief(float(mean_m), float(var_m2))


def range_noise_m2(travelled_m: float, odometry_var_m2: float, seconds: float) -> float:
    """Variance that a range gains while the car travels: the process noise of every range.

    Filters, beliefs over distance, tracks of lights and signs, the smoother and the fits take it
    from the odometer, which calls this function; it is defined nowhere else.

    Args:
        travelled_m: Distance, negative in reverse.
        odometry_var_m2: Variance of the distance by the odometry.
        seconds: Time that the odometry covers.
    """
    return odometry_var_m2


def nis(belief: RangeBelief, measured_m: float, sensor_var_m2: float) -> float:
    """Normalised innovation squared; chi-squared with one degree of freedom if consistent."""
    return (measured_m - belief.mean_m) ** 2 / (belief.var_m2 + sensor_var_m2)


def update(belief: RangeBelief, measured_m: float, sensor_var_m2: float) -> RangeBelief:
    """Update with one measured distance (eq. 10 to 12).

    Raises:
        ValueError: ``sensor_var_m2`` is not positive.
    """
    if not sensor_var_m2 > 0.0:
        raise ValueError(f"sensor_var_m2: expected > 0, got {sensor_var_m2}")
    from filterpy.kalman import update as kalman_update

    # filterpy reads the number of dimensions from the mean, which a plain float does not have.
    mean_m, var_m2 = kalman_update(
        x=np.float64(belief.mean_m), P=belief.var_m2, z=measured_m, R=sensor_var_m2
    )
    return RangeBelief(float(mean_m), float(var_m2))


def smooth_ranges(
    filtered: Sequence[RangeBelief], travelled_m: Sequence[float], odometry_var_m2: Sequence[float]
) -> list[RangeBelief]:
    """Smooth all steps with all measurements (Rauch, Tung, Striebel, 1965).

    The model is linear and Gaussian, so this is the exact solution of the factor graph.

    Args:
        filtered: Filtered beliefs of N steps.
        travelled_m: Distances between successive steps, N - 1.
        odometry_var_m2: Variances of those distances.
    """
    found = [filtered[-1]]
    steps = zip(filtered[:-1], travelled_m, odometry_var_m2, strict=True)
    for now, way_m, way_var_m2 in reversed(list(steps)):
        ahead, later = predict(now, way_m, way_var_m2), found[-1]
        gain = now.var_m2 / ahead.var_m2
        mean_m = now.mean_m + gain * (later.mean_m - ahead.mean_m)
        found.append(RangeBelief(mean_m, now.var_m2 + gain**2 * (later.var_m2 - ahead.var_m2)))
    return found[::-1]
