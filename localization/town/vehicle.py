"""The simulated vehicle: lane keeping, motion, wheel encoders and compass.

The true motion is a bicycle model (eq. 5 and 6) that PID controllers keep in its lane.
"""

import math
from typing import Final, NamedTuple

from crosscue.localization.angles import wrap
from crosscue.localization.pose_filter import arc
from crosscue.replay.columns import Floats

from .random_stream import RandomStream, normal
from .settings import Parameters
from .streets import COSINES, HEADINGS_RAD, SINES, Streets, node_position, step_of

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


UNDECIDED: Final = -1
# Turns at an intersection, in quarter turns to the left.
STRAIGHT, LEFT, BACK, RIGHT = range(4)
MAX_ARCS: Final = 3
# Number of values of an arc: x, y and heading of its start, curvature, length.
ARC_FIELDS: Final = 5


class Route(NamedTuple):
    """Position of the vehicle on its path.

    Attributes:
        way: Direction of the current street, or of the one after the current turn.
        node: Intersection ahead.
        turn: Decision for that intersection, or ``UNDECIDED``.
        arc: Index of the current arc of a turn; ``arcs`` on a street.
        arcs: Number of arcs of the turn.
        along_m: Distance travelled on the current arc.
    """

    way: int
    node: int
    turn: int
    arc: int
    arcs: int
    along_m: float


def remaining_m(streets: Streets, route: Route, vehicle: TownVehicle) -> float:
    """Distance to the centre of the next intersection, along the lane."""
    x, y = node_position(streets, route.node)
    return COSINES[route.way] * (x - vehicle.x_m) + SINES[route.way] * (y - vehicle.y_m)


def entry_m(p: Parameters, turn: int) -> float:
    """Distance of a turn's start before the centre of the intersection."""
    if turn == LEFT:
        return p.left_radius_m - p.lane_offset_m
    return p.right_radius_m + p.lane_offset_m if turn == RIGHT else 0.0


def wanted_mps(p: Parameters, streets: Streets, route: Route, vehicle: TownVehicle) -> float:
    """Target speed at this position of the path."""
    if route.arc < route.arcs:
        return p.turn_mps
    if route.turn in (UNDECIDED, STRAIGHT):
        return p.cruise_mps
    room_m = max(remaining_m(streets, route, vehicle) - entry_m(p, route.turn), 0.0)
    return min(p.cruise_mps, math.sqrt(p.turn_mps**2 + 2.0 * p.accel_mps2 * room_m))


def lane_of(
    p: Parameters, streets: Streets, route: Route, arcs: Floats, vehicle: TownVehicle
) -> Lane:
    """Position of the vehicle relative to its lane."""
    c, s = math.cos(vehicle.heading_rad), math.sin(vehicle.heading_rad)
    if route.arc < route.arcs:
        arc_ahead = arcs[route.arc]
        x, y, heading, curvature = arc_ahead[0], arc_ahead[1], arc_ahead[2], arc_ahead[3]
        radius = 1.0 / curvature
        out_x = vehicle.x_m - (x - radius * math.sin(heading))
        out_y = vehicle.y_m - (y + radius * math.cos(heading))
        apart = math.sqrt(out_x * out_x + out_y * out_y)
        side = math.copysign(1.0, radius)
        growth = side * (-out_y * s - out_x * c) / apart
        return Lane(side * (abs(radius) - apart), growth, curvature)
    street_c, street_s = COSINES[route.way], SINES[route.way]
    x, y = node_position(streets, route.node)
    across = street_c * (vehicle.y_m - y) - street_s * (vehicle.x_m - x)
    return Lane(across + p.lane_offset_m, street_c * s - street_s * c, 0.0)


def advance_turn(route: Route, lane: Lane, distance_m: float) -> Route:
    """Advance along the arc of a turn, if the vehicle is on one."""
    if route.arc == route.arcs:
        return route
    along_m = route.along_m + distance_m / (1.0 - lane.offset_m * lane.curvature)
    return Route(route.way, route.node, route.turn, route.arc, route.arcs, along_m)


def next_arc(route: Route, arcs: Floats) -> Route:
    """Change to the next arc or the street at the end of an arc."""
    length_m = arcs[route.arc, 4]
    if route.along_m < length_m:
        return route
    is_last = route.arc + 1 == route.arcs
    along_m = 0.0 if is_last else route.along_m - length_m
    return Route(route.way, route.node, route.turn, route.arc + 1, route.arcs, along_m)


def enter(p: Parameters, streets: Streets, route: Route, arcs: Floats) -> Route:
    """Write the arcs of the decided turn to ``arcs``, and set the next intersection."""
    count = _lay_turn(p, streets, route, arcs)
    way = (route.way + route.turn) & 3
    node = route.node + step_of(way, len(streets.xs_m))
    return Route(way, node, UNDECIDED, 0, count, 0.0)


def _lay_turn(p: Parameters, streets: Streets, route: Route, arcs: Floats) -> int:
    if route.turn == STRAIGHT:
        return 0
    c, s, heading = COSINES[route.way], SINES[route.way], HEADINGS_RAD[route.way]
    x, y = node_position(streets, route.node)
    before, offset = entry_m(p, route.turn), p.lane_offset_m
    x, y = x - c * before + s * offset, y - s * before - c * offset
    if route.turn == BACK:
        return _lay_turning_circle(arcs, x, y, heading, p.right_radius_m, offset)
    radius = p.left_radius_m if route.turn == LEFT else -p.right_radius_m
    _lay(arcs, 0, x, y, heading, 1.0 / radius, abs(radius) * math.pi / 2.0)
    return 1


def _lay_turning_circle(
    arcs: Floats, x_m: float, y_m: float, heading_rad: float, radius_m: float, offset_m: float
) -> int:
    """Write the arcs of a U-turn: a swing to the right, a left turn, and back into the lane."""
    swing = math.acos((offset_m + radius_m) / (2.0 * radius_m))
    for i in range(MAX_ARCS):
        side, angle = (1.0, math.pi + 2.0 * swing) if i == 1 else (-1.0, swing)
        _lay(arcs, i, x_m, y_m, heading_rad, side / radius_m, radius_m * angle)
        step = arc(radius_m * angle, side * angle)
        c, s = math.cos(heading_rad), math.sin(heading_rad)
        x_m, y_m = x_m + c * step.dx_m - s * step.dy_m, y_m + s * step.dx_m + c * step.dy_m
        heading_rad += side * angle
    return MAX_ARCS


def _lay(
    arcs: Floats, i: int, x: float, y: float, heading: float, curvature: float, length: float
) -> None:
    arcs[i, 0], arcs[i, 1], arcs[i, 2], arcs[i, 3], arcs[i, 4] = x, y, heading, curvature, length
