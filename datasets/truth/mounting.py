"""Estimate the mounting of a tracked body in its vehicle from the direction of travel."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np

from .truth import Mounting
from .tum import Trajectory, heading_rad

_TRAVEL_STEP_S: Final = 1.0
# Min length of a step; over a shorter one, positions with centimetre errors do not determine the
# course to half a degree.
_TRAVEL_MIN_M: Final = 3.0
_TRAVEL_MIN_STEPS: Final = 3
# Min standard deviation of a step's course, from the vehicle's slip and the track's error.
_TRAVEL_SD_RAD: Final = 0.005
_LEVER_M: Final = 1.0
# Prior standard deviation of the lever: the body is between the rear axle and the windscreen.
_LEVER_SD_M: Final = 1.5
# Max standard deviation of the yaw that is accepted, 0.3 degrees.
_TURNED_MAX_SD_RAD: Final = 0.005


class TurnedBy(NamedTuple):
    """Yaw of a body in its vehicle, counter-clockwise, and the standard deviation."""

    yaw_rad: float
    sd_rad: float


def turned_by(trajectory: Trajectory) -> TurnedBy | None:
    """Estimate a body's yaw in its vehicle from the direction of travel.

    The centre of the rear axle moves in the direction of the vehicle, which does not slip sideways.
    A point ahead of it swings outwards by its lever times the curvature. The body's heading minus
    its course is therefore its yaw minus that swing; both are fitted, the lever with a wide prior.

    Returns:
        The yaw, or None if the drive is too short, too slow, or curved throughout.
    """
    ends_s = (trajectory.t_ns - trajectory.t_ns[0]) * 1e-9
    at_s = np.arange(0.0, ends_s[-1], _TRAVEL_STEP_S)
    x, y = (np.interp(at_s, ends_s, trajectory.xyz_m[:, axis]) for axis in (0, 1))
    turned = np.unwrap(heading_rad(trajectory))
    heading, middle = (
        np.interp(t_s, ends_s, turned) for t_s in (at_s, at_s[:-1] + 0.5 * _TRAVEL_STEP_S)
    )
    step_m = np.hypot(np.diff(x), np.diff(y))
    moves = step_m > _TRAVEL_MIN_M
    if np.count_nonzero(moves) < _TRAVEL_MIN_STEPS:
        return None
    aside = np.angle(np.exp(1j * (middle - np.arctan2(np.diff(y), np.diff(x)))))[moves]
    curvature = (np.diff(heading) / np.maximum(step_m, _TRAVEL_MIN_M))[moves]
    rows = np.column_stack([np.ones(len(aside)), -curvature])
    sd_rad = _TRAVEL_SD_RAD
    for _ in range(2):
        weights = rows.T @ rows / sd_rad**2 + np.diag([0.0, _LEVER_SD_M**-2])
        found = np.linalg.solve(
            weights, rows.T @ aside / sd_rad**2 + [0.0, _LEVER_M * _LEVER_SD_M**-2]
        )
        sd_rad = max(_TRAVEL_SD_RAD, float(np.sqrt(np.mean((aside - rows @ found) ** 2))))
    yaw_sd_rad = float(np.sqrt(np.linalg.inv(weights)[0, 0]))
    return TurnedBy(float(found[0]), yaw_sd_rad) if yaw_sd_rad < _TURNED_MAX_SD_RAD else None


def mounting_in_car(
    track: Trajectory,
    stated: str = "position not published",
    *,
    x_m: float | None = None,
    y_m: float | None = None,
    z_m: float | None = None,
) -> tuple[Mounting, str]:
    """Return the mounting of a body with unknown yaw, which is estimated from its travel.

    Args:
        track: Trajectory of the body.
        stated: Published description of its position, and its source.
        x_m: Published position; see ``Mounting``.
        y_m: Published position.
        z_m: Published position.

    Returns:
        The mounting, and its source.
    """
    found = turned_by(track)
    yaw_rad = None if found is None else round(found.yaw_rad, 5)
    mounting = Mounting(x_m=x_m, y_m=y_m, z_m=z_m, roll_rad=None, pitch_rad=None, yaw_rad=yaw_rad)
    if found is None:
        return mounting, f"{stated}; yaw unknown, and the drive does not determine it"
    degrees = math.degrees(found.sd_rad)
    return mounting, f"{stated}; yaw by its direction of travel, +- {degrees:.2f} deg"
