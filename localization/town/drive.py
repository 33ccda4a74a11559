"""Simulate a complete drive step by step: town, vehicle, sensors, filter and decisions.

Truth and estimate are separate except in three places: sensors measure the truth, local sensors
show the roads of the next intersection relative to the vehicle, and the result compares the two at
the end. Decisions use the estimate.

All functions are plain Python on numbers and arrays, which run uncompiled in a debugger, too;
``drive_many`` compiles them, which makes them thousands of times as fast.
"""

import math
from dataclasses import dataclass
from enum import IntEnum
from typing import Final, NamedTuple, get_type_hints

import numpy as np
from numpy.typing import NDArray

from crosscue.localization.angles import wrap
from crosscue.localization.navigation import (
    NONE,
    Memory,
    bearing_after,
    choose_option,
    empty_memory,
    landmark_ahead,
    penalty,
    recognise,
    remember,
    seeks_landmarks,
)
from crosscue.localization.pose_filter import (
    HEADING,
    SPEED,
    State,
    major_axis_m,
    pose_nees,
    predict_pose,
    update_position,
    update_state,
)
from crosscue.replay.columns import Floats, Int64s
from crosscue.replay.compiled import kept

from . import settings as settings_of
from .random_stream import RandomStream, below, normal, stream_of, uniform
from .settings import Parameters, parameters_of
from .streets import (
    COSINES,
    HEADINGS_RAD,
    SINES,
    Streets,
    draw_goal,
    draw_landmarks,
    draw_place,
    has_intersection,
    has_way,
    make_streets,
    node_position,
    step_of,
)
from .vehicle import (
    ARC_FIELDS,
    BACK,
    MAX_ARCS,
    STRAIGHT,
    UNDECIDED,
    Reading,
    Route,
    TownVehicle,
    advance_turn,
    enter,
    entry_m,
    lane_of,
    measure_step,
    move,
    next_arc,
    remaining_m,
    wanted_mps,
)

Keys = NDArray[np.uint64]

CITY_STREAM: Final = np.uint64(1)
PLACE_STREAM: Final = np.uint64(2)
SENSOR_STREAM: Final = np.uint64(3)
# Outcome of a city without intersections.
NO_CITY: Final = -1.0
STEP_FIELDS: Final = 16
EVENT_FIELDS: Final = 6
# Kinds of events: a new goal, and a landmark that is new, missed, used or rejected.
GOAL_SET, LANDMARK_SET, LANDMARK_MISSED, LANDMARK_TAKEN, LANDMARK_REFUSED = range(5)
# Straight, left, right: the order in which options are listed.
_QUARTERS: Final = (0, 1, 3)


class DriveOutcome(IntEnum):
    """Outcome of a drive."""

    REACHED = 0
    LOST = 1
    GIVEN_UP = 2


REACHED, LOST, GIVEN_UP = (int(outcome) for outcome in DriveOutcome)


class DriveResult(NamedTuple):
    """Result of a drive; all lengths in metres.

    Attributes:
        outcome: Value of ``DriveOutcome``.
        travelled_m: True distance travelled.
        seconds: Duration of the drive.
        steps: Number of filter steps.
        straight_m: Straight-line distance from the start to the first goal.
        manhattan_m: Manhattan distance from the start to the first goal.
        area_km2: Area of the city.
        landmarks: Number of landmarks in the city at the start.
        passed: Number of landmarks passed.
        detected: Number of passed landmarks that were used.
        refused: Number of passed landmarks that the gate rejected.
        decisions: Number of decisions at intersections.
        turns: Number of decisions other than straight.
        goals: Number of goals reached.
        first_goal_m: Distance travelled to the first goal; NaN if it was not reached.
        first_goal_axis_m: Major axis at the first goal.
        major_axis_m: Major axis at the end.
        error_m: Position error at the end.
        nees: NEES of x, y and heading at the end.
        goal_error_m: True distance from the last reached goal on arrival; NaN without one.
        furthest_m: Largest distance of a reached goal from the start; 0 without one.
        longest_gap_m: Longest distance between used landmarks, including start and end.
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


FIELDS: Final = len(DriveResult._fields)
# Columns of a row, in the order of ``DriveResult``.
OUTCOME, TRAVELLED, SECONDS, STEPS, STRAIGHT_LINE, MANHATTAN, AREA, LANDMARKS = range(8)
PASSED, DETECTED, REFUSED, DECISIONS, TURNS, GOALS, FIRST_GOAL, FIRST_AXIS = range(8, 16)
AXIS, ERROR, NEES, GOAL_ERROR, FURTHEST, LONGEST_GAP = range(16, FIELDS)


class LandmarkArray(NamedTuple):
    """L landmarks.

    Attributes:
        nodes: Shape (L,): intersections of the landmarks.
        places_m: Shape (L, 2): positions.
        is_visited: Shape (L,).
    """

    nodes: Int64s
    places_m: Floats
    is_visited: NDArray[np.bool_]


class Targets(NamedTuple):
    """The current goal and landmarks, and the random stream for later ones."""

    goal: int
    landmarks: LandmarkArray
    places: RandomStream


class DriveRecord(NamedTuple):
    """Record of a drive's steps and events; arrays without rows record nothing.

    Attributes:
        steps: Shape (S, 16): true x, y, heading, speed; measured paths of the left and right wheel;
            compass, NaN without a reading; then the filter's x, y, heading and their covariance
            xx, xy, xh, yy, yh, hh.
        events: Shape (E, 6): step, kind, x, y of goal or landmark, x, y measured by a landmark.
        noted: Shape (1,): number of events so far.
    """

    steps: Floats
    events: Floats
    noted: Int64s


def drive_one(p: Parameters, seed: np.uint64, row: Floats, log: DriveRecord) -> None:
    """Simulate one drive.

    Args:
        p: Settings.
        seed: Seed of all random numbers.
        row: Output, shape (22,): the fields of ``DriveResult``. With three more columns, x, y,
            heading of the filter before the first step follow.
        log: Output: steps and events, up to its capacity.
    """
    row[:] = np.nan
    row[PASSED : GOALS + 1] = row[FURTHEST] = row[LONGEST_GAP] = 0.0
    streets = make_streets(stream_of(seed, CITY_STREAM), p)
    if not has_intersection(streets):
        row[OUTCOME] = NO_CITY
        return
    start, way, targets = _start(p, streets, stream_of(seed, PLACE_STREAM))
    start_x, start_y = node_position(streets, start)
    goal_x, goal_y = node_position(streets, targets.goal)
    _describe_start(row, streets, targets, goal_x - start_x, goal_y - start_y)
    _note_targets(log, 0, streets, targets, True)
    x, y = start_x + p.lane_offset_m * SINES[way], start_y - p.lane_offset_m * COSINES[way]
    vehicle = TownVehicle(x, y, HEADINGS_RAD[way], p.turn_mps, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    belief, noise = _first_belief(p, vehicle, stream_of(seed, SENSOR_STREAM))
    if len(row) > FIELDS:
        row[FIELDS], row[FIELDS + 1] = belief.x_m, belief.y_m
        row[FIELDS + 2] = belief.heading_rad
    route = Route(way, start + step_of(way, len(streets.xs_m)), UNDECIDED, 0, 0, 0.0)
    arcs, memory = np.empty((MAX_ARCS, ARC_FIELDS)), empty_memory()
    last_fix_m, steps = 0.0, 0
    while True:
        lane = lane_of(p, streets, route, arcs, vehicle)
        moved = move(p, vehicle, lane, wanted_mps(p, streets, route, vehicle))
        distance_m = moved.travelled_m - vehicle.travelled_m
        vehicle, reading, noise = measure_step(p, vehicle, moved, noise)
        route = advance_turn(route, lane, distance_m)
        belief = estimate(p, belief, reading)
        if steps < len(log.steps):
            _keep(log.steps[steps], vehicle, reading, belief)
        steps += 1
        axis_m = major_axis_m(belief.xx, belief.xy, belief.yy)
        if axis_m > p.lost_above_m:
            break
        if _is_at_goal(p, streets, targets, belief, axis_m):
            _arrived(row, streets, targets, vehicle, start, axis_m)
            if row[GOALS] == p.goals:
                break
            targets = _next_targets(p, streets, targets, route.node)
            _note_targets(log, steps, streets, targets, p.landmark_per_goal)
        if vehicle.travelled_m > p.max_travelled_m or steps * p.step_s > p.max_s:
            break
        if route.arc < route.arcs:
            route = next_arc(route, arcs)
            continue
        room_m = remaining_m(streets, route, vehicle)
        if route.turn == UNDECIDED and room_m <= p.decide_at_m:
            turn, memory = _decide(p, streets, route, targets, memory, belief, room_m, axis_m)
            route = Route(route.way, route.node, turn, route.arc, route.arcs, 0.0)
            row[DECISIONS] += 1
            row[TURNS] += int(turn != STRAIGHT)
        if route.turn != UNDECIDED and room_m <= entry_m(p, route.turn):
            landmark = _landmark_at(targets.landmarks, route.node)
            if landmark != NONE:
                fix, noise = _landmark_fix(p, targets.landmarks, landmark, vehicle, belief, noise)
                belief = fix.state
                _note(log, steps, fix.kind, streets, route.node, fix.x_m, fix.y_m)
                row[PASSED] += 1
                row[REFUSED] += int(fix.kind == LANDMARK_REFUSED)
                if fix.kind == LANDMARK_TAKEN:
                    row[DETECTED] += 1
                    gap_m = vehicle.travelled_m - last_fix_m
                    row[LONGEST_GAP] = max(row[LONGEST_GAP], gap_m)
                    last_fix_m = vehicle.travelled_m
            route = enter(p, streets, route, arcs)
    _finish(p, row, vehicle, belief, last_fix_m, steps)


def drive_each(p: Parameters, seeds: Keys, rows: Floats, log: DriveRecord) -> None:
    """Run ``drive_one`` for each of N seeds; rows have shape (N, 22)."""
    for i in range(len(seeds)):
        drive_one(p, seeds[i], rows[i], log)


def estimate(p: Parameters, belief: State, reading: Reading) -> State:
    """Predict with one step's odometry, and update with the compass if it was read."""
    distance_m = 0.5 * (reading.left_m + reading.right_m)
    turn_rad = (reading.right_m - reading.left_m) / p.track_width_m
    slip_var = p.slip_per_sqrt_m**2 * abs(distance_m)
    belief = predict_pose(
        belief,
        distance_m,
        turn_rad,
        slip_var / 2.0,
        2.0 * slip_var / p.track_width_m**2,
        p.accel_var_m2ps3 * p.step_s,
    )
    speed_error = distance_m / p.step_s - belief.speed_mps
    belief = update_state(belief, SPEED, speed_error, p.speed_sd_mps**2)
    if math.isnan(reading.compass_rad):
        return belief
    heading_error = wrap(reading.compass_rad - belief.heading_rad)
    return update_state(belief, HEADING, heading_error, p.compass_sd_rad**2)


def _start(p: Parameters, streets: Streets, places: RandomStream) -> tuple[int, int, Targets]:
    """Draw start, direction and targets of the drive."""
    start, places = draw_place(places, streets.inside)
    way, places = below(places, 4)
    while not has_way(streets.ways, start, way):
        way = (way + 1) & 3
    goal, places = draw_goal(places, streets, start, p.min_goal_m)
    if p.landmark_per_goal:
        nodes, places = _one_landmark(p, streets, places)
    else:
        nodes, places = draw_landmarks(places, streets, p.landmarks_per_km2)
    return start, way, Targets(goal, _landmarks(streets, nodes), places)


def _one_landmark(
    p: Parameters, streets: Streets, places: RandomStream
) -> tuple[Int64s, RandomStream]:
    """Draw at most one landmark, with the requested density on average."""
    number, places = uniform(places)
    nodes = np.empty(1 if number < p.landmarks_per_km2 * streets.area_km2 else 0, np.int64)
    if len(nodes):
        nodes[0], places = draw_place(places, streets.inside)
    return nodes, places


def _landmarks(streets: Streets, nodes: Int64s) -> LandmarkArray:
    places_m = np.empty((len(nodes), 2))
    for i in range(len(nodes)):
        places_m[i, 0], places_m[i, 1] = node_position(streets, nodes[i])
    return LandmarkArray(nodes, places_m, np.zeros(len(nodes), np.bool_))


def _landmark_at(landmarks: LandmarkArray, node: int) -> int:
    for i in range(len(landmarks.nodes)):
        if landmarks.nodes[i] == node:
            return i
    return NONE


def _next_targets(p: Parameters, streets: Streets, targets: Targets, near: int) -> Targets:
    goal, places = draw_goal(targets.places, streets, near, p.min_goal_m)
    if not p.landmark_per_goal:
        return Targets(goal, targets.landmarks, places)
    nodes, places = _one_landmark(p, streets, places)
    return Targets(goal, _landmarks(streets, nodes), places)


def _first_belief(
    p: Parameters, vehicle: TownVehicle, noise: RandomStream
) -> tuple[State, RandomStream]:
    x_error, noise = normal(noise)
    y_error, noise = normal(noise)
    heading_error, noise = normal(noise)
    position_var, heading_var = p.start_position_sd_m**2, p.start_heading_sd_rad**2
    belief = State(
        vehicle.x_m + p.start_position_sd_m * x_error,
        vehicle.y_m + p.start_position_sd_m * y_error,
        wrap(vehicle.heading_rad + p.start_heading_sd_rad * heading_error),
        vehicle.speed_mps,
        position_var,
        0.0,
        0.0,
        0.0,
        position_var,
        0.0,
        0.0,
        heading_var,
        0.0,
        p.speed_sd_mps**2,
    )
    return belief, noise


def _is_at_goal(
    p: Parameters, streets: Streets, targets: Targets, belief: State, axis_m: float
) -> bool:
    """Whether the estimated position is at the goal."""
    x, y = node_position(streets, targets.goal)
    away_m = math.hypot(belief.x_m - x, belief.y_m - y)
    return away_m <= max(p.arrive_within_m, axis_m / 2.0)


def _arrived(
    row: Floats, streets: Streets, targets: Targets, vehicle: TownVehicle, start: int, axis_m: float
) -> None:
    x, y = node_position(streets, targets.goal)
    start_x, start_y = node_position(streets, start)
    if row[GOALS] == 0:
        row[FIRST_GOAL], row[FIRST_AXIS] = vehicle.travelled_m, axis_m
    row[GOALS] += 1
    row[GOAL_ERROR] = math.hypot(vehicle.x_m - x, vehicle.y_m - y)
    row[FURTHEST] = max(row[FURTHEST], math.hypot(x - start_x, y - start_y))


def _decide(
    p: Parameters,
    streets: Streets,
    route: Route,
    targets: Targets,
    memory: Memory,
    belief: State,
    room_m: float,
    axis_m: float,
) -> tuple[int, Memory]:
    """Decide on the turn at the intersection ahead (eq. 4), from the estimated position."""
    heading = belief.heading_rad
    at_x = belief.x_m + room_m * math.cos(heading)
    at_y = belief.y_m + room_m * math.sin(heading)
    target_x, target_y = _target(p, streets, targets, at_x, at_y, axis_m)
    turns = np.empty(len(_QUARTERS), np.int64)
    count = 0
    for turn in _QUARTERS:
        if has_way(streets.ways, route.node, (route.way + turn) & 3):
            turns[count] = turn
            count += 1
    if count == 0:
        turns[0], count = BACK, 1
    headings, bearings, penalties = np.empty(count), np.empty(count), np.empty(count)
    place = recognise(memory, at_x, at_y, p.recognise_within_m)
    for i in range(count):
        after = wrap(heading + HEADINGS_RAD[turns[i]])
        headings[i] = after
        bearings[i] = bearing_after(at_x, at_y, after, target_x, target_y, p.after_m)
        penalties[i] = penalty(memory, place, after, p.same_option_rad, p.penalty_rad)
    chosen = choose_option(headings, bearings, penalties)
    memory = remember(memory, place, at_x, at_y, headings[chosen], p.same_option_rad)
    return turns[chosen], memory


def _target(
    p: Parameters, streets: Streets, targets: Targets, x_m: float, y_m: float, axis_m: float
) -> tuple[float, float]:
    """Position of the goal, or of a landmark on the way to it."""
    goal_x, goal_y = node_position(streets, targets.goal)
    if not seeks_landmarks(p.strategy, axis_m, p.hybrid_above_m):
        return goal_x, goal_y
    marks = targets.landmarks
    while True:
        found = landmark_ahead(x_m, y_m, goal_x, goal_y, marks.places_m, marks.is_visited)
        if found == NONE:
            return goal_x, goal_y
        x, y = marks.places_m[found, 0], marks.places_m[found, 1]
        if math.hypot(x - x_m, y - y_m) > max(p.arrive_within_m, axis_m / 2.0):
            return x, y
        marks.is_visited[found] = True


class LandmarkFix(NamedTuple):
    """Belief after passing a landmark, kind of the event, and the measured position, or NaN."""

    state: State
    kind: int
    x_m: float
    y_m: float


def _landmark_fix(
    p: Parameters,
    landmarks: LandmarkArray,
    landmark: int,
    vehicle: TownVehicle,
    belief: State,
    noise: RandomStream,
) -> tuple[LandmarkFix, RandomStream]:
    """Draw whether a landmark is recognised; if so, it measures the vehicle's position."""
    number, noise = uniform(noise)
    if number >= p.detection_rate:
        return LandmarkFix(belief, LANDMARK_MISSED, math.nan, math.nan), noise
    x_error, noise = normal(noise)
    y_error, noise = normal(noise)
    x, y = vehicle.x_m + p.landmark_sd_m * x_error, vehicle.y_m + p.landmark_sd_m * y_error
    var = p.landmark_sd_m**2
    landmarks.is_visited[landmark] = True
    updated = update_position(belief, x, y, var, 0.0, var, p.landmark_gate_nis)
    kind = LANDMARK_TAKEN if updated.is_accepted else LANDMARK_REFUSED
    return LandmarkFix(updated.state, kind, x, y), noise


def _describe_start(
    row: Floats, streets: Streets, targets: Targets, goal_dx: float, goal_dy: float
) -> None:
    row[STRAIGHT_LINE] = math.hypot(goal_dx, goal_dy)
    row[MANHATTAN] = abs(goal_dx) + abs(goal_dy)
    row[AREA], row[LANDMARKS] = streets.area_km2, len(targets.landmarks.nodes)


def _finish(
    p: Parameters, row: Floats, vehicle: TownVehicle, belief: State, last_fix_m: float, steps: int
) -> None:
    """Write the rest of the drive's ``DriveResult``."""
    axis_m = major_axis_m(belief.xx, belief.xy, belief.yy)
    outcome = REACHED if row[GOALS] == p.goals else GIVEN_UP
    ex, ey = belief.x_m - vehicle.x_m, belief.y_m - vehicle.y_m
    eh = wrap(belief.heading_rad - vehicle.heading_rad)
    row[OUTCOME] = LOST if axis_m > p.lost_above_m else outcome
    row[TRAVELLED], row[SECONDS], row[STEPS] = vehicle.travelled_m, steps * p.step_s, steps
    row[AXIS], row[ERROR], row[NEES] = axis_m, math.hypot(ex, ey), pose_nees(ex, ey, eh, belief)
    row[LONGEST_GAP] = max(row[LONGEST_GAP], vehicle.travelled_m - last_fix_m)


def _keep(kept: Floats, vehicle: TownVehicle, reading: Reading, belief: State) -> None:
    b = belief
    kept[0], kept[1], kept[2] = vehicle.x_m, vehicle.y_m, vehicle.heading_rad
    kept[3] = vehicle.speed_mps
    kept[4], kept[5], kept[6] = reading.left_m, reading.right_m, reading.compass_rad
    kept[7], kept[8], kept[9] = b.x_m, b.y_m, b.heading_rad
    kept[10], kept[11], kept[12], kept[13], kept[14], kept[15] = b.xx, b.xy, b.xh, b.yy, b.yh, b.hh


def _note_targets(
    log: DriveRecord, steps: int, streets: Streets, targets: Targets, with_landmarks: bool
) -> None:
    _note(log, steps, GOAL_SET, streets, targets.goal, math.nan, math.nan)
    if with_landmarks:
        for node in targets.landmarks.nodes:
            _note(log, steps, LANDMARK_SET, streets, node, math.nan, math.nan)


def _note(
    log: DriveRecord, steps: int, kind: int, streets: Streets, node: int, x_m: float, y_m: float
) -> None:
    """Record an event, up to the log's capacity."""
    if log.noted[0] == len(log.events):
        return
    row = log.events[log.noted[0]]
    row[0], row[1], row[4], row[5] = steps, kind, x_m, y_m
    row[2], row[3] = node_position(streets, node)
    log.noted[0] += 1


def no_log() -> DriveRecord:
    """Return a log that records nothing."""
    return DriveRecord(
        np.empty((0, STEP_FIELDS)), np.empty((0, EVENT_FIELDS)), np.zeros(1, np.int64)
    )


def drive_many(settings: settings_of.TownDrive, seeds: Keys) -> Floats:
    """Simulate one drive per seed; the interpreter's lock is released meanwhile.

    Args:
        settings: City, vehicle, sensors, navigation.
        seeds: Shape (N,), uint64.

    Returns:
        Shape (N, 22): the fields of ``DriveResult``.

    Raises:
        ValueError: The settings yield a city without intersections.
    """
    rows = np.empty((len(seeds), FIELDS))
    kept(drive_each)(parameters_of(settings), seeds, rows, no_log())
    if failed := np.flatnonzero(rows[:, 0] == NO_CITY).tolist():
        raise ValueError(
            f"city of seed {seeds[failed[0]]}: no intersection; expected at least one where three "
            "roads meet; use a larger area or shorter blocks"
        )
    return rows


def streets_of(settings: settings_of.TownDrive, seed: int) -> Streets:
    """Return the streets of the drive with this seed."""
    make = kept(make_streets)
    with np.errstate(over="ignore"):
        stream = stream_of(np.uint64(seed), CITY_STREAM)
    return make(stream, parameters_of(settings))


@dataclass(frozen=True, slots=True, eq=False)
class Traced:
    """A simulated drive with all its steps.

    Attributes:
        result: Result of the drive.
        steps: Shape (S, 16), as in ``DriveRecord``.
        events: Shape (E, 6), as in ``DriveRecord``.
        first_belief: x, y, heading of the filter before the first step.
    """

    result: DriveResult
    steps: Floats
    events: Floats
    first_belief: tuple[float, float, float]

    def of_kind(self, *kinds: int) -> Floats:
        """Select the events of these kinds, shape (K, 6)."""
        chosen: Floats = self.events[np.isin(self.events[:, 1], kinds)]
        return chosen

    def goal_to_goal_m(self) -> float:
        """Length of the polyline from the start through all reached goals."""
        begin = np.array(self.first_belief[:2])
        ways = np.diff(np.vstack([begin, self.of_kind(GOAL_SET)[: self.result.goals, 2:4]]), axis=0)
        return float(np.hypot(ways[:, 0], ways[:, 1]).sum())


def drive_traced(settings: settings_of.TownDrive, seed: int) -> Traced:
    """Simulate one drive and record every step.

    Raises:
        ValueError: As ``drive_many``.
    """
    seeds = np.array([seed], np.uint64)
    result = as_result(drive_many(settings, seeds)[0])
    room = 2 * (result.goals + 1) + result.landmarks + result.passed
    log = DriveRecord(
        np.empty((result.steps, STEP_FIELDS)),
        np.full((room, EVENT_FIELDS), np.nan),
        np.zeros(1, np.int64),
    )
    rows = np.empty((1, FIELDS + 3))
    kept(drive_each)(parameters_of(settings), seeds, rows, log)
    x, y, heading = rows[0, FIELDS:].tolist()
    return Traced(result, log.steps, log.events[: log.noted[0]], (x, y, heading))


def as_result(row: Floats) -> DriveResult:
    """Convert a row to a ``DriveResult`` with integer counts."""
    kinds = get_type_hints(DriveResult)
    pairs = zip(DriveResult._fields, row.tolist(), strict=True)
    return DriveResult(**{name: kinds[name](value) for name, value in pairs})
