"""Fit the scales of the front wheels to the motion of the rear axle.

The distance that a wheel of a rigid body rolls is known. Its component along the body is the rear
axle's distance minus or plus half the track width times the turn; its component across the body is
the wheelbase times the turn. The ratio of this distance to the reported one is the wheel's scale.
The standard deviation is that between pieces of the drive, so that it includes persistent errors.
"""

import math
from typing import Final, NamedTuple

import numpy as np

from crosscue.localization.odometry import Increments, OdometrySettings, WheelSamples
from crosscue.replay.columns import Floats, Int64s

PIECES: Final = 10
MIN_ROWS: Final = 10 * PIECES
# Relative standard deviation of the given track width and wheelbase.
LENGTH_DOUBT: Final = 0.1


class FrontWheel(NamedTuple):
    """Scale of one front wheel relative to ``wheel_scale``, and its standard deviation."""

    setting: str
    scale: float
    sd: float


def front_wheels(
    wheels: WheelSamples, made: Increments, settings: OdometrySettings, span_ns: tuple[int, int]
) -> tuple[FrontWheel, ...]:
    """Return the scales of the front wheels that move and have independent speed readings.

    Args:
        wheels: Wheel speeds of the drive.
        made: Odometry of the same drive by ``settings``.
        settings: Fitted settings.
        span_ns: First and last time of the part that is fitted.
    """
    speeds = wheels.wheels_mps
    if speeds.shape[1] != 4 or settings.wheelbase_m is None:
        return ()
    kept = np.isfinite(speeds).all(axis=1)
    since_ns = span_ns[0] + round(settings.wheel_delay_s * 1e9)
    speeds, t_s = speeds[kept], _seconds(wheels.t_ns[kept], since_ns)
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
    """Distance that a wheel reports for each interval."""
    steps_m = 0.5 * (speed_mps[1:] + speed_mps[:-1]) * np.diff(t_s)
    way_m = np.append(0.0, np.cumsum(steps_m))
    return np.asarray(np.interp(stops_s, t_s, way_m) - np.interp(starts_s, t_s, way_m))
