"""Scales of the front wheels, from the motion of the rear axle.

A wheel of a rigid body rolls a known way: along the body, the rear axle's distance less or plus
half the track width times the turn, and across it, the wheelbase times the turn. The ratio of that
way to the one that the wheel reports is the wheel's scale. Pieces of the drive are compared with
each other, so that errors that persist are counted in the standard deviation.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np

from crosscue.localization.odometry import Increments, OdometrySettings, WheelSpeeds
from crosscue.replay.base import Floats, Int64s

PIECES: Final = 10
MIN_ROWS: Final = 10 * PIECES
LENGTH_DOUBT: Final = 0.1
"""Standard deviation of track width and wheelbase as given, as fractions."""


class FrontWheel(NamedTuple):
    """Scale of one front wheel, with ``wheel_scale`` taken off, and its standard deviation."""

    setting: str
    scale: float
    sd: float


def front_wheels(
    wheels: WheelSpeeds, made: Increments, settings: OdometrySettings, span_ns: tuple[int, int]
) -> tuple[FrontWheel, ...]:
    """Return the scales of the front wheels that turned and have a speed of their own.

    Args:
        wheels: Wheel speeds of the drive.
        made: Odometry of the same drive with ``settings``.
        settings: Fitted settings.
        span_ns: First and last time of the part that is fitted.
    """
    speeds = wheels.signed_mps()
    if speeds.shape[1] != 4 or settings.wheelbase_m is None:
        return ()
    kept = np.isfinite(speeds).all(axis=1)
    speeds, t_s = speeds[kept], _seconds(wheels.t_ns[kept], span_ns[0])
    has_own = len(speeds) > 1 and len({column.tobytes() for column in speeds.T}) == 4
    is_driven = ~made.is_gap & (made.distance_m > 0.0)
    is_driven &= (made.start_ns >= span_ns[0]) & (made.stop_ns <= span_ns[1])
    if not has_own or is_driven.sum() < MIN_ROWS:
        return ()
    starts_s, stops_s = (_seconds(t_ns, span_ns[0]) for t_ns in (made.start_ns, made.stop_ns))
    distance_m, turn_rad = made.distance_m[is_driven], made.turn_rad[is_driven]
    sideways_m = settings.wheelbase_m * turn_rad
    piece = np.minimum(np.cumsum(distance_m) / distance_m.sum() * PIECES, PIECES - 1).astype(int)
    found = []
    for column, (setting, side) in enumerate((("front_left_scale", -1), ("front_right_scale", 1))):
        reported_m = _rolled(speeds[:, column], t_s, starts_s, stops_s)[is_driven]
        aside_m = side * 0.5 * settings.track_width_m * turn_rad
        true_m = np.hypot(distance_m + aside_m, sideways_m)
        reported, true = (np.bincount(piece, way_m, PIECES) for way_m in (reported_m, true_m))
        if not (reported > 0.0).all():
            continue
        scale = float(true_m.sum() / reported_m.sum()) / settings.wheel_scale
        scatter = float(np.std(true / reported, ddof=1)) / settings.wheel_scale / math.sqrt(PIECES)
        by_lengths_m = aside_m + sideways_m**2 / distance_m
        doubt = LENGTH_DOUBT * scale * abs(float(by_lengths_m.sum())) / float(distance_m.sum())
        found.append(FrontWheel(setting, scale, math.hypot(scatter, doubt)))
    return tuple(found)


def _seconds(t_ns: Int64s, since_ns: int) -> Floats:
    return np.asarray((t_ns - since_ns) * 1e-9, np.float64)


def _rolled(speed_mps: Floats, t_s: Floats, starts_s: Floats, stops_s: Floats) -> Floats:
    """Way that a wheel reports for each interval."""
    steps_m = 0.5 * (speed_mps[1:] + speed_mps[:-1]) * np.diff(t_s)
    way_m = np.append(0.0, np.cumsum(steps_m))
    return np.asarray(np.interp(stops_s, t_s, way_m) - np.interp(starts_s, t_s, way_m))
