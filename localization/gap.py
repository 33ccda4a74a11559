"""Predict a belief across a gap without measurements, from the car's possible motion.

Across a short gap, the car is assumed to continue straight at its last speed. It can change its
speed by up to ``max_accel_mps2`` and turn by up to ``max_turn_rate_radps``; its position is
uniformly distributed over the resulting disc.

Across a longer gap, nothing is assumed. The mean remains at the last position. The position is
uniformly distributed over the disc that the car can reach (the variance along each axis is a
quarter of the radius squared), and the heading over the angles that it can turn.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from .ekf import PoseBelief, coast
from .pose_filter import HEADING, SPEED

# Variance of an unknown heading.
FULL_TURN_VAR_RAD2 = math.pi**2 / 3.0


@dataclass(frozen=True, slots=True)
class GapSettings:
    """Limits of a car's motion during a gap.

    Attributes:
        restart_after_s: Length of a gap above which constant speed is not assumed.
        max_accel_mps2: Maximum acceleration.
        max_turn_rate_radps: Maximum yaw rate.
        max_speed_mps: Maximum speed.
    """

    restart_after_s: float = 5.0
    max_accel_mps2: float = 4.0
    max_turn_rate_radps: float = 0.5
    max_speed_mps: float = 60.0


class Crossed(NamedTuple):
    """A belief at the end of a gap.

    Attributes:
        belief: Belief after the gap.
        distance_m: Distance by which the mean was moved along the heading.
        distance_var_m2: Variance that the gap added to the position, along each axis.
        turn_var_rad2: Variance that the gap added to the heading.
    """

    belief: PoseBelief
    distance_m: float
    distance_var_m2: float
    turn_var_rad2: float


def cross_gap(
    belief: PoseBelief, until_ns: int, settings: GapSettings, *, restarts: bool = False
) -> Crossed:
    """Predict a belief across a gap without measurements.

    Args:
        belief: Belief at the last measurement before the gap.
        until_ns: Time of the first measurement after the gap.
        settings: Limits of the car's motion.
        restarts: True to assume nothing about the motion, because the gap's length is unknown.

    Raises:
        ValueError: ``until_ns`` is before the belief's time.
    """
    dt_s = (until_ns - belief.t_ns) * 1e-9
    if dt_s < 0.0:
        raise ValueError(f"until_ns: expected >= {belief.t_ns}, got {until_ns}")
    speed_mps = abs(float(belief.mean[SPEED]))
    faster_m = 0.5 * settings.max_accel_mps2 * dt_s * dt_s
    reach_m = min(speed_mps * dt_s + faster_m, max(settings.max_speed_mps, speed_mps) * dt_s)
    turn_rad = settings.max_turn_rate_radps * dt_s
    turn_var = min(turn_rad**2 / 3.0, FULL_TURN_VAR_RAD2)
    if restarts or dt_s > settings.restart_after_s:
        distance_m, var_m2 = 0.0, reach_m**2 / 4.0
        mean, cov = belief.mean.copy(), belief.cov.copy()
    else:
        distance_m = float(belief.mean[SPEED]) * dt_s
        off_m = min(faster_m + 0.5 * speed_mps * dt_s * turn_rad, reach_m)
        var_m2 = off_m**2 / 4.0
        gone = coast(belief, dt_s, 0.0, 0.0)
        mean, cov = gone.mean, gone.cov.copy()
    change_mps = min(settings.max_accel_mps2 * dt_s, settings.max_speed_mps)
    cov += np.diag([var_m2, var_m2, 0.0, 0.0])
    cov[HEADING, HEADING] += turn_var
    cov[SPEED, SPEED] += change_mps**2
    return Crossed(PoseBelief(until_ns, mean, cov), distance_m, var_m2, turn_var)
