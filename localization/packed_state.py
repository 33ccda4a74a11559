"""The pose filter's state as fourteen plain floats, for loops of millions of steps.

The same numbers as ``predict_odometry``, ``update_speed`` and ``update_heading`` of ``ekf``; tests
hold the two equal.
"""

from __future__ import annotations

import math
from typing import Final, TypeAlias

import numpy as np

from .angles import wrap
from .ekf import HEADING, PoseBelief, arc

PackedState: TypeAlias = tuple[
    float, float, float, float,
    float, float, float, float, float, float, float, float, float, float,
]  # fmt: skip
"""x, y, heading, speed; then the covariance's upper triangle, row by row."""

HEADING_VARIANCE: Final = 11


def driven(
    state: PackedState,
    distance_m: float,
    turn_rad: float,
    distance_var: float,
    turn_var: float,
    speed_var: float,
) -> PackedState:
    """``predict_odometry`` in plain floats."""
    x, y, heading, speed, xx, xy, xh, xv, yy, yh, yv, hh, hv, vv = state
    step = arc(distance_m, turn_rad)
    c, s = math.cos(heading), math.sin(heading)
    mx, my = c * step.dx_m - s * step.dy_m, s * step.dx_m + c * step.dy_m
    dx = c * step.dx_by_distance - s * step.dy_by_distance
    dy = s * step.dx_by_distance + c * step.dy_by_distance
    tx = c * step.dx_by_turn - s * step.dy_by_turn
    ty = s * step.dx_by_turn + c * step.dy_by_turn
    return (
        x + mx,
        y + my,
        wrap(heading + turn_rad),
        speed,
        xx - 2.0 * my * xh + my * my * hh + dx * dx * distance_var + tx * tx * turn_var,
        xy + mx * xh - my * yh - mx * my * hh + dx * dy * distance_var + tx * ty * turn_var,
        xh - my * hh + tx * turn_var,
        xv - my * hv,
        yy + 2.0 * mx * yh + mx * mx * hh + dy * dy * distance_var + ty * ty * turn_var,
        yh + mx * hh + ty * turn_var,
        yv + mx * hv,
        hh + turn_var,
        hv,
        vv + speed_var,
    )


def weighed(state: PackedState, measured: int, innovation: float, var: float) -> PackedState:
    """Joseph update of one directly measured state in plain floats.

    Args:
        state: Before.
        measured: ``HEADING`` or ``SPEED``.
        innovation: Measured less expected.
        var: The measurement's variance.
    """
    x, y, heading, speed, xx, xy, xh, xv, yy, yh, yv, hh, hv, vv = state
    px, py, ph, pv = (xh, yh, hh, hv) if measured == HEADING else (xv, yv, hv, vv)
    spread = (ph if measured == HEADING else pv) + var
    kx, ky, kh, kv = px / spread, py / spread, ph / spread, pv / spread
    return (
        x + kx * innovation,
        y + ky * innovation,
        wrap(heading + kh * innovation),
        speed + kv * innovation,
        xx - 2.0 * kx * px + kx * kx * spread,
        xy - kx * py - ky * px + kx * ky * spread,
        xh - kx * ph - kh * px + kx * kh * spread,
        xv - kx * pv - kv * px + kx * kv * spread,
        yy - 2.0 * ky * py + ky * ky * spread,
        yh - ky * ph - kh * py + ky * kh * spread,
        yv - ky * pv - kv * py + ky * kv * spread,
        hh - 2.0 * kh * ph + kh * kh * spread,
        hv - kh * pv - kv * ph + kh * kv * spread,
        vv - 2.0 * kv * pv + kv * kv * spread,
    )


def packed(belief: PoseBelief) -> PackedState:
    """The belief's numbers; its time stays behind."""
    p = belief.cov
    numbers = (*belief.mean, *p[0], *p[1, 1:], *p[2, 2:], p[3, 3])
    x, y, heading, speed, xx, xy, xh, xv, yy, yh, yv, hh, hv, vv = map(float, numbers)
    return x, y, heading, speed, xx, xy, xh, xv, yy, yh, yv, hh, hv, vv


def unpacked(t_ns: int, state: PackedState) -> PoseBelief:
    """A belief with just these numbers."""
    x, y, heading, speed, xx, xy, xh, xv, yy, yh, yv, hh, hv, vv = state
    cov = np.array([[xx, xy, xh, xv], [xy, yy, yh, yv], [xh, yh, hh, hv], [xv, yv, hv, vv]])
    return PoseBelief(t_ns, np.array([x, y, heading, speed]), cov)
