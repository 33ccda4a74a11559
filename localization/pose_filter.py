"""The pose filter: an EKF on x, y, heading and speed, as plain functions on plain numbers.

Motion is the dissertation's bicycle model (eq. 5 and 6): an arc of length d that turns by dtheta,

    dx = d sin(dtheta) / dtheta,    dy = d (1 - cos(dtheta)) / dtheta    (in the car's frame).

Measurements are of states themselves (a compass heading, a speed, a landmark's position). Filter
equations: Bar-Shalom, Li, Kirubarajan, *Estimation with Applications to Tracking and Navigation*,
section 10.3 (EKF) and 5.2.3 (update, here as P - K S K').

These equations exist only here. The replay calls them, and the Monte Carlo studies compile them.
"""

import math
from typing import Final, NamedTuple

from .angles import wrap

HEADING: Final = 2
SPEED: Final = 3
# Angle below which ``arc`` uses series, which are exact to rounding there.
SMALL_RAD: Final = 1e-2


class State(NamedTuple):
    """Mean and covariance: x, y in metres, heading in radians, speed in m/s; upper triangle."""

    x_m: float
    y_m: float
    heading_rad: float
    speed_mps: float
    xx: float
    xy: float
    xh: float
    xv: float
    yy: float
    yh: float
    yv: float
    hh: float
    hv: float
    vv: float


class Arc(NamedTuple):
    """A step along a circle in the car's frame, with its derivatives.

    Attributes:
        dx_m: Displacement forward.
        dy_m: Displacement to the left.
        dx_by_distance: Derivative of ``dx_m`` by the arc's length.
        dy_by_distance: Derivative of ``dy_m`` by the arc's length.
        dx_by_turn: Derivative of ``dx_m`` by the angle turned, m/rad.
        dy_by_turn: Derivative of ``dy_m`` by the angle turned, m/rad.
    """

    dx_m: float
    dy_m: float
    dx_by_distance: float
    dy_by_distance: float
    dx_by_turn: float
    dy_by_turn: float


def arc(distance_m: float, turn_rad: float) -> Arc:
    """Compute the arc of length ``distance_m`` that turns by ``turn_rad`` (eq. 6)."""
    t, t2 = turn_rad, turn_rad * turn_rad
    if abs(t) < SMALL_RAD:
        along = 1.0 - t2 / 6.0 * (1.0 - t2 / 20.0)
        across = t / 2.0 * (1.0 - t2 / 12.0 * (1.0 - t2 / 30.0))
        along_by_turn = -t / 3.0 * (1.0 - t2 / 10.0 * (1.0 - t2 / 28.0))
        across_by_turn = 0.5 - t2 / 8.0 * (1.0 - t2 / 18.0 * (1.0 - t2 / 40.0))
    else:
        sine = math.sin(t)
        along = sine / t
        across = 2.0 * math.sin(t / 2.0) ** 2 / t
        along_by_turn = (math.cos(t) - along) / t
        across_by_turn = (sine - across) / t
    return Arc(
        distance_m * along,
        distance_m * across,
        along,
        across,
        distance_m * along_by_turn,
        distance_m * across_by_turn,
    )


def predict_pose(
    state: State,
    distance_m: float,
    turn_rad: float,
    distance_var_m2: float,
    turn_var_rad2: float,
    speed_var_m2ps2: float,
) -> State:
    """Predict along the arc that odometry measured; the speed's mean remains, its variance grows.

    Args:
        state: State before the interval.
        distance_m: Distance travelled by the rear axle, negative in reverse.
        turn_rad: Change of heading.
        distance_var_m2: Variance of the distance.
        turn_var_rad2: Variance of the change of heading.
        speed_var_m2ps2: Increase of the speed's variance.
    """
    x, y, heading, speed, xx, xy, xh, xv, yy, yh, yv, hh, hv, vv = state
    step = arc(distance_m, turn_rad)
    c, s = math.cos(heading), math.sin(heading)
    mx, my = c * step.dx_m - s * step.dy_m, s * step.dx_m + c * step.dy_m
    dx = c * step.dx_by_distance - s * step.dy_by_distance
    dy = s * step.dx_by_distance + c * step.dy_by_distance
    tx = c * step.dx_by_turn - s * step.dy_by_turn
    ty = s * step.dx_by_turn + c * step.dy_by_turn
    return State(
        x + mx,
        y + my,
        wrap(heading + turn_rad),
        speed,
        xx - 2.0 * my * xh + my * my * hh + dx * dx * distance_var_m2 + tx * tx * turn_var_rad2,
        xy + mx * xh - my * yh - mx * my * hh + dx * dy * distance_var_m2 + tx * ty * turn_var_rad2,
        xh - my * hh + tx * turn_var_rad2,
        xv - my * hv,
        yy + 2.0 * mx * yh + mx * mx * hh + dy * dy * distance_var_m2 + ty * ty * turn_var_rad2,
        yh + mx * hh + ty * turn_var_rad2,
        yv + mx * hv,
        hh + turn_var_rad2,
        hv,
        vv + speed_var_m2ps2,
    )


def update_state(state: State, measured: int, innovation: float, var: float) -> State:
    """Fuse a measurement of one state.

    Args:
        state: State before.
        measured: ``HEADING`` or ``SPEED``.
        innovation: Measured minus expected value; wrapped for a heading.
        var: Variance of the measurement.
    """
    x, y, heading, speed, xx, xy, xh, xv, yy, yh, yv, hh, hv, vv = state
    px, py, ph, pv = (xh, yh, hh, hv) if measured == HEADING else (xv, yv, hv, vv)
    spread = (ph if measured == HEADING else pv) + var
    kx, ky, kh, kv = px / spread, py / spread, ph / spread, pv / spread
    return State(
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


class PositionUpdate(NamedTuple):
    """Outcome of a measured position; if it is rejected, the state is unchanged."""

    state: State
    is_accepted: bool
    nis: float


def update_position(
    state: State, x_m: float, y_m: float, var_x: float, cov_xy: float, var_y: float, gate_nis: float
) -> PositionUpdate:
    """Fuse a measured position, unless its normalised innovation squared exceeds the gate.

    Args:
        state: State before.
        x_m: Measured x.
        y_m: Measured y.
        var_x: Variance of the measured x, m2.
        cov_xy: Covariance of the measured x and y, m2.
        var_y: Variance of the measured y, m2.
        gate_nis: NIS above which the position is rejected; infinity accepts everything.
    """
    x, y, heading, speed, xx, xy, xh, xv, yy, yh, yv, hh, hv, vv = state
    ix, iy = x_m - x, y_m - y
    sxx, sxy, syy = xx + var_x, xy + cov_xy, yy + var_y
    per = 1.0 / (sxx * syy - sxy * sxy)
    wx, wy = (syy * ix - sxy * iy) * per, (sxx * iy - sxy * ix) * per
    nis = ix * wx + iy * wy
    if nis > gate_nis:
        return PositionUpdate(state, False, nis)
    # Gains by x and by y of each state: P H' S^-1.
    xa, xb = (xx * syy - xy * sxy) * per, (xy * sxx - xx * sxy) * per
    ya, yb = (xy * syy - yy * sxy) * per, (yy * sxx - xy * sxy) * per
    ha, hb = (xh * syy - yh * sxy) * per, (yh * sxx - xh * sxy) * per
    va, vb = (xv * syy - yv * sxy) * per, (yv * sxx - xv * sxy) * per
    after = State(
        x + xa * ix + xb * iy,
        y + ya * ix + yb * iy,
        wrap(heading + ha * ix + hb * iy),
        speed + va * ix + vb * iy,
        xx - xa * xx - xb * xy,
        xy - xa * xy - xb * yy,
        xh - xa * xh - xb * yh,
        xv - xa * xv - xb * yv,
        yy - ya * xy - yb * yy,
        yh - ya * xh - yb * yh,
        yv - ya * xv - yb * yv,
        hh - ha * xh - hb * yh,
        hv - ha * xv - hb * yv,
        vv - va * xv - vb * yv,
    )
    return PositionUpdate(after, True, nis)


def at_point(state: State, ahead_m: float, left_m: float) -> State:
    """Transform a state to another point of the car, with the effect of the heading's error.

    Args:
        state: State of a point of the car.
        ahead_m: Distance of the other point ahead of it.
        left_m: Distance of the other point to its left.
    """
    x, y, heading, speed, xx, xy, xh, xv, yy, yh, yv, hh, hv, vv = state
    c, s = math.cos(heading), math.sin(heading)
    dx, dy = c * ahead_m - s * left_m, s * ahead_m + c * left_m
    return State(
        x + dx,
        y + dy,
        heading,
        speed,
        xx - 2.0 * dy * xh + dy * dy * hh,
        xy + dx * xh - dy * yh - dx * dy * hh,
        xh - dy * hh,
        xv - dy * hv,
        yy + 2.0 * dx * yh + dx * dx * hh,
        yh + dx * hh,
        yv + dx * hv,
        hh,
        hv,
        vv,
    )


def major_axis_m(var_x: float, cov_xy: float, var_y: float) -> float:
    """Full major axis of the 2-sigma position ellipse: four standard deviations."""
    radius = math.hypot(0.5 * (var_x - var_y), cov_xy)
    return 4.0 * math.sqrt(max(0.5 * (var_x + var_y) + radius, 0.0))


def pose_nees(ex: float, ey: float, eh: float, state: State) -> float:
    """Normalised estimation error squared of x, y and heading, by the Cholesky factor."""
    a = math.sqrt(state.xx)
    b, c = state.xy / a, state.xh / a
    d = math.sqrt(state.yy - b * b)
    e = (state.yh - b * c) / d
    f = math.sqrt(state.hh - c * c - e * e)
    u = ex / a
    v = (ey - b * u) / d
    w = (eh - c * u - e * v) / f
    return u * u + v * v + w * w
