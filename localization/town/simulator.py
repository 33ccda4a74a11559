"""One simulated drive through a random city, written to be read.

Truth is a bicycle model (eq. 5 and 6) that PID controllers keep in its lane. The estimate is the
EKF of ``ekf`` on odometry, compass and landmarks. The two meet in three places only: sensors
measure the truth, local sensors show the roads of the next intersection as seen from the car, and
the result compares the two at the end. Decisions see the estimate.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Final, NamedTuple

import numpy as np

from crosscue.localization import ekf
from crosscue.localization.angles import wrap
from crosscue.localization.ekf import HEADING, PoseBelief, X, Y
from crosscue.localization.navigation import (
    Memory,
    Option,
    Strategy,
    bearing_after,
    choose,
    landmark_ahead,
    seeks_landmarks,
)
from crosscue.replay.columns import Floats

from . import settings as drive_settings
from .city import HEADINGS_RAD, Made, draw_goal, draw_landmarks, draw_place, make_city
from .random_stream import Stream, key_of

CITY_STREAM: Final = 1
PLACE_STREAM: Final = 2
SENSOR_STREAM: Final = 3

STEERING_LIMIT_RAD: Final = 0.7
BRAKE_SHARE: Final = 1.5
SLOWEST_MPS: Final = 1.0
WINDUP: Final = 2.0
"""Bound of both controllers' integrals."""
TURNS: Final = (0, 1, 3, 2)
"""Quarter turns to the left, in the order in which options are listed."""


class Outcome(IntEnum):
    """How a drive ended."""

    REACHED = 0
    LOST = 1
    GIVEN_UP = 2


class Result(NamedTuple):
    """What is kept of a drive; all lengths in metres.

    Attributes:
        outcome: As ``Outcome``.
        travelled_m: Driven in truth.
        seconds: Of driving.
        steps: Of the filter.
        straight_m: From start to the first goal as the crow flies.
        manhattan_m: The same along x and along y.
        area_km2: Of the city.
        landmarks: In the city at the start.
        passed: Landmarks driven past.
        detected: Of these, those weighed in.
        refused: Of these, those refused by the gate.
        decisions: At intersections.
        turns: Decisions that were not straight on.
        goals: Reached.
        first_goal_m: Travelled when the first goal was reached; NaN if it never was.
        first_goal_axis_m: Major axis then.
        major_axis_m: At the end.
        error_m: Estimate from truth at the end.
        nees: Of x, y, heading at the end.
        goal_error_m: True distance from the last goal reached, when it was; NaN if none was.
        furthest_m: Largest distance from the start of any goal reached; 0 without.
        longest_gap_m: Longest way between landmarks weighed in, start and end included.
    """

    outcome: int
    travelled_m: float
    seconds: float
    steps: int
    straight_m: float
    manhattan_m: float
    area_km2: float
    landmarks: int
    passed: int
    detected: int
    refused: int
    decisions: int
    turns: int
    goals: int
    first_goal_m: float
    first_goal_axis_m: float
    major_axis_m: float
    error_m: float
    nees: float
    goal_error_m: float
    furthest_m: float
    longest_gap_m: float


@dataclass(slots=True)
class Trace:
    """Everything that a picture or a log of one drive needs; simulated throughout.

    Attributes:
        true_poses: Rows of x, y, heading, speed.
        beliefs: The filter's, after each step.
        wheels_m: Rows of the left and right wheel's path in each step, as read.
        compass: Rows of step and heading read.
        landmarks_m: All landmarks there ever were.
        detected_m: Those weighed in, with the step.
        goals_m: All goals.
        streets: The city.
    """

    true_poses: list[tuple[float, float, float, float]] = field(default_factory=list)
    beliefs: list[PoseBelief] = field(default_factory=list)
    wheels_m: list[tuple[float, float]] = field(default_factory=list)
    compass: list[tuple[int, float]] = field(default_factory=list)
    landmarks_m: list[tuple[float, float]] = field(default_factory=list)
    detected_m: list[tuple[int, float, float]] = field(default_factory=list)
    goals_m: list[tuple[float, float]] = field(default_factory=list)
    streets: Made | None = None


class _Arc(NamedTuple):
    """Part of a turn: a circle's piece, entered at a point in a direction."""

    x_m: float
    y_m: float
    heading_rad: float
    curvature: float
    length_m: float


class _Lane(NamedTuple):
    """How the car lies to its lane: beside it (left positive), its growth per metre, curvature."""

    beside_m: float
    growth: float
    curvature: float


def drive(settings: drive_settings.Drive, seed: int, trace: Trace | None = None) -> Result:
    """Drive once.

    Args:
        settings: City, car, sensors, navigation.
        seed: Everything random comes from it.
        trace: Filled, if given.
    """
    return _Drive(settings, seed, Trace() if trace is None else trace).run()


class _Drive:
    """One drive under way."""

    def __init__(self, settings: drive_settings.Drive, seed: int, trace: Trace) -> None:
        self.settings, self.trace = settings, trace
        self.made = make_city(Stream(key_of(seed, CITY_STREAM)), settings.city)
        self.places = Stream(key_of(seed, PLACE_STREAM))
        self.noise = Stream(key_of(seed, SENSOR_STREAM))
        trace.streets = self.made
        city, nav = self.made.city, settings.navigation
        start = draw_place(self.places, self.made)
        self.start_m = city.place(start)
        first = self.places.below(4)
        self.way = next(w for t in range(4) if city.ways[start, w := (first + t) % 4])
        self.node = city.neighbour(start, self.way)
        self.strategy = Strategy(nav.strategy)
        self.memory = Memory(
            nav.recognise_within_m, math.radians(nav.penalty_deg), math.radians(nav.same_option_deg)
        )
        self.landmarks: list[int] = []
        self.is_visited: list[bool] = []
        self.goal = self._new_goal(start)
        if not settings.landmark_per_goal:
            nodes = draw_landmarks(self.places, self.made, settings.landmarks_per_km2)
            self._set_landmarks(nodes.tolist())
        self.landmark_count = len(self.landmarks)
        x, y = self.start_m
        gx, gy = city.place(self.goal)
        self.straight_m, self.manhattan_m = math.hypot(gx - x, gy - y), abs(gx - x) + abs(gy - y)
        self._place_car()
        self.belief = self._first_belief()
        self.arcs: list[_Arc] = []
        self.along_m = 0.0
        self.turn: int | None = None
        self.beside_sum = self.slow_sum = self.accel_mps2 = 0.0
        self.unread_m = [0.0, 0.0]
        self.since_compass_m = 0.0
        self.travelled_m = 0.0
        self.steps = self.passed = self.detected = self.refused = 0
        self.decisions = self.turns = self.goals = 0
        self.first_goal_m = self.first_goal_axis_m = self.goal_error_m = math.nan
        self.furthest_m = self.longest_gap_m = self.last_fix_m = 0.0

    # -- Map and start -----------------------------------------------------------------------

    def _new_goal(self, near: int) -> int:
        settings = self.settings
        goal = draw_goal(self.places, self.made, near, settings.city.goal_at_least_m)
        self.trace.goals_m.append(self.made.city.place(goal))
        if settings.landmark_per_goal:
            share = settings.landmarks_per_km2 * self.made.city.area_km2
            is_there = self.places.uniform() < share
            self._set_landmarks([draw_place(self.places, self.made)] if is_there else [])
        return goal

    def _set_landmarks(self, nodes: list[int]) -> None:
        self.landmarks = nodes
        self.is_visited = [False] * len(nodes)
        self.landmarks_m = np.array([self.made.city.place(n) for n in nodes]).reshape(-1, 2)
        self.trace.landmarks_m += [(float(x), float(y)) for x, y in self.landmarks_m]

    def _place_car(self) -> None:
        heading = HEADINGS_RAD[self.way]
        offset = self.settings.car.lane_offset_m
        self.x = self.start_m[0] + offset * math.sin(heading)
        self.y = self.start_m[1] - offset * math.cos(heading)
        self.heading, self.speed = heading, self.settings.car.turn_mps

    def _first_belief(self) -> PoseBelief:
        sensors = self.settings.sensors
        position, heading = sensors.start_position_sd_m, math.radians(sensors.start_heading_sd_deg)
        mean = np.array([
            self.x + position * self.noise.normal(),
            self.y + position * self.noise.normal(),
            wrap(self.heading + heading * self.noise.normal()),
            self.speed,
        ])  # fmt: skip
        sd = np.array([position, position, heading, sensors.speed_sd_mps])
        return PoseBelief(0, mean, np.diag(sd**2))

    # -- The loop ----------------------------------------------------------------------------

    def run(self) -> Result:
        while True:
            left_m, right_m = self._move()
            self._estimate(left_m, right_m)
            self._keep(left_m, right_m)
            if ekf.is_lost(self.belief, self.settings.navigation.lost_above_m):
                return self._result(Outcome.LOST)
            if self._has_arrived() and self.goals == self.settings.goals:
                return self._result(Outcome.REACHED)
            if self.travelled_m > self.settings.longest_m or self.seconds > self.settings.longest_s:
                return self._result(Outcome.GIVEN_UP)
            self._follow_path()

    @property
    def seconds(self) -> float:
        return self.steps * self.settings.car.step_s

    def _keep(self, left_m: float, right_m: float) -> None:
        self.trace.true_poses.append((self.x, self.y, self.heading, self.speed))
        self.trace.beliefs.append(self.belief)
        self.trace.wheels_m.append((left_m, right_m))

    # -- Truth -------------------------------------------------------------------------------

    def _move(self) -> tuple[float, float]:
        """Control, drive one step, and read the wheels' paths."""
        car = self.settings.car
        lane = self._lane()
        accel = self._accelerate()
        steering = self._steer(lane)
        distance = self.speed * car.step_s + 0.5 * accel * car.step_s**2
        turned = distance * steering / car.wheelbase_m
        step = ekf.arc(distance, turned)
        c, s = math.cos(self.heading), math.sin(self.heading)
        self.x += c * step.dx_m - s * step.dy_m
        self.y += s * step.dx_m + c * step.dy_m
        self.heading = wrap(self.heading + turned)
        self.speed += accel * car.step_s
        self.travelled_m += distance
        self.beside_sum += lane.beside_m * distance
        self.beside_sum = min(max(self.beside_sum, -WINDUP), WINDUP)
        if self.arcs:
            self.along_m += distance / (1.0 - lane.beside_m * lane.curvature)
        half = 0.5 * car.track_width_m * turned
        return self._wheel(0, distance - half), self._wheel(1, distance + half)

    def _wheel(self, side: int, path_m: float) -> float:
        """A wheel's path as its encoder tells it, with slip."""
        sensors = self.settings.sensors
        path_m += sensors.slip_per_sqrt_m * math.sqrt(abs(path_m)) * self.noise.normal()
        unread = self.unread_m[side] + path_m
        read = math.floor(unread / sensors.encoder_step_m + 0.5) * sensors.encoder_step_m
        self.unread_m[side] = unread - read
        return read

    def _lane(self) -> _Lane:
        if self.arcs:
            return self._arc_lane(self.arcs[0])
        heading = HEADINGS_RAD[self.way]
        c, s = math.cos(heading), math.sin(heading)
        x, y = self.made.city.place(self.node)
        beside = c * (self.y - y) - s * (self.x - x) + self.settings.car.lane_offset_m
        return _Lane(beside, c * math.sin(self.heading) - s * math.cos(self.heading), 0.0)

    def _arc_lane(self, arc: _Arc) -> _Lane:
        radius = 1.0 / arc.curvature
        out_x = self.x - (arc.x_m - radius * math.sin(arc.heading_rad))
        out_y = self.y - (arc.y_m + radius * math.cos(arc.heading_rad))
        apart = math.hypot(out_x, out_y)
        side = math.copysign(1.0, radius)
        tangent_x, tangent_y = -side * out_y / apart, side * out_x / apart
        growth = tangent_x * math.sin(self.heading) - tangent_y * math.cos(self.heading)
        return _Lane(side * (abs(radius) - apart), growth, arc.curvature)

    def _steer(self, lane: _Lane) -> float:
        """PID on the distance beside the lane, with the lane's own curvature fed forward."""
        car = self.settings.car
        angle = car.wheelbase_m * lane.curvature - car.steering_p * lane.beside_m
        angle -= car.steering_i * self.beside_sum + car.steering_d * lane.growth
        return min(max(angle, -STEERING_LIMIT_RAD), STEERING_LIMIT_RAD)

    def _accelerate(self) -> float:
        """PID on the speed."""
        car = self.settings.car
        slow = self._wanted_mps() - self.speed
        self.slow_sum = min(max(self.slow_sum + slow * car.step_s, -WINDUP), WINDUP)
        accel = car.speed_p * slow + car.speed_i * self.slow_sum - car.speed_d * self.accel_mps2
        accel = min(max(accel, -BRAKE_SHARE * car.accel_mps2), car.accel_mps2)
        self.accel_mps2 = max(accel, (SLOWEST_MPS - self.speed) / car.step_s)
        return self.accel_mps2

    def _wanted_mps(self) -> float:
        car = self.settings.car
        if self.arcs:
            return car.turn_mps
        if self.turn is None or self.turn == 0:
            return car.cruise_mps
        room_m = max(self._remaining_m() - self._entry_m(), 0.0)
        return min(car.cruise_mps, math.sqrt(car.turn_mps**2 + 2.0 * car.accel_mps2 * room_m))

    # -- Estimate ----------------------------------------------------------------------------

    def _estimate(self, left_m: float, right_m: float) -> None:
        car, sensors = self.settings.car, self.settings.sensors
        distance, turned = 0.5 * (left_m + right_m), (right_m - left_m) / car.track_width_m
        slip = sensors.slip_per_sqrt_m**2 * abs(distance)
        self.belief = ekf.predict_odometry(
            self.belief, distance, turned, slip / 2.0, 2.0 * slip / car.track_width_m**2,
            car.step_s, sensors.accel_var_m2ps3,
        )  # fmt: skip
        self.belief = ekf.update_speed(
            self.belief, distance / car.step_s, sensors.speed_sd_mps**2
        ).belief
        self.steps += 1
        if sensors.compass_2sigma_deg is None:
            return
        self.since_compass_m += abs(distance)
        if self.since_compass_m >= sensors.compass_interval_m:
            self.since_compass_m -= sensors.compass_interval_m
            sd = math.radians(sensors.compass_2sigma_deg) / 2.0
            read = wrap(self.heading + sd * self.noise.normal())
            self.trace.compass.append((self.steps, read))
            self.belief = ekf.update_heading(self.belief, read, sd * sd).belief

    def _has_arrived(self) -> bool:
        """Does the car believe to be at its goal? Then a new one is drawn."""
        gx, gy = self.made.city.place(self.goal)
        away = math.hypot(self.belief.mean[X] - gx, self.belief.mean[Y] - gy)
        if away > max(self.settings.navigation.arrive_within_m, self._axis_m() / 2.0):
            return False
        self.goals += 1
        self.goal_error_m = math.hypot(self.x - gx, self.y - gy)
        from_start = math.hypot(gx - self.start_m[0], gy - self.start_m[1])
        self.furthest_m = max(self.furthest_m, from_start)
        if self.goals == 1:
            self.first_goal_m, self.first_goal_axis_m = self.travelled_m, self._axis_m()
        if self.goals < self.settings.goals:
            self.goal = self._new_goal(self.node)
        return True

    def _axis_m(self) -> float:
        return ekf.major_axis_m(self.belief)

    # -- Path and decisions ------------------------------------------------------------------

    def _remaining_m(self) -> float:
        """To the centre of the next intersection, along the lane."""
        x, y = self.made.city.place(self.node)
        heading = HEADINGS_RAD[self.way]
        return math.cos(heading) * (x - self.x) + math.sin(heading) * (y - self.y)

    def _entry_m(self) -> float:
        """Where the turn begins, before the centre of the intersection."""
        car = self.settings.car
        if self.turn == 1:
            return car.left_radius_m - car.lane_offset_m
        return car.right_radius_m + car.lane_offset_m if self.turn == 3 else 0.0

    def _follow_path(self) -> None:
        if self.arcs:
            if self.along_m >= self.arcs[0].length_m:
                self.along_m -= self.arcs[0].length_m
                self.arcs.pop(0)
                if not self.arcs:
                    self.along_m = 0.0
            return
        remaining = self._remaining_m()
        if self.turn is None and remaining <= self.settings.car.decide_at_m:
            self._decide(remaining)
        if self.turn is not None and remaining <= self._entry_m():
            self._enter_intersection()

    def _decide(self, remaining_m: float) -> None:
        x, y, heading, _ = self.belief.mean
        at_x, at_y = x + remaining_m * math.cos(heading), y + remaining_m * math.sin(heading)
        target = self._target(at_x, at_y)
        after_m = self.settings.navigation.after_m
        turns = [(way - self.way) % 4 for way in self.made.city.options(self.node, self.way)]
        headings = [wrap(heading + HEADINGS_RAD[turn]) for turn in turns]
        penalties = self.memory.penalties(at_x, at_y, headings)
        options = [
            Option(after, bearing_after(at_x, at_y, after, target, after_m), penalty)
            for after, penalty in zip(headings, penalties, strict=True)
        ]
        chosen = choose(options).option
        self.memory.record(at_x, at_y, headings[chosen])
        self.turn = turns[chosen]
        self.decisions += 1
        self.turns += self.turn != 0

    def _target(self, x_m: float, y_m: float) -> tuple[float, float]:
        """The goal, or the landmark sought on the way to it."""
        goal_m, nav = self.made.city.place(self.goal), self.settings.navigation
        axis_m = self._axis_m()
        if not seeks_landmarks(self.strategy, axis_m, nav.hybrid_above_m):
            return goal_m
        while True:
            found = landmark_ahead((x_m, y_m), goal_m, self.landmarks_m, self.is_visited)
            if found is None:
                return goal_m
            lx, ly = self.landmarks_m[found]
            if math.hypot(lx - x_m, ly - y_m) > max(nav.arrive_within_m, axis_m / 2.0):
                return float(lx), float(ly)
            self.is_visited[found] = True

    def _enter_intersection(self) -> None:
        assert self.turn is not None
        if self.node in self.landmarks:
            self._pass_landmark(self.landmarks.index(self.node))
        self.arcs = self._turn_arcs(self.turn)
        self.along_m = 0.0
        self.way = (self.way + self.turn) % 4
        self.node = self.made.city.neighbour(self.node, self.way)
        self.turn = None

    def _pass_landmark(self, landmark: int) -> None:
        """Perhaps recognise it: then it gives the car's position."""
        sensors = self.settings.sensors
        self.passed += 1
        if self.noise.uniform() >= sensors.detection_rate:
            return
        sd = sensors.landmark_sd_m
        seen = np.array([self.x + sd * self.noise.normal(), self.y + sd * self.noise.normal()])
        updated = ekf.update_position(
            self.belief, seen, np.diag([sd**2, sd**2]), sensors.landmark_gate_nis
        )
        self.belief = updated.belief
        self.is_visited[landmark] = True
        if not updated.is_accepted:
            self.refused += 1
            return
        self.detected += 1
        self.longest_gap_m = max(self.longest_gap_m, self.travelled_m - self.last_fix_m)
        self.last_fix_m = self.travelled_m
        x, y = self.landmarks_m[landmark]
        self.trace.detected_m.append((self.steps, float(x), float(y)))

    def _turn_arcs(self, turn: int) -> list[_Arc]:
        car = self.settings.car
        x, y = self.made.city.place(self.node)
        heading = HEADINGS_RAD[self.way]
        along, offset = -self._entry_m(), car.lane_offset_m
        c, s = math.cos(heading), math.sin(heading)
        x, y = x + c * along + s * offset, y + s * along - c * offset
        if turn == 0:
            return []
        if turn == 2:
            return _turning_circle(x, y, heading, car.right_radius_m, offset)
        radius = car.left_radius_m if turn == 1 else -car.right_radius_m
        return [_Arc(x, y, heading, 1.0 / radius, abs(radius) * math.pi / 2.0)]

    def _result(self, outcome: Outcome) -> Result:
        mean, cov = self.belief.mean, self.belief.cov[:3, :3]
        error = np.array([
            mean[X] - self.x, mean[Y] - self.y, wrap(mean[HEADING] - self.heading),
        ])  # fmt: skip
        return Result(
            int(outcome), self.travelled_m, self.seconds, self.steps, self.straight_m,
            self.manhattan_m, self.made.city.area_km2, self.landmark_count, self.passed,
            self.detected, self.refused, self.decisions, self.turns, self.goals,
            self.first_goal_m, self.first_goal_axis_m, self._axis_m(),
            math.hypot(error[0], error[1]), float(error @ np.linalg.solve(cov, error)),
            self.goal_error_m, self.furthest_m,
            max(self.longest_gap_m, self.travelled_m - self.last_fix_m),
        )  # fmt: skip


def _turning_circle(
    x_m: float, y_m: float, heading_rad: float, radius_m: float, offset_m: float
) -> list[_Arc]:
    """Out of the lane to the right, round to the left, and into the lane back."""
    swing = math.acos((offset_m + radius_m) / (2.0 * radius_m))
    arcs = []
    for curvature, angle in ((-1.0, swing), (1.0, math.pi + 2.0 * swing), (-1.0, swing)):
        arc = _Arc(x_m, y_m, heading_rad, curvature / radius_m, radius_m * angle)
        step = ekf.arc(arc.length_m, curvature * angle)
        c, s = math.cos(heading_rad), math.sin(heading_rad)
        x_m, y_m = x_m + c * step.dx_m - s * step.dy_m, y_m + s * step.dx_m + c * step.dy_m
        heading_rad += curvature * angle
        arcs.append(arc)
    return arcs


def as_rows(results: list[Result]) -> Floats:
    """Shape (N, 22): results as the kernel gives them."""
    return np.array(results, np.float64).reshape(-1, len(Result._fields))
