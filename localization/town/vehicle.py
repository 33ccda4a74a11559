"""The simulated vehicle: lane keeping, motion, wheel encoders and compass.

The true motion is a bicycle model (eq. 5 and 6) that PID controllers keep in its lane.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

from crosscue.localization.angles import wrap
from crosscue.localization.pose_filter import arc

from .parameters import Parameters
from .random_stream import RandomStream, normal

MAX_STEERING_RAD: Final = 0.7
# Ratio of the maximum deceleration to the maximum acceleration.
BRAKE_FACTOR: Final = 1.5
MIN_SPEED_MPS: Final = 1.0
# Bound of both controllers' integrals.
MAX_INTEGRAL: Final = 2.0


class Lane(NamedTuple):
    """Lane relative to the vehicle: offset (left positive), its change per metre, curvature."""

    offset_m: float
    growth: float
    curvature: float


class TownVehicle(NamedTuple):
    """True state of the vehicle, and state of controllers and encoders."""

    x_m: float
    y_m: float
    heading_rad: float
    speed_mps: float
    accel_mps2: float
    offset_integral: float
    speed_integral: float
    travelled_m: float
    unread_left_m: float
    unread_right_m: float
    since_compass_m: float


class Reading(NamedTuple):
    """Measurements of one step; ``compass_rad`` is NaN without a reading."""

    left_m: float
    right_m: float
    compass_rad: float


def steering_rad(p: Parameters, lane: Lane, offset_integral: float) -> float:
    """Steering angle by PID control of the offset, with the lane's curvature as feedforward."""
    angle = p.wheelbase_m * lane.curvature - p.steering_p * lane.offset_m
    angle -= p.steering_i * offset_integral + p.steering_d * lane.growth
    return min(max(angle, -MAX_STEERING_RAD), MAX_STEERING_RAD)


def move(p: Parameters, vehicle: TownVehicle, lane: Lane, wanted_mps: float) -> TownVehicle:
    """Control the vehicle and move it by one step (eq. 5 and 6)."""
    v, dt = vehicle, p.step_s
    slow = wanted_mps - v.speed_mps
    speed_integral = _bounded(v.speed_integral + slow * dt)
    accel = p.speed_p * slow + p.speed_i * speed_integral - p.speed_d * v.accel_mps2
    accel = min(max(accel, -BRAKE_FACTOR * p.accel_mps2), p.accel_mps2)
    accel = max(accel, (MIN_SPEED_MPS - v.speed_mps) / dt)
    distance = v.speed_mps * dt + 0.5 * accel * dt**2
    turned = distance * steering_rad(p, lane, v.offset_integral) / p.wheelbase_m
    step = arc(distance, turned)
    c, s = math.cos(v.heading_rad), math.sin(v.heading_rad)
    return TownVehicle(
        v.x_m + c * step.dx_m - s * step.dy_m,
        v.y_m + s * step.dx_m + c * step.dy_m,
        wrap(v.heading_rad + turned),
        v.speed_mps + accel * dt,
        accel,
        _bounded(v.offset_integral + lane.offset_m * distance),
        speed_integral,
        v.travelled_m + distance,
        v.unread_left_m,
        v.unread_right_m,
        v.since_compass_m,
    )


def _bounded(integral: float) -> float:
    return min(max(integral, -MAX_INTEGRAL), MAX_INTEGRAL)


def measure_step(
    p: Parameters, before: TownVehicle, after: TownVehicle, noise: RandomStream
) -> tuple[TownVehicle, Reading, RandomStream]:
    """Measure wheel paths with slip and encoder resolution, and the compass if a reading is due."""
    distance = after.travelled_m - before.travelled_m
    half = 0.5 * p.track_width_m * wrap(after.heading_rad - before.heading_rad)
    left, unread_left, noise = _encoder(p, distance - half, before.unread_left_m, noise)
    right, unread_right, noise = _encoder(p, distance + half, before.unread_right_m, noise)
    since, compass = before.since_compass_m + abs(0.5 * (left + right)), math.nan
    if p.compass_sd_rad >= 0.0 and since >= p.compass_interval_m:
        since -= p.compass_interval_m
        error, noise = normal(noise)
        compass = wrap(after.heading_rad + p.compass_sd_rad * error)
    a = after
    vehicle = TownVehicle(
        a.x_m,
        a.y_m,
        a.heading_rad,
        a.speed_mps,
        a.accel_mps2,
        a.offset_integral,
        a.speed_integral,
        a.travelled_m,
        unread_left,
        unread_right,
        since,
    )
    return vehicle, Reading(left, right, compass), noise


def _encoder(
    p: Parameters, path_m: float, unread_m: float, noise: RandomStream
) -> tuple[float, float, RandomStream]:
    """Measured path of a wheel, and the remaining fraction of a count."""
    error, noise = normal(noise)
    unread = unread_m + path_m + p.slip_per_sqrt_m * math.sqrt(abs(path_m)) * error
    read = math.floor(unread / p.encoder_step_m + 0.5) * p.encoder_step_m
    return read, unread - read, noise
