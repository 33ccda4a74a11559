"""Angles on the circle; radians, counter-clockwise, wrapped to (-pi, pi]."""

import math
from typing import Final

import numpy as np

from crosscue.replay.columns import Floats, Int64s

TWO_PI: Final = 2.0 * math.pi


def wrap(angle_rad: float) -> float:
    """Wrap an angle to (-pi, pi]; an angle already in this interval is returned unchanged."""
    if -math.pi < angle_rad <= math.pi:
        return angle_rad
    return angle_rad - TWO_PI * math.ceil((angle_rad - math.pi) / TWO_PI)


def wrap_all(angles_rad: Floats) -> Floats:
    """``wrap`` for an array of any shape."""
    return angles_rad - TWO_PI * np.ceil((angles_rad - math.pi) / TWO_PI)


def interpolate_angle(
    at_ns: Int64s, t_ns: Int64s, angles_rad: Floats, max_gap_ns: int | None = None
) -> Floats:
    """Interpolate angles at other times, along the shorter arc between neighbours.

    Args:
        at_ns: Shape (M,): requested times.
        t_ns: Shape (N,), increasing: times of the known angles.
        angles_rad: Shape (N,).
        max_gap_ns: Maximum distance of neighbours to interpolate between.

    Returns:
        Shape (M,), wrapped; NaN outside the known times and inside gaps.
    """
    if len(t_ns) == 0:
        return np.full(len(at_ns), np.nan)
    after = np.clip(np.searchsorted(t_ns, at_ns, side="left"), 0, len(t_ns) - 1)
    exact = t_ns[after] == at_ns
    before = np.where(exact, after, np.maximum(after - 1, 0))
    span_ns = t_ns[after] - t_ns[before]
    fraction = np.where(span_ns > 0, (at_ns - t_ns[before]) / np.maximum(span_ns, 1), 0.0)
    turned = wrap_all(angles_rad[after] - angles_rad[before])
    found = wrap_all(angles_rad[before] + fraction * turned)
    is_known = (at_ns >= t_ns[0]) & (at_ns <= t_ns[-1])
    if max_gap_ns is not None:
        is_known &= span_ns <= max_gap_ns
    return np.where(is_known, found, np.nan)


def circular_mean(angles_rad: Floats) -> float:
    """Direction of the mean unit vector.

    Raises:
        ValueError: There are no angles, or they cancel out.
    """
    if len(angles_rad) == 0:
        raise ValueError("circular_mean: expected at least one angle, got none")
    east, north = float(np.mean(np.cos(angles_rad))), float(np.mean(np.sin(angles_rad)))
    if math.hypot(east, north) < 1e-9:
        raise ValueError("circular_mean: the angles cancel out, so they have no mean direction")
    return math.atan2(north, east)
