"""Crossing a stretch of time in which nothing was measured: what the car could have done.

Across a short gap the car is taken to have gone on straight at its last speed. It may have changed
its speed by up to ``max_accel_mps2`` and turned by up to ``max_turn_rate_radps``; its place is
spread evenly over the disc that this allows.

Beyond a stated length nothing is assumed. The mean stays where the car was last seen, and the
position is spread evenly over the disc that the car could have reached (the variance along each
axis is a quarter of the radius squared), the heading over what turning allows.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from .ekf import PoseBelief, coast
from .pose_filter import HEADING, SPEED

FULL_TURN_VAR_RAD2 = math.pi**2 / 3.0
"""Of a heading of which nothing is known."""


@dataclass(frozen=True, slots=True)
class GapSettings:
    """What a car can do while nothing is measured.

    Attributes:
        restart_after_s: Longer gaps are not crossed at the last speed.
        max_accel_mps2: Change of speed.
        max_turn_rate_radps: Change of heading.
        max_speed_mps: Speed.
    """

    restart_after_s: float = 5.0
    max_accel_mps2: float = 4.0
    max_turn_rate_radps: float = 0.5
    max_speed_mps: float = 60.0


class Crossed(NamedTuple):
    """A belief at the end of a gap.

    Attributes:
        belief: After the gap.
        distance_m: How far its mean was moved along the heading.
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
    """Carry a belief over a gap that nothing measured.

    Args:
        belief: At the last measurement before it.
        until_ns: Time of the first one after it.
        settings: What the car can do.
        restarts: Assume nothing of the motion, however short the gap: its length is not known.

    Raises:
        ValueError: ``until_ns`` lies before the belief's time.
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
