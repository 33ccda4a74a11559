"""A whole simulated drive compiled: city, decisions, car, controllers, sensors and filter.

``drive_simulator`` is the version to read; this one gives the same results number for number, up
to rounding, thousands of times as fast, and tests hold the two equal. Five things differ in form:

* Sixteen drives go on side by side, one step at a time, as vectors of the processor; what does not
  happen at every step is done for each drive alone. No drive depends on its neighbours.
* The speed in the filter's state is left out: odometry carries the pose, so speed and pose never
  share a covariance, and no result depends on it.
* Sines and cosines of headings are turned along with the car, by the series of ``ekf.arc``, and
  taken afresh at each decision.
* A street's four ways are the bits of one byte.
* What can be reached in a city is found by sweeps over its rows, not by a search with a queue.

Where a rule stands, to read and compiled:

====================================  ====================================  =====================
what                                  to read                               here
====================================  ====================================  =====================
random numbers                        ``random_stream.Stream``              ``_uniform, _normal``
streets, dead ends, one-way streets   ``city.make_city``                    ``_make_city``
start, goal, landmarks                ``city.draw_goal, draw_landmarks``    ``_start, _arrive``
controllers                           ``_Drive._steer, _accelerate``        ``_control``
bicycle model, wheels, compass        ``_Drive._move, _wheel``              ``_move``
filter: odometry, compass             ``ekf`` by ``_Drive._estimate``       ``_filter``
filter: landmarks                     ``_Drive._pass_landmark``             ``_weigh_position``
lost, at the goal, given up           ``_Drive._has_arrived, run``          ``_look, _attend``
decisions and their penalties         ``navigation, _Drive._decide``        ``_decide, _remember``
turns                                 ``_Drive._turn_arcs, _follow_path``   ``_enter, _follow_arcs``
====================================  ====================================  =====================

Everything compiled stands in this one file: the compiler's cache looks at the file of the function
called and not at those of the functions that it calls.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, NamedTuple, TypeAlias, TypeVar, cast, get_type_hints

import numpy as np
from numba import njit
from numpy.typing import NDArray

from crosscue.localization.angles import TWO_PI
from crosscue.localization.navigation import Strategy
from crosscue.replay.columns import Floats

from . import random_stream
from . import settings as settings_of
from .city import HEADINGS_RAD, TRIES, make_city
from .random_stream import Stream, key_of
from .simulator import (
    BRAKE_SHARE,
    CITY_STREAM,
    PLACE_STREAM,
    SENSOR_STREAM,
    SLOWEST_MPS,
    STEERING_LIMIT_RAD,
    WINDUP,
    Outcome,
    Result,
)

Function = TypeVar("Function", bound=Callable[..., object])
Number = TypeVar("Number", np.int64, np.float64)
Bytes = NDArray[np.uint8]
Ints = NDArray[np.int64]
Keys = NDArray[np.uint64]

FIELDS: Final = len(Result._fields)
REACHED, LOST, GIVEN_UP = (int(o) for o in (Outcome.REACHED, Outcome.LOST, Outcome.GIVEN_UP))
TRACED: Final = 16
EVENT: Final = 6
GOAL_SET, LANDMARK_SET, LANDMARK_MISSED, LANDMARK_TAKEN, LANDMARK_REFUSED = range(5)
"""Kinds of events: a new goal, a new landmark, one passed unnoticed, weighed in, refused."""
NO_CITY: Final = -1
"""In place of an outcome: the settings gave a city without intersections."""

# Numba turns uint64 with int64 into float64: every whole number that meets bits is a uint64.
GOLDEN: Final = np.uint64(random_stream.GOLDEN)
MIX_1: Final = np.uint64(random_stream.MIX_1)
MIX_2: Final = np.uint64(random_stream.MIX_2)
FLIP: Final = np.uint64(random_stream.FLIP)
FEW: Final = random_stream.FEW_TRANSITIONS
TO_UNIT: Final = random_stream.TO_UNIT
TAIL_FROM: Final = random_stream.TAIL_FROM
LAYER: Final = np.uint64(random_stream.LAYERS - 1)
EDGE, INNER = random_stream.ziggurat()
ZERO, ONE, U11, U27, U30, U31 = (np.uint64(n) for n in (0, 1, 11, 27, 30, 31))
CITY_KEY, PLACE_KEY, SENSOR_KEY = (
    np.uint64(stream) for stream in (CITY_STREAM, PLACE_STREAM, SENSOR_STREAM)
)

ONWARD, HOMEWARD, EITHER = 1, 2, 4
"""Kinds of reach in a city: from a place along roads, to it, and whichever way roads lead."""
COSINES: Final = tuple(math.cos(heading) for heading in HEADINGS_RAD)
SINES: Final = tuple(math.sin(heading) for heading in HEADINGS_RAD)
QUARTER_TURNS: Final = HEADINGS_RAD
SERIES_RAD: Final = 0.15
"""Below this angle the series of ``_arc`` are exact to rounding."""
A1, A2, A3, A4 = -1 / 6, 1 / 120, -1 / 5040, 1 / 362880
B1, B2, B3, B4 = -1 / 24, 1 / 720, -1 / 40320, 1 / 3628800
C0, C1, C2, C3, C4 = -1 / 3, 1 / 30, -1 / 840, 1 / 45360, -1 / 3991680
D1, D2, D3, D4 = -1 / 8, 1 / 144, -1 / 5760, 1 / 403200
PI: Final = math.pi
LANES: Final = 16
"""Drives side by side: twice as many as the widest vectors hold."""
(
    X, Y, H, C, S, V, ACCEL, BESIDE_SUM, SLOW_SUM, TRAVELLED, STEPS,
    STREET_C, STREET_S, NODE_X, NODE_Y, BRAKES, ENTRY, NOTICE_AT,
    IN_ARC, CENTRE_X, CENTRE_Y, RADIUS, SIDE, CURVATURE, ARC_LENGTH, ARC_M,
    UNREAD_LEFT, UNREAD_RIGHT, SINCE, LEFT, RIGHT, COMPASS,
    BX, BY, BH, BC, BS, XX, XY, XH, YY, YH, HH,
    GOAL_X, GOAL_Y, START_X, START_Y, AREA,
    FIRST_GOAL, FIRST_AXIS, GOAL_ERROR, FURTHEST, LONGEST_GAP, LAST_FIX,
    Z_LEFT, Z_RIGHT, Z_COMPASS, RARE, DISTANCE, TURNED, BEND, SHIFT,
    ALONG, ACROSS, ALONG_BY, ACROSS_BY, NOTABLE,
) = range(0, 67 * LANES, LANES)  # fmt: skip
"""Where the lanes' numbers begin: truth, path, sensors, belief, goals, what a step makes."""
(
    ROW, OUTCOME, WAY, NODE, TURN, ARCS, ARC, GOAL, LANDMARK_COUNT, KNOWN, OPTIONS, NOTED,
    PASSED, DETECTED, REFUSED, DECISIONS, TURNS, GOALS,
) = range(0, 18 * LANES, LANES)  # fmt: skip
NOISE, NOISE_STEP, NOISE_2, NOISE_3, PLACES, PLACES_STEP = range(0, 6 * LANES, LANES)
FLOATS, WHOLES, STATES = 67, 18, 6
ROOM: Final = 64
"""For places and options at first."""
FILTERED: Final = (BX, BY, BH, XX, XY, XH, YY, YH, HH)
TRACED_FROM: Final = (X, Y, H, V, LEFT, RIGHT, COMPASS, *FILTERED)
STRATEGIES: Final = tuple(Strategy)
LANDMARKS: Final = STRATEGIES.index(Strategy.LANDMARKS)
HYBRID: Final = STRATEGIES.index(Strategy.HYBRID)


State: TypeAlias = tuple[
    float, float, float, float, float, float, float, float, float, float, float
]
"""x, y, heading, its cosine and sine; covariance xx, xy, xh, yy, yh, hh."""


class Numbers(NamedTuple):
    """``drive_settings.Drive`` as the compiled code takes it: angles in radians, no None.

    ``compass_sd_rad`` is negative without a compass; ``strategy`` is the place in ``Strategy``.
    """

    smallest_km2: float
    largest_km2: float
    shortest_block_m: float
    longest_block_m: float
    dead_end_share: float
    one_way_share: float
    goal_at_least_m: float
    wheelbase_m: float
    track_width_m: float
    step_s: float
    cruise_mps: float
    turn_mps: float
    accel_mps2: float
    lane_offset_m: float
    left_radius_m: float
    right_radius_m: float
    decide_at_m: float
    steering_p: float
    steering_i: float
    steering_d: float
    speed_p: float
    speed_i: float
    speed_d: float
    compass_sd_rad: float
    compass_interval_m: float
    slip_per_sqrt_m: float
    encoder_step_m: float
    landmark_sd_m: float
    landmark_gate_nis: float
    detection_rate: float
    start_position_sd_m: float
    start_heading_sd_rad: float
    strategy: int
    penalty_rad: float
    recognise_within_m: float
    same_option_rad: float
    after_m: float
    arrive_within_m: float
    hybrid_above_m: float
    lost_above_m: float
    landmarks_per_km2: float
    landmark_per_goal: bool
    goals: int
    longest_m: float
    longest_s: float


def numbers_of(settings: settings_of.Drive) -> Numbers:
    """Settings of a drive in the form that the compiled code takes."""
    city, car, sensors, nav = settings.city, settings.car, settings.sensors, settings.navigation
    compass = sensors.compass_2sigma_deg
    return Numbers(
        city.smallest_km2, city.largest_km2, city.shortest_block_m, city.longest_block_m,
        city.dead_end_share, city.one_way_share, city.goal_at_least_m,
        car.wheelbase_m, car.track_width_m, car.step_s, car.cruise_mps, car.turn_mps,
        car.accel_mps2, car.lane_offset_m, car.left_radius_m, car.right_radius_m, car.decide_at_m,
        car.steering_p, car.steering_i, car.steering_d, car.speed_p, car.speed_i, car.speed_d,
        -1.0 if compass is None else math.radians(compass) / 2.0, sensors.compass_interval_m,
        sensors.slip_per_sqrt_m, sensors.encoder_step_m, sensors.landmark_sd_m,
        sensors.landmark_gate_nis, sensors.detection_rate, sensors.start_position_sd_m,
        math.radians(sensors.start_heading_sd_deg),
        STRATEGIES.index(Strategy(nav.strategy)), math.radians(nav.penalty_deg),
        nav.recognise_within_m, math.radians(nav.same_option_deg), nav.after_m,
        nav.arrive_within_m, nav.hybrid_above_m, nav.lost_above_m,
        settings.landmarks_per_km2, settings.landmark_per_goal, settings.goals,
        settings.longest_m, settings.longest_s,
    )  # fmt: skip


def drive_many(settings: settings_of.Drive, seeds: Keys) -> Floats:
    """Drive once for each seed; other threads run meanwhile.

    Args:
        settings: City, car, sensors, navigation.
        seeds: Shape (N,), uint64.

    Returns:
        Shape (N, 22): the fields of ``Result``, row by row as ``drive_simulator.drive`` gives them.

    Raises:
        ValueError: The settings gave a city that nobody can drive in; said as ``city`` says it.
    """
    rows = np.empty((len(seeds), FIELDS))
    drive_rows(numbers_of(settings), seeds, rows, np.empty((0, TRACED)), np.empty((0, EVENT)))
    failed = np.flatnonzero(rows[:, 0] == NO_CITY)
    if failed.size:
        seed = int(seeds[failed[0]])
        make_city(Stream(key_of(seed, CITY_STREAM)), settings.city)
        raise AssertionError(f"seed {seed}: the compiled city is refused, the readable one is not")
    return rows


@dataclass(frozen=True, slots=True, eq=False)
class Traced:
    """One drive step by step; simulated throughout.

    Attributes:
        result: As ``drive_simulator.drive`` gives it.
        steps: Shape (S, 16), as ``drive_rows`` tells.
        events: Shape (E, 6), likewise.
        first_belief: x, y, heading of the filter before the first step.
    """

    result: Result
    steps: Floats
    events: Floats
    first_belief: tuple[float, float, float]

    def of_kind(self, *kinds: int) -> Floats:
        """Shape (K, 6): events of these kinds."""
        chosen: Floats = self.events[np.isin(self.events[:, 1], kinds)]
        return chosen

    def goal_to_goal_m(self) -> float:
        """From the start to each goal reached, as the crow flies, added up."""
        begin = np.array(self.first_belief[:2])
        ways = np.diff(np.vstack([begin, self.of_kind(GOAL_SET)[: self.result.goals, 2:4]]), axis=0)
        return float(np.hypot(ways[:, 0], ways[:, 1]).sum())


def drive_traced(settings: settings_of.Drive, seed: int) -> Traced:
    """Drive once and keep every step.

    Raises:
        ValueError: As ``drive_many``.
    """
    key = np.uint64(seed)
    first = as_result(drive_many(settings, np.array([key], np.uint64))[0])
    most = 2 * (first.goals + 1) + first.landmarks + first.passed
    steps, events = np.empty((first.steps, TRACED)), np.full((most, EVENT), np.nan)
    rows = np.empty((1, FIELDS + 3))
    drive_rows(numbers_of(settings), np.array([key], np.uint64), rows, steps, events)
    begin = rows[0, FIELDS:]
    return Traced(
        first, steps, events[~np.isnan(events[:, 0])],
        (float(begin[0]), float(begin[1]), float(begin[2])),
    )  # fmt: skip


def as_result(row: Floats) -> Result:
    """One row as a record, its counts whole numbers again."""
    kinds = get_type_hints(Result)
    pairs = zip(Result._fields, row.tolist(), strict=True)
    return Result(**{name: kinds[name](value) for name, value in pairs})


def compiled(function: Function) -> Function:
    """Compile at the first call, or load what an earlier process compiled."""
    try:
        return cast("Function", njit(cache=True, nogil=True, error_model="numpy")(function))
    except RuntimeError:  # no folder to keep compiled code in
        return cast("Function", njit(nogil=True, error_model="numpy")(function))


def inlined(function: Function) -> Function:
    """Part of whatever calls it, so that loops over lanes become vectors."""
    return cast("Function", njit(forceinline=True, nogil=True, error_model="numpy")(function))


# -- Random numbers: ``random_stream`` ------------------------------------------------------------


@compiled
def _mix(number: np.uint64) -> np.uint64:
    number = (number ^ (number >> U30)) * MIX_1
    number = (number ^ (number >> U27)) * MIX_2
    return number ^ (number >> U31)


@compiled
def _key_of(seed: np.uint64, stream: np.uint64) -> np.uint64:
    key = _mix(_mix(seed + GOLDEN)) + GOLDEN
    return _mix(key ^ _mix(stream + GOLDEN)) + GOLDEN


@compiled
def _step_of(key: np.uint64) -> np.uint64:
    step = _mix(key ^ GOLDEN) | ONE
    changes, left = 0, step ^ (step >> ONE)
    while left != ZERO:
        left &= left - ONE
        changes += 1
    return step ^ FLIP if changes < FEW else step


@compiled
def _uniform(state: np.uint64, step: np.uint64) -> tuple[float, np.uint64]:
    state += step
    return np.int64(_mix(state) >> U11) * TO_UNIT, state


@compiled
def _below(state: np.uint64, step: np.uint64, n: int) -> tuple[int, np.uint64]:
    share, state = _uniform(state, step)
    return int(share * n), state


@compiled
def _normal(state: np.uint64, step: np.uint64) -> tuple[float, np.uint64]:
    while True:
        state += step
        bits = _mix(state)
        layer = np.int64(bits & LAYER)
        share = 2.0 * np.int64(bits >> U11) * TO_UNIT - 1.0
        if abs(share) < INNER[layer]:
            return share * EDGE[layer], state
        if layer == 0:
            return _tail(state, step, bool(share < 0.0))
        x = share * EDGE[layer]
        low = math.exp(-0.5 * (EDGE[layer] ** 2 - x * x))
        high = math.exp(-0.5 * (EDGE[layer + 1] ** 2 - x * x))
        height, state = _uniform(state, step)
        if high + height * (low - high) < 1.0:
            return x, state


@compiled
def _tail(state: np.uint64, step: np.uint64, is_negative: bool) -> tuple[float, np.uint64]:
    while True:
        one, state = _uniform(state, step)
        other, state = _uniform(state, step)
        x, y = math.log(1.0 - one) / TAIL_FROM, math.log(1.0 - other)
        if -2.0 * y >= x * x:
            return (x - TAIL_FROM if is_negative else TAIL_FROM - x), state


# -- City: ``city`` -------------------------------------------------------------------------------


@compiled
def _streets(
    state: np.uint64, step: np.uint64, side_m: float, n: Numbers
) -> tuple[Floats, np.uint64]:
    span = n.longest_block_m - n.shortest_block_m
    places = np.empty(3 + int(side_m / n.shortest_block_m))
    places[0], count = 0.0, 1
    while True:
        share, state = _uniform(state, step)
        there = places[count - 1] + n.shortest_block_m + span * share
        if there > side_m and count > 1:
            return places[:count].copy(), state
        places[count] = there
        count += 1


@compiled
def _gates_of(ways: Bytes, columns: int) -> Bytes:
    """Shape (4, N): which kinds of reach come into each place, from the neighbour on each side."""
    size = len(ways)
    gates = np.zeros((4, size), np.uint8)
    for way, apart in ((0, 1), (1, columns)):
        for i in range(size - apart):
            there, back = (ways[i] >> way) & 1, (ways[i + apart] >> (way + 2)) & 1
            either = (there | back) << 2
            gates[way, i] = back | there << 1 | either
            gates[way + 2, i + apart] = there | back << 1 | either
    return gates


@compiled
def _spread(reach: Bytes, gates: Bytes, columns: int) -> None:
    """Let all three kinds of reach go on through the gates, sweep by sweep, until none grows.

    Cities are mostly open: a few sweeps do, each as quick as a look at all places.
    """
    rows = len(reach) // columns
    grid, sides = reach.reshape((rows, columns)), gates.reshape((4, rows, columns))
    grows = True
    while grows:
        grows = False
        for row in range(rows):
            if row:
                _spread_over(grid[row - 1], grid[row], sides[3, row])
            line, gate, here = grid[row], sides[2, row], np.uint8(0)
            for i in range(columns):
                here = line[i] | (here & gate[i])
                line[i] = here
        for row in range(rows - 1, -1, -1):
            if row + 1 < rows and _spread_over(grid[row + 1], grid[row], sides[1, row]):
                grows = True
            line, gate, here = grid[row], sides[0, row], np.uint8(0)
            change = np.uint8(0)
            for i in range(columns - 1, -1, -1):
                here = line[i] | (here & gate[i])
                change |= here ^ line[i]
                line[i] = here
            grows |= change != 0


@inlined
def _spread_over(known: Bytes, line: Bytes, gate: Bytes) -> bool:
    """From one row of places to the next; does that grow?"""
    change = np.uint8(0)
    for i in range(len(line)):
        more = line[i] | (known[i] & gate[i])
        change |= more ^ line[i]
        line[i] = more
    return bool(change)


@compiled
def _make_dead_end(ways: Bytes, columns: int, node: int, keep: int) -> None:
    kept = False
    for turn in range(4):
        way = (keep + turn) & 3
        if not (ways[node] >> way) & 1:
            continue
        if not kept:
            kept = True
            continue
        ways[node] &= ~np.uint8(1 << way)
        ways[node + (1, columns, -1, -columns)[way]] &= ~np.uint8(1 << ((way + 2) & 3))


@compiled
def _largest_part(gates: Bytes, columns: int) -> Bytes:
    """What can be reached, and how, from the first place of the part with most places."""
    size = gates.shape[1]
    best, seen = np.zeros(size, np.uint8), np.zeros(size, np.bool_)
    most, left = 0, size
    for start in range(size):
        if seen[start]:
            continue
        reach = np.zeros(size, np.uint8)
        reach[start] = ONWARD | HOMEWARD | EITHER
        _spread(reach, gates, columns)
        count = 0
        for node in range(size):
            is_part = reach[node] != 0
            seen[node] |= is_part
            count += is_part
        if count > most:
            most, best = count, reach
        left -= count
        if left <= most:
            break
    return best


@compiled
def _open_traps(ways: Bytes, columns: int, reach: Bytes, gates: Bytes) -> None:
    """Where one cannot come from or cannot leave, roads to where one can become two-way."""
    both = np.uint8(ONWARD | HOMEWARD)
    while True:
        opened = False
        for node in range(len(ways)):
            if reach[node] & both == both or not reach[node]:
                continue
            # Roads between what is in and what is not, both ways: this node is the end that is not.
            for way in range(4):
                there = node + (1, columns, -1, -columns)[way]
                if not gates[way, node] or reach[there] & both != both:
                    continue
                ways[node] |= np.uint8(1 << way)
                ways[there] |= np.uint8(1 << ((way + 2) & 3))
                gates[way, node] = gates[(way + 2) & 3, there] = ONWARD | HOMEWARD | EITHER
                opened = True
        if not opened:
            return
        _spread(reach, gates, columns)


@compiled
def _is_city(ways: Bytes, columns: int) -> bool:
    comes = np.zeros(len(ways), np.int64)
    for node in range(len(ways)):
        out = 0
        for way in range(4):
            if (ways[node] >> way) & 1:
                out += 1
                there = node + (1, columns, -1, -columns)[way]
                comes[there] += 1
                if comes[there] == 3:
                    return True
        if out > 2:
            return True
    return False


@inlined
def _make_city(
    key: np.uint64, n: Numbers
) -> tuple[Floats, Floats, Bytes, NDArray[np.bool_], float]:
    state, step = key, _step_of(key)
    share, state = _uniform(state, step)
    area_km2 = n.smallest_km2 + (n.largest_km2 - n.smallest_km2) * share
    side_m = 1000.0 * math.sqrt(area_km2)
    xs, state = _streets(state, step, side_m, n)
    ys, state = _streets(state, step, side_m, n)
    columns, size = len(xs), len(xs) * len(ys)
    ways = np.full(size, 15, np.uint8)
    for node in range(0, size, columns):
        ways[node] &= 11
        ways[node + columns - 1] &= 14
    for column in range(columns):
        ways[column] &= 7
        ways[size - columns + column] &= 13
    for _ in range(int(n.dead_end_share * size)):
        node, state = _below(state, step, size)
        way, state = _below(state, step, 4)
        _make_dead_end(ways, columns, node, way)
    for _ in range(int(n.one_way_share * 2 * size)):
        node, state = _below(state, step, size)
        way, state = _below(state, step, 4)
        back = np.uint8(1 << ((way + 2) & 3))
        if (ways[node] >> way) & 1:
            there = node + (1, columns, -1, -columns)[way]
            if ways[there] & back:
                ways[there] &= ~back
    gates = _gates_of(ways, columns)
    reach = _largest_part(gates, columns)
    inside = reach != 0
    ways[~inside] = 0
    _open_traps(ways, columns, reach, gates)
    return xs, ys, ways, inside, area_km2


@compiled
def _draw_place(
    state: np.uint64, step: np.uint64, inside: NDArray[np.bool_]
) -> tuple[int, np.uint64]:
    while True:
        node, state = _below(state, step, len(inside))
        if inside[node]:
            return node, state


@compiled
def _draw_goal(
    state: np.uint64, step: np.uint64, xs: Floats, ys: Floats, inside: NDArray[np.bool_],
    start: int, at_least_m: float,
) -> tuple[int, np.uint64]:  # fmt: skip
    columns = len(xs)
    x, y, goal = xs[start % columns], ys[start // columns], start
    for _ in range(TRIES):
        goal, state = _draw_place(state, step, inside)
        dx, dy = xs[goal % columns] - x, ys[goal // columns] - y
        if goal != start and dx * dx + dy * dy >= at_least_m * at_least_m:
            break
    return goal, state


# -- Geometry: ``angles`` and ``ekf`` -------------------------------------------------------------


@compiled
def _wrap(angle: float) -> float:
    if -PI < angle <= PI:
        return angle
    return angle - TWO_PI * math.ceil((angle - PI) / TWO_PI)


@inlined
def _small_arc(t: float) -> tuple[float, float, float, float]:
    """``_arc`` of an angle below ``SERIES_RAD``."""
    u = t * t
    along = 1.0 + u * (A1 + u * (A2 + u * (A3 + u * A4)))
    across = t * (0.5 + u * (B1 + u * (B2 + u * (B3 + u * B4))))
    along_by = t * (C0 + u * (C1 + u * (C2 + u * (C3 + u * C4))))
    across_by = 0.5 + u * (D1 + u * (D2 + u * (D3 + u * D4)))
    return along, across, along_by, across_by


@compiled
def _arc(t: float) -> tuple[float, float, float, float]:
    """Per metre of an arc that turns by ``t``: along, across, and their derivatives by ``t``."""
    if abs(t) < SERIES_RAD:
        return _small_arc(t)
    sine = math.sin(t)
    along, across = sine / t, 2.0 * math.sin(t / 2.0) ** 2 / t
    return along, across, (math.cos(t) - along) / t, (sine - across) / t


@inlined
def _predicted(
    state: State, gone: float, bend: float, gone_var: float, bend_var: float,
    arc: tuple[float, float, float, float],
) -> State:  # fmt: skip
    """``ekf.predict_odometry`` along an arc of these values of ``_arc``."""
    bx, by, bh, bc, bs, xx, xy, xh, yy, yh, hh = state
    along, across, along_by, across_by = arc
    fx, fy = bc * along - bs * across, bs * along + bc * across
    tx = gone * (bc * along_by - bs * across_by)
    ty = gone * (bs * along_by + bc * across_by)
    mx, my = gone * fx, gone * fy
    dc, ds = 1.0 - bend * across, bend * along
    return (
        bx + mx, by + my, _wrap(bh + bend), bc * dc - bs * ds, bs * dc + bc * ds,
        xx + (my * (my * hh - 2.0 * xh) + fx * fx * gone_var + tx * tx * bend_var),
        xy + (mx * xh - my * yh - mx * my * hh + fx * fy * gone_var + tx * ty * bend_var),
        xh + (tx * bend_var - my * hh),
        yy + (mx * (mx * hh + 2.0 * yh) + fy * fy * gone_var + ty * ty * bend_var),
        yh + (ty * bend_var + mx * hh),
        hh + bend_var,
    )  # fmt: skip


@inlined
def _weighed(state: State, compass: float, compass_var: float) -> tuple[float, State]:
    """``ekf.update_heading``; the change of heading, and the state after it."""
    bx, by, bh, bc, bs, xx, xy, xh, yy, yh, hh = state
    innovation = _wrap(compass - bh)
    per = 1.0 / (hh + compass_var)
    kx, ky, kh, keep = xh * per, yh * per, hh * per, compass_var * per
    shift = kh * innovation
    along, across, _, _ = _small_arc(shift)
    dc, ds = 1.0 - shift * across, shift * along
    return shift, (
        bx + kx * innovation, by + ky * innovation, _wrap(bh + shift),
        bc * dc - bs * ds, bs * dc + bc * ds,
        xx - kx * xh, xy - kx * yh, xh * keep, yy - ky * yh, yh * keep, hh * keep,
    )  # fmt: skip


@compiled
def _nees(
    ex: float, ey: float, eh: float,
    xx: float, xy: float, xh: float, yy: float, yh: float, hh: float,
) -> float:  # fmt: skip
    """Squared error in units of the covariance, by its Cholesky factor."""
    a = math.sqrt(xx)
    b, c = xy / a, xh / a
    d = math.sqrt(yy - b * b)
    e = (yh - b * c) / d
    f = math.sqrt(hh - c * c - e * e)
    u = ex / a
    v = (ey - b * u) / d
    w = (eh - c * u - e * v) / f
    return u * u + v * v + w * w


# -- Navigation: ``navigation`` -------------------------------------------------------------------


@compiled
def _recognised(xs: Floats, ys: Floats, count: int, x: float, y: float, radius_m: float) -> int:
    nearest, least = -1, radius_m**2
    for i in range(count):
        square = (xs[i] - x) ** 2 + (ys[i] - y) ** 2
        if square < least:
            nearest, least = i, square
    return nearest


@compiled
def _option(
    place: int, first: Ints, following: Ints, headings: Floats, heading: float, same_rad: float
) -> int:
    nearest, least = -1, same_rad
    option = first[place]
    while option >= 0:
        apart = abs(_wrap(headings[option] - heading))
        if apart < least:
            nearest, least = option, apart
        option = following[option]
    return nearest


@compiled
def _landmark_ahead(
    x: float, y: float, gx: float, gy: float, xs: Floats, ys: Floats, nodes: Ints, count: int,
    is_visited: NDArray[np.bool_],
) -> int:  # fmt: skip
    columns, to_goal = len(xs), (gx - x) ** 2 + (gy - y) ** 2
    nearest, least = -1, np.inf
    for i in range(count):
        lx, ly = xs[nodes[i] % columns], ys[nodes[i] // columns]
        to_car, left = (lx - x) ** 2 + (ly - y) ** 2, (lx - gx) ** 2 + (ly - gy) ** 2
        if left < to_goal and to_car < to_goal and not is_visited[i] and to_car < least:
            nearest, least = i, to_car
    return nearest


@compiled
def _doubled(numbers: NDArray[Number]) -> NDArray[Number]:
    larger = np.empty(2 * len(numbers), numbers.dtype)
    for i in range(len(numbers)):
        larger[i] = numbers[i]
    return larger


@compiled
def _note(
    events: Floats, noted: int, step: int, kind: int, xs: Floats, ys: Floats, node: int,
    seen_x: float, seen_y: float,
) -> int:  # fmt: skip
    """Keep an event while there is room; how many there are comes back."""
    if noted == len(events):
        return noted
    row = events[noted]
    row[0], row[1] = step, kind
    row[2], row[3] = xs[node % len(xs)], ys[node // len(xs)]
    row[4], row[5] = seen_x, seen_y
    return noted + 1


# -- The drives -----------------------------------------------------------------------------------


class Lanes(NamedTuple):
    """As many drives side by side; see ``X`` and its like for where a lane keeps its numbers."""

    f: Floats
    k: Ints
    u: Keys
    arcs: Floats
    xs: list[Floats]
    ys: list[Floats]
    ways: list[Bytes]
    inside: list[NDArray[np.bool_]]
    landmark_at: list[Ints]
    landmarks: list[Ints]
    is_visited: list[NDArray[np.bool_]]
    place_x: list[Floats]
    place_y: list[Floats]
    place_first: list[Ints]
    option_next: list[Ints]
    option_h: list[Floats]
    option_times: list[Floats]


@inlined
def _lanes() -> Lanes:
    return Lanes(
        np.zeros(FLOATS * LANES), np.full(WHOLES * LANES, -1, np.int64),
        np.zeros(STATES * LANES, np.uint64), np.empty((LANES, 3, 5)),
        [np.empty(0)] * LANES, [np.empty(0)] * LANES, [np.empty(0, np.uint8)] * LANES,
        [np.empty(0, np.bool_)] * LANES, [np.empty(0, np.int64)] * LANES,
        [np.empty(0, np.int64)] * LANES, [np.empty(0, np.bool_)] * LANES,
        [np.empty(0)] * LANES, [np.empty(0)] * LANES,
        [np.empty(0, np.int64)] * LANES, [np.empty(0, np.int64)] * LANES,
        [np.empty(0)] * LANES, [np.empty(0)] * LANES,
    )  # fmt: skip


@compiled
def drive_rows(n: Numbers, seeds: Keys, rows: Floats, trace: Floats, events: Floats) -> None:
    """Fill ``rows`` with the result of each seed's drive, several drives at a time.

    A lane that is done begins the next drive, so that no lane waits for the longest.

    Args:
        n: Settings.
        seeds: Shape (N,).
        rows: Shape (N, 22): each drive's ``Result``; with three more columns, the filter's first x,
            y, heading follow.
        trace: Shape (S, 16), of the first drive: true x, y, heading, speed; left and right wheel's
            path as read; compass, NaN where none was read; then the filter's x, y, heading and
            their covariance xx, xy, xh, yy, yh, hh. Filled as far as it goes.
        events: Shape (E, 6), likewise: step, kind, x, y of goal or landmark, x, y that a landmark
            gave.
    """
    lanes = _lanes()
    f, k = lanes.f, lanes.k
    none = np.empty((0, EVENT))
    under_way, following, kept, has_room = 0, 0, 0, True
    while True:
        if has_room:
            for lane in range(LANES):
                while k[ROW + lane] < 0 and following < len(seeds):
                    of_first = events if following == 0 else none
                    under_way += _start(n, lanes, lane, following, seeds, rows, of_first)
                    following += 1
            has_room = False
        if under_way == 0:
            return
        _step(n, f, lanes.u)
        if kept < len(trace):
            _keep(f, trace[kept])
            kept += 1
        for lane in range(LANES):
            if f[NOTABLE + lane] != 0.0 and k[ROW + lane] >= 0:
                of_first = events if k[ROW + lane] == 0 else none
                if _attend(n, lanes, lane, of_first):
                    _finish(n, lanes, lane, rows[k[ROW + lane]])
                    k[ROW + lane] = -1
                    under_way -= 1
                    has_room = True


@inlined
def _start(
    n: Numbers, lanes: Lanes, lane: int, number: int, seeds: Keys, rows: Floats, events: Floats
) -> bool:
    """Begin a drive in a lane; False where its city is none."""
    f, k, u, seed, row = lanes.f, lanes.k, lanes.u, seeds[number], rows[number]
    xs, ys, ways, inside, area_km2 = _make_city(_key_of(seed, CITY_KEY), n)
    columns = len(xs)
    for i in range(len(row)):
        row[i] = np.nan
    if not _is_city(ways, columns):
        row[0] = NO_CITY
        return False
    for i in range(FLOATS):
        f[i * LANES + lane] = 0.0
    for i in range(WHOLES):
        k[i * LANES + lane] = 0
    # Start, goal, landmarks.
    places = _key_of(seed, PLACE_KEY)
    places_step = _step_of(places)
    start, places = _draw_place(places, places_step, inside)
    way, places = _below(places, places_step, 4)
    while not (ways[start] >> way) & 1:
        way = (way + 1) & 3
    landmark_at = np.full(len(ways), -1, np.int64)
    goal, places = _draw_goal(places, places_step, xs, ys, inside, start, n.goal_at_least_m)
    if n.landmark_per_goal:
        landmarks = np.empty(1, np.int64)
        share, places = _uniform(places, places_step)
        landmark_count = 1 if share < n.landmarks_per_km2 * area_km2 else 0
        if landmark_count:
            landmarks[0], places = _draw_place(places, places_step, inside)
            landmark_at[landmarks[0]] = 0
    else:
        share, places = _uniform(places, places_step)
        landmark_count = min(int(n.landmarks_per_km2 * area_km2 + share), inside.sum())
        landmarks = np.empty(landmark_count, np.int64)
        for i in range(landmark_count):
            there, places = _draw_place(places, places_step, inside)
            while landmark_at[there] >= 0:
                there, places = _draw_place(places, places_step, inside)
            landmark_at[there], landmarks[i] = i, there
    noted = _note(events, 0, 0, GOAL_SET, xs, ys, goal, np.nan, np.nan)
    for i in range(landmark_count):
        noted = _note(events, noted, 0, LANDMARK_SET, xs, ys, landmarks[i], np.nan, np.nan)
    start_x, start_y = xs[start % columns], ys[start // columns]
    goal_x, goal_y = xs[goal % columns], ys[goal // columns]
    row[4] = math.hypot(goal_x - start_x, goal_y - start_y)
    row[5] = abs(goal_x - start_x) + abs(goal_y - start_y)
    row[6], row[7] = area_km2, landmark_count
    lanes.xs[lane], lanes.ys[lane], lanes.ways[lane], lanes.inside[lane] = xs, ys, ways, inside
    lanes.landmark_at[lane], lanes.landmarks[lane] = landmark_at, landmarks
    lanes.is_visited[lane] = np.zeros(max(landmark_count, 1), np.bool_)
    lanes.place_x[lane], lanes.place_y[lane] = np.empty(ROOM), np.empty(ROOM)
    lanes.place_first[lane] = np.empty(ROOM, np.int64)
    lanes.option_next[lane] = np.empty(ROOM, np.int64)
    lanes.option_h[lane], lanes.option_times[lane] = np.empty(ROOM), np.empty(ROOM)
    k[ROW + lane], k[WAY + lane], k[TURN + lane], k[GOAL + lane] = number, way, -1, goal
    k[NODE + lane] = start + (1, columns, -1, -columns)[way]
    k[LANDMARK_COUNT + lane], k[NOTED + lane] = landmark_count, noted
    u[PLACES + lane], u[PLACES_STEP + lane] = places, places_step
    f[START_X + lane], f[START_Y + lane] = start_x, start_y
    f[GOAL_X + lane], f[GOAL_Y + lane] = goal_x, goal_y
    f[AREA + lane] = area_km2
    f[FIRST_GOAL + lane] = f[FIRST_AXIS + lane] = f[GOAL_ERROR + lane] = np.nan
    # The car, and what it believes at first.
    _face(n, lanes, lane, way)
    noise = _key_of(seed, SENSOR_KEY)
    noise_step = _step_of(noise)
    street_c, street_s = COSINES[way], SINES[way]
    x = start_x + n.lane_offset_m * street_s
    y = start_y - n.lane_offset_m * street_c
    f[X + lane], f[Y + lane], f[H + lane] = x, y, HEADINGS_RAD[way]
    f[C + lane], f[S + lane], f[V + lane] = street_c, street_s, n.turn_mps
    off, noise = _normal(noise, noise_step)
    f[BX + lane] = x + n.start_position_sd_m * off
    off, noise = _normal(noise, noise_step)
    f[BY + lane] = y + n.start_position_sd_m * off
    off, noise = _normal(noise, noise_step)
    heading = _wrap(HEADINGS_RAD[way] + n.start_heading_sd_rad * off)
    f[BH + lane], f[BC + lane], f[BS + lane] = heading, math.cos(heading), math.sin(heading)
    u[NOISE + lane], u[NOISE_STEP + lane] = noise, noise_step
    f[XX + lane] = f[YY + lane] = n.start_position_sd_m**2
    f[HH + lane] = n.start_heading_sd_rad**2
    if len(row) > FIELDS:
        row[FIELDS], row[FIELDS + 1], row[FIELDS + 2] = f[BX + lane], f[BY + lane], heading
    return True


@inlined
def _face(n: Numbers, lanes: Lanes, lane: int, way: int) -> None:
    """Keep what the steps need of the street ahead."""
    f, node, xs = lanes.f, lanes.k[NODE + lane], lanes.xs[lane]
    f[STREET_C + lane], f[STREET_S + lane] = COSINES[way], SINES[way]
    f[NODE_X + lane], f[NODE_Y + lane] = xs[node % len(xs)], lanes.ys[lane][node // len(xs)]
    f[BRAKES + lane], f[ENTRY + lane], f[NOTICE_AT + lane] = 0.0, 0.0, n.decide_at_m


# -- One step of all lanes ------------------------------------------------------------------------


@inlined
def _step(n: Numbers, f: Floats, u: Keys) -> None:
    """Truth, wheels, compass and filter go on by a step; lanes with more to do become notable.

    Loops over lanes hold no calls and no branches, so that the compiler makes vectors of them; what
    is rare (normals near a layer's edge, angles too large for a series) is done again after them.
    """
    if _draw_normals(f, u):
        _draw_rare_normals(f, u)
    if _control(n, f):
        for lane in range(LANES):
            if abs(f[TURNED + lane]) >= SERIES_RAD:
                f[ALONG + lane], f[ACROSS + lane], _, _ = _arc(f[TURNED + lane])
    _move(n, f)
    for lane in range(LANES):
        is_read = f[COMPASS + lane] == f[COMPASS + lane]
        u[NOISE + lane] = u[NOISE_3 + lane] if is_read else u[NOISE_2 + lane]
    _filter(n, f)
    _look(n, f)


@inlined
def _filter(n: Numbers, f: Floats) -> None:
    """The belief after what wheels and compass told."""
    if _odometry(n, f):
        for lane in range(LANES):
            if abs(f[BEND + lane]) >= SERIES_RAD:
                arc = _arc(f[BEND + lane])
                f[ALONG + lane], f[ACROSS + lane] = arc[0], arc[1]
                f[ALONG_BY + lane], f[ACROSS_BY + lane] = arc[2], arc[3]
    if _estimate(n, f):
        for lane in range(LANES):
            if abs(f[SHIFT + lane]) >= SERIES_RAD:
                heading = f[BH + lane]
                f[BC + lane], f[BS + lane] = math.cos(heading), math.sin(heading)


@compiled
def filter_rows(n: Numbers, first: Floats, readings: Floats, ends: Floats) -> None:
    """The filter alone, on what 16 drives' wheels and compasses told.

    Args:
        n: Settings.
        first: Shape (3, 16): x, y, heading before the first step.
        readings: Shape (S, 3, 16): left and right wheel's path, compass or NaN.
        ends: Shape (9, 16), filled: x, y, heading, covariance xx, xy, xh, yy, yh, hh.
    """
    f = np.zeros(FLOATS * LANES)
    for lane in range(LANES):
        f[BX + lane], f[BY + lane], f[BH + lane] = first[0, lane], first[1, lane], first[2, lane]
        f[BC + lane], f[BS + lane] = math.cos(first[2, lane]), math.sin(first[2, lane])
        f[XX + lane] = f[YY + lane] = n.start_position_sd_m**2
        f[HH + lane] = n.start_heading_sd_rad**2
    for reading in readings:
        for lane in range(LANES):
            f[LEFT + lane], f[RIGHT + lane] = reading[0, lane], reading[1, lane]
            f[COMPASS + lane] = reading[2, lane]
        _filter(n, f)
    for i in range(9):
        for lane in range(LANES):
            ends[i, lane] = f[FILTERED[i] + lane]


@inlined
def _draw_normals(f: Floats, u: Keys) -> int:
    """Three for each lane, the third in case the compass is read; is any of them a rare one?"""
    rare = 0
    for lane in range(LANES):
        step = u[NOISE_STEP + lane]
        first = u[NOISE + lane] + step
        second = first + step
        third = second + step
        u[NOISE_2 + lane], u[NOISE_3 + lane] = second, third
        bits = _mix(first)
        layer = np.int64(bits & LAYER)
        share = 2.0 * np.int64(bits >> U11) * TO_UNIT - 1.0
        misses = abs(share) >= INNER[layer]
        f[Z_LEFT + lane] = share * EDGE[layer]
        bits = _mix(second)
        layer = np.int64(bits & LAYER)
        share = 2.0 * np.int64(bits >> U11) * TO_UNIT - 1.0
        misses |= abs(share) >= INNER[layer]
        f[Z_RIGHT + lane] = share * EDGE[layer]
        bits = _mix(third)
        layer = np.int64(bits & LAYER)
        share = 2.0 * np.int64(bits >> U11) * TO_UNIT - 1.0
        misses |= abs(share) >= INNER[layer]
        f[Z_COMPASS + lane] = share * EDGE[layer]
        f[RARE + lane] = 1.0 if misses else 0.0
        rare |= misses
    return rare


@inlined
def _draw_rare_normals(f: Floats, u: Keys) -> None:
    for lane in range(LANES):
        if f[RARE + lane] != 0.0:
            state, step = u[NOISE + lane], u[NOISE_STEP + lane]
            f[Z_LEFT + lane], state = _normal(state, step)
            f[Z_RIGHT + lane], state = _normal(state, step)
            u[NOISE_2 + lane] = state
            f[Z_COMPASS + lane], state = _normal(state, step)
            u[NOISE_3 + lane] = state


@inlined
def _control(n: Numbers, f: Floats) -> int:
    """How the car lies to its lane, and what its controllers make of it."""
    step_s, per_step, per_wheelbase = n.step_s, 1.0 / n.step_s, 1.0 / n.wheelbase_m
    large = 0
    for lane in range(LANES):
        x, y, c, s, speed = f[X + lane], f[Y + lane], f[C + lane], f[S + lane], f[V + lane]
        in_arc = f[IN_ARC + lane] != 0.0
        street_c, street_s = f[STREET_C + lane], f[STREET_S + lane]
        node_x, node_y = f[NODE_X + lane], f[NODE_Y + lane]
        # On an arc.
        out_x, out_y = x - f[CENTRE_X + lane], y - f[CENTRE_Y + lane]
        apart = math.sqrt(out_x * out_x + out_y * out_y)
        side = f[SIDE + lane]
        arc_beside = side * (abs(f[RADIUS + lane]) - apart)
        arc_growth = side * (-out_y * s - out_x * c) / apart
        # Along a street.
        beside = street_c * (y - node_y) - street_s * (x - node_x) + n.lane_offset_m
        growth = street_c * s - street_s * c
        room = street_c * (node_x - x) + street_s * (node_y - y) - f[ENTRY + lane]
        brake = math.sqrt(n.turn_mps**2 + 2.0 * n.accel_mps2 * max(room, 0.0))
        wanted = min(n.cruise_mps, brake) if room > 0.0 else n.turn_mps
        wanted = wanted if f[BRAKES + lane] != 0.0 else n.cruise_mps
        beside = arc_beside if in_arc else beside
        growth = arc_growth if in_arc else growth
        wanted = n.turn_mps if in_arc else wanted
        curvature = f[CURVATURE + lane]
        # Controllers.
        slow = wanted - speed
        slow_sum = min(max(f[SLOW_SUM + lane] + slow * step_s, -WINDUP), WINDUP)
        push = n.speed_p * slow + n.speed_i * slow_sum - n.speed_d * f[ACCEL + lane]
        push = min(max(push, -BRAKE_SHARE * n.accel_mps2), n.accel_mps2)
        accel = max(push, (SLOWEST_MPS - speed) * per_step)
        steering = n.wheelbase_m * curvature - n.steering_p * beside
        beside_sum = f[BESIDE_SUM + lane]
        steering -= n.steering_i * beside_sum + n.steering_d * growth
        steering = min(max(steering, -STEERING_LIMIT_RAD), STEERING_LIMIT_RAD)
        distance = speed * step_s + 0.5 * accel * step_s**2
        turned = distance * steering * per_wheelbase
        f[SLOW_SUM + lane], f[ACCEL + lane], f[V + lane] = slow_sum, accel, speed + accel * step_s
        f[BESIDE_SUM + lane] = min(max(beside_sum + beside * distance, -WINDUP), WINDUP)
        arc_m = f[ARC_M + lane]
        f[ARC_M + lane] = arc_m + distance / (1.0 - beside * curvature) if in_arc else arc_m
        f[TRAVELLED + lane] += distance
        f[DISTANCE + lane], f[TURNED + lane] = distance, turned
        f[ALONG + lane], f[ACROSS + lane], _, _ = _small_arc(turned)
        large |= abs(turned) >= SERIES_RAD
    return large


@inlined
def _move(n: Numbers, f: Floats) -> None:
    """Bicycle model (eq. 5 and 6); wheels, with slip, as their encoders tell; the compass."""
    half_track, per_count = 0.5 * n.track_width_m, 1.0 / n.encoder_step_m
    has_compass = n.compass_sd_rad >= 0.0
    for lane in range(LANES):
        c, s, distance, turned = f[C + lane], f[S + lane], f[DISTANCE + lane], f[TURNED + lane]
        along, across = f[ALONG + lane], f[ACROSS + lane]
        f[X + lane] += distance * (c * along - s * across)
        f[Y + lane] += distance * (s * along + c * across)
        dc, ds = 1.0 - turned * across, turned * along
        f[C + lane], f[S + lane] = c * dc - s * ds, s * dc + c * ds
        heading = _wrap(f[H + lane] + turned)
        f[H + lane] = heading
        half = half_track * turned
        path = distance - half
        slip = n.slip_per_sqrt_m * math.sqrt(abs(path)) * f[Z_LEFT + lane]
        unread = f[UNREAD_LEFT + lane] + (path + slip)
        left = np.floor(unread * per_count + 0.5) * n.encoder_step_m
        f[UNREAD_LEFT + lane], f[LEFT + lane] = unread - left, left
        path = distance + half
        slip = n.slip_per_sqrt_m * math.sqrt(abs(path)) * f[Z_RIGHT + lane]
        unread = f[UNREAD_RIGHT + lane] + (path + slip)
        right = np.floor(unread * per_count + 0.5) * n.encoder_step_m
        f[UNREAD_RIGHT + lane], f[RIGHT + lane] = unread - right, right
        since = f[SINCE + lane] + abs(0.5 * (left + right))
        is_read = has_compass & (since >= n.compass_interval_m)
        f[SINCE + lane] = since - n.compass_interval_m if is_read else since
        compass = _wrap(heading + n.compass_sd_rad * f[Z_COMPASS + lane])
        f[COMPASS + lane] = compass if is_read else np.nan


@inlined
def _odometry(n: Numbers, f: Floats) -> int:
    """The arc that the wheels tell; does any turn too much for the series?"""
    per_track = 1.0 / n.track_width_m
    large = 0
    for lane in range(LANES):
        bend = (f[RIGHT + lane] - f[LEFT + lane]) * per_track
        f[BEND + lane] = bend
        along, across, along_by, across_by = _small_arc(bend)
        f[ALONG + lane], f[ACROSS + lane] = along, across
        f[ALONG_BY + lane], f[ACROSS_BY + lane] = along_by, across_by
        large |= abs(bend) >= SERIES_RAD
    return large


@inlined
def _estimate(n: Numbers, f: Floats) -> int:
    """Follow that arc; weigh in the compass where it is read. Did any heading shift too much?"""
    slip_var = n.slip_per_sqrt_m**2
    turn_var_per_m = 2.0 * slip_var / n.track_width_m**2
    compass_var = n.compass_sd_rad**2
    large = 0
    for lane in range(LANES):
        gone, bend = 0.5 * (f[LEFT + lane] + f[RIGHT + lane]), f[BEND + lane]
        way = abs(gone)
        state = _predicted(
            (f[BX + lane], f[BY + lane], f[BH + lane], f[BC + lane], f[BS + lane], f[XX + lane],
             f[XY + lane], f[XH + lane], f[YY + lane], f[YH + lane], f[HH + lane]),
            gone, bend, 0.5 * slip_var * way, turn_var_per_m * way,
            (f[ALONG + lane], f[ACROSS + lane], f[ALONG_BY + lane], f[ACROSS_BY + lane]),
        )  # fmt: skip
        compass = f[COMPASS + lane]
        is_read = compass == compass
        shift, weighed = _weighed(state, compass, compass_var)
        f[SHIFT + lane] = shift if is_read else 0.0
        large |= is_read & (abs(shift) >= SERIES_RAD)
        f[BX + lane] = weighed[0] if is_read else state[0]
        f[BY + lane] = weighed[1] if is_read else state[1]
        f[BH + lane] = weighed[2] if is_read else state[2]
        f[BC + lane] = weighed[3] if is_read else state[3]
        f[BS + lane] = weighed[4] if is_read else state[4]
        f[XX + lane] = weighed[5] if is_read else state[5]
        f[XY + lane] = weighed[6] if is_read else state[6]
        f[XH + lane] = weighed[7] if is_read else state[7]
        f[YY + lane] = weighed[8] if is_read else state[8]
        f[YH + lane] = weighed[9] if is_read else state[9]
        f[HH + lane] = weighed[10] if is_read else state[10]
    return large


@inlined
def _look(n: Numbers, f: Floats) -> None:
    """Is there more to do than to go on?"""
    lost_16, arrive_2 = n.lost_above_m**2 / 16.0, n.arrive_within_m**2
    for lane in range(LANES):
        steps = f[STEPS + lane] + 1.0
        f[STEPS + lane] = steps
        xx, xy, yy = f[XX + lane], f[XY + lane], f[YY + lane]
        half_sum, half_gap = 0.5 * (xx + yy), 0.5 * (xx - yy)
        room = lost_16 - half_sum
        is_lost = (room < 0.0) | (half_gap * half_gap + xy * xy > room * room)
        to_x, to_y = f[BX + lane] - f[GOAL_X + lane], f[BY + lane] - f[GOAL_Y + lane]
        is_near = to_x * to_x + to_y * to_y <= max(arrive_2, 8.0 * half_sum)
        is_over = (f[TRAVELLED + lane] > n.longest_m) | (steps * n.step_s > n.longest_s)
        remaining = f[STREET_C + lane] * (f[NODE_X + lane] - f[X + lane]) + f[STREET_S + lane] * (
            f[NODE_Y + lane] - f[Y + lane]
        )
        is_there = (
            f[ARC_M + lane] >= f[ARC_LENGTH + lane]
            if f[IN_ARC + lane] != 0.0
            else remaining <= f[NOTICE_AT + lane]
        )
        f[NOTABLE + lane] = 1.0 if is_lost | is_near | is_over | is_there else 0.0


@compiled
def _keep(f: Floats, kept: Floats) -> None:
    for i in range(TRACED):
        kept[i] = f[TRACED_FROM[i]]


# -- What is not of every step --------------------------------------------------------------------


@inlined
def _attend(n: Numbers, lanes: Lanes, lane: int, events: Floats) -> bool:
    """Ends, goals and intersections; True when the drive is over."""
    f, k = lanes.f, lanes.k
    xx, xy, yy = f[XX + lane], f[XY + lane], f[YY + lane]
    half_sum, half_gap = 0.5 * (xx + yy), 0.5 * (xx - yy)
    # Ellipse's full major axis = 4 sqrt(half sum + radius).
    room = n.lost_above_m**2 / 16.0 - half_sum
    if room < 0.0 or half_gap * half_gap + xy * xy > room * room:
        k[OUTCOME + lane] = LOST
        return True
    away_2 = (f[BX + lane] - f[GOAL_X + lane]) ** 2 + (f[BY + lane] - f[GOAL_Y + lane]) ** 2
    within_2 = 4.0 * (half_sum + math.sqrt(half_gap * half_gap + xy * xy))
    if away_2 <= max(n.arrive_within_m**2, within_2):
        _arrive(n, lanes, lane, 2.0 * math.sqrt(within_2), events)
        if k[GOALS + lane] == n.goals:
            k[OUTCOME + lane] = REACHED
            return True
    if f[TRAVELLED + lane] > n.longest_m or f[STEPS + lane] * n.step_s > n.longest_s:
        k[OUTCOME + lane] = GIVEN_UP
        return True
    if f[IN_ARC + lane] != 0.0:
        if f[ARC_M + lane] >= f[ARC_LENGTH + lane]:
            _follow_arcs(lanes, lane, f[ARC_M + lane] - f[ARC_LENGTH + lane], k[ARC + lane] + 1)
        return False
    remaining = f[STREET_C + lane] * (f[NODE_X + lane] - f[X + lane]) + f[STREET_S + lane] * (
        f[NODE_Y + lane] - f[Y + lane]
    )
    if k[TURN + lane] < 0 and remaining <= n.decide_at_m:
        _decide(n, lanes, lane, remaining, within_2)
    if k[TURN + lane] >= 0 and remaining <= f[ENTRY + lane]:
        node = k[NODE + lane]
        if lanes.landmark_at[lane][node] >= 0:
            _pass_landmark(n, lanes, lane, node, events)
        _enter(n, lanes, lane)
    return False


@inlined
def _arrive(n: Numbers, lanes: Lanes, lane: int, axis_m: float, events: Floats) -> None:
    """The car believes to be at its goal: perhaps a new one is drawn."""
    f, k, u = lanes.f, lanes.k, lanes.u
    goal_x, goal_y = f[GOAL_X + lane], f[GOAL_Y + lane]
    k[GOALS + lane] += 1
    f[GOAL_ERROR + lane] = math.hypot(f[X + lane] - goal_x, f[Y + lane] - goal_y)
    f[FURTHEST + lane] = max(
        f[FURTHEST + lane], math.hypot(goal_x - f[START_X + lane], goal_y - f[START_Y + lane])
    )
    if k[GOALS + lane] == 1:
        f[FIRST_GOAL + lane], f[FIRST_AXIS + lane] = f[TRAVELLED + lane], axis_m
    if k[GOALS + lane] == n.goals:
        return
    xs, ys, inside = lanes.xs[lane], lanes.ys[lane], lanes.inside[lane]
    places, step = u[PLACES + lane], u[PLACES_STEP + lane]
    goal, places = _draw_goal(places, step, xs, ys, inside, k[NODE + lane], n.goal_at_least_m)
    k[GOAL + lane] = goal
    f[GOAL_X + lane], f[GOAL_Y + lane] = xs[goal % len(xs)], ys[goal // len(xs)]
    steps, noted = int(f[STEPS + lane]), k[NOTED + lane]
    noted = _note(events, noted, steps, GOAL_SET, xs, ys, goal, np.nan, np.nan)
    if n.landmark_per_goal:
        landmarks, landmark_at = lanes.landmarks[lane], lanes.landmark_at[lane]
        if k[LANDMARK_COUNT + lane]:
            landmark_at[landmarks[0]] = -1
        share, places = _uniform(places, step)
        area_km2 = f[AREA + lane]
        k[LANDMARK_COUNT + lane] = 1 if share < n.landmarks_per_km2 * area_km2 else 0
        if k[LANDMARK_COUNT + lane]:
            landmarks[0], places = _draw_place(places, step, inside)
            landmark_at[landmarks[0]] = 0
            lanes.is_visited[lane][0] = False
            noted = _note(events, noted, steps, LANDMARK_SET, xs, ys, landmarks[0], np.nan, np.nan)
    k[NOTED + lane], u[PLACES + lane] = noted, places


@inlined
def _follow_arcs(lanes: Lanes, lane: int, along_m: float, arc: int) -> None:
    """Begin an arc of the turn, or leave it after the last."""
    f, k = lanes.f, lanes.k
    k[ARC + lane] = arc
    if arc == k[ARCS + lane]:
        k[ARCS + lane] = 0
        f[ARC_M + lane] = f[IN_ARC + lane] = f[CURVATURE + lane] = 0.0
        return
    x, y, heading, curvature, length = lanes.arcs[lane, arc]
    radius = 1.0 / curvature
    f[ARC_M + lane], f[IN_ARC + lane], f[ARC_LENGTH + lane] = along_m, 1.0, length
    f[RADIUS + lane], f[CURVATURE + lane] = radius, 1.0 / radius
    f[SIDE + lane] = 1.0 if radius > 0.0 else -1.0
    f[CENTRE_X + lane] = x - radius * math.sin(heading)
    f[CENTRE_Y + lane] = y + radius * math.cos(heading)


@inlined
def _target(
    n: Numbers, lanes: Lanes, lane: int, at_x: float, at_y: float, within_2: float
) -> tuple[float, float]:
    """The goal, or the landmark sought on the way to it."""
    f = lanes.f
    goal_x, goal_y = f[GOAL_X + lane], f[GOAL_Y + lane]
    if n.strategy != LANDMARKS and (
        n.strategy != HYBRID or 2.0 * math.sqrt(within_2) <= n.hybrid_above_m
    ):
        return goal_x, goal_y
    xs, ys, landmarks = lanes.xs[lane], lanes.ys[lane], lanes.landmarks[lane]
    is_visited, count = lanes.is_visited[lane], lanes.k[LANDMARK_COUNT + lane]
    while True:
        found = _landmark_ahead(at_x, at_y, goal_x, goal_y, xs, ys, landmarks, count, is_visited)
        if found < 0:
            return goal_x, goal_y
        lx, ly = xs[landmarks[found] % len(xs)], ys[landmarks[found] // len(xs)]
        if (lx - at_x) ** 2 + (ly - at_y) ** 2 > max(n.arrive_within_m**2, within_2):
            return lx, ly
        is_visited[found] = True


@inlined
def _decide(n: Numbers, lanes: Lanes, lane: int, remaining: float, within_2: float) -> None:
    """Eq. 4 at the intersection ahead."""
    f, k = lanes.f, lanes.k
    heading, bh, way = f[H + lane], f[BH + lane], k[WAY + lane]
    f[C + lane], f[S + lane] = math.cos(heading), math.sin(heading)
    f[BC + lane], f[BS + lane] = math.cos(bh), math.sin(bh)
    at_x, at_y = f[BX + lane] + remaining * f[BC + lane], f[BY + lane] + remaining * f[BS + lane]
    target_x, target_y = _target(n, lanes, lane, at_x, at_y, within_2)
    place = _recognised(
        lanes.place_x[lane], lanes.place_y[lane], k[KNOWN + lane], at_x, at_y, n.recognise_within_m
    )
    turn, least, chosen_h = 2, np.inf, _wrap(bh + QUARTER_TURNS[2])
    roads = lanes.ways[lane][k[NODE + lane]]
    for quarter in (0, 1, 3):
        if not (roads >> ((way + quarter) & 3)) & 1:
            continue
        after = _wrap(bh + QUARTER_TURNS[quarter])
        bearing = math.atan2(
            target_y - (at_y + n.after_m * math.sin(after)),
            target_x - (at_x + n.after_m * math.cos(after)),
        )
        cost = abs(_wrap(after - bearing))
        if place >= 0:
            option = _option(
                place, lanes.place_first[lane], lanes.option_next[lane], lanes.option_h[lane],
                after, n.same_option_rad,
            )  # fmt: skip
            if option >= 0:
                cost += n.penalty_rad * lanes.option_times[lane][option]
        if cost < least:
            turn, least, chosen_h = quarter, cost, after
    _remember(n, lanes, lane, place, at_x, at_y, chosen_h)
    k[TURN + lane] = turn
    k[DECISIONS + lane] += 1
    k[TURNS + lane] += turn != 0
    entry_m = 0.0
    if turn == 1:
        entry_m = n.left_radius_m - n.lane_offset_m
    elif turn == 3:
        entry_m = n.right_radius_m + n.lane_offset_m
    f[ENTRY + lane] = f[NOTICE_AT + lane] = entry_m
    f[BRAKES + lane] = 1.0 if turn > 0 else 0.0


@inlined
def _remember(
    n: Numbers, lanes: Lanes, lane: int, place: int, at_x: float, at_y: float, heading: float
) -> None:
    """Places where it decided before hold a chain of options each."""
    k, known, options = lanes.k, lanes.k[KNOWN + lane], lanes.k[OPTIONS + lane]
    if place < 0:
        if known == len(lanes.place_x[lane]):
            lanes.place_x[lane] = _doubled(lanes.place_x[lane])
            lanes.place_y[lane] = _doubled(lanes.place_y[lane])
            lanes.place_first[lane] = _doubled(lanes.place_first[lane])
        place = known
        lanes.place_x[lane][place], lanes.place_y[lane][place] = at_x, at_y
        lanes.place_first[lane][place] = -1
        k[KNOWN + lane] = known + 1
    first = lanes.place_first[lane]
    option = _option(
        place, first, lanes.option_next[lane], lanes.option_h[lane], heading, n.same_option_rad
    )
    if option >= 0:
        lanes.option_times[lane][option] += 1.0
        return
    if options == len(lanes.option_h[lane]):
        lanes.option_h[lane] = _doubled(lanes.option_h[lane])
        lanes.option_times[lane] = _doubled(lanes.option_times[lane])
        lanes.option_next[lane] = _doubled(lanes.option_next[lane])
    following = lanes.option_next[lane]
    lanes.option_h[lane][options], lanes.option_times[lane][options] = heading, 1.0
    # New ones last: of options equally near, the first remembered counts.
    following[options] = -1
    if first[place] < 0:
        first[place] = options
    else:
        last = first[place]
        while following[last] >= 0:
            last = following[last]
        following[last] = options
    k[OPTIONS + lane] = options + 1


@inlined
def _pass_landmark(n: Numbers, lanes: Lanes, lane: int, node: int, events: Floats) -> None:
    """Perhaps recognise it: then it gives the car's position."""
    f, k, u = lanes.f, lanes.k, lanes.u
    xs, ys, steps = lanes.xs[lane], lanes.ys[lane], int(f[STEPS + lane])
    k[PASSED + lane] += 1
    noise, step = u[NOISE + lane], u[NOISE_STEP + lane]
    share, noise = _uniform(noise, step)
    if share >= n.detection_rate:
        u[NOISE + lane] = noise
        k[NOTED + lane] = _note(
            events, k[NOTED + lane], steps, LANDMARK_MISSED, xs, ys, node, np.nan, np.nan
        )
        return
    off, noise = _normal(noise, step)
    seen_x = f[X + lane] + n.landmark_sd_m * off
    off, noise = _normal(noise, step)
    seen_y = f[Y + lane] + n.landmark_sd_m * off
    u[NOISE + lane] = noise
    lanes.is_visited[lane][lanes.landmark_at[lane][node]] = True
    is_taken = _weigh_position(f, lane, seen_x, seen_y, n.landmark_sd_m**2, n.landmark_gate_nis)
    kind = LANDMARK_TAKEN if is_taken else LANDMARK_REFUSED
    k[NOTED + lane] = _note(events, k[NOTED + lane], steps, kind, xs, ys, node, seen_x, seen_y)
    if not is_taken:
        k[REFUSED + lane] += 1
        return
    k[DETECTED + lane] += 1
    gap_m = f[TRAVELLED + lane] - f[LAST_FIX + lane]
    f[LONGEST_GAP + lane] = max(f[LONGEST_GAP + lane], gap_m)
    f[LAST_FIX + lane] = f[TRAVELLED + lane]


@inlined
def _weigh_position(
    f: Floats, lane: int, seen_x: float, seen_y: float, var: float, gate_nis: float
) -> bool:
    """P - P H' S^-1 H P, entry by entry, unless the gate refuses."""
    xx, xy, xh = f[XX + lane], f[XY + lane], f[XH + lane]
    yy, yh, hh = f[YY + lane], f[YH + lane], f[HH + lane]
    ix, iy = seen_x - f[BX + lane], seen_y - f[BY + lane]
    sxx, syy = xx + var, yy + var
    per = 1.0 / (sxx * syy - xy * xy)
    wx, wy = (syy * ix - xy * iy) * per, (sxx * iy - xy * ix) * per
    if ix * wx + iy * wy > gate_nis:
        return False
    f[BX + lane] += xx * wx + xy * wy
    f[BY + lane] += xy * wx + yy * wy
    heading = _wrap(f[BH + lane] + xh * wx + yh * wy)
    f[BH + lane], f[BC + lane], f[BS + lane] = heading, math.cos(heading), math.sin(heading)
    axx, axy = (syy * xx - xy * xy) * per, (sxx * xy - xy * xx) * per
    ayx, ayy = (syy * xy - xy * yy) * per, (sxx * yy - xy * xy) * per
    ahx, ahy = (syy * xh - xy * yh) * per, (sxx * yh - xy * xh) * per
    f[XX + lane] = xx - axx * xx - axy * xy
    f[XY + lane] = xy - axx * xy - axy * yy
    f[XH + lane] = xh - axx * xh - axy * yh
    f[YY + lane] = yy - ayx * xy - ayy * yy
    f[YH + lane] = yh - ayx * xh - ayy * yh
    f[HH + lane] = hh - ahx * xh - ahy * yh
    return True


@inlined
def _enter(n: Numbers, lanes: Lanes, lane: int) -> None:
    """Lay the turn's arcs, and face the next intersection."""
    f, k = lanes.f, lanes.k
    way, turn, entry_m, arcs = k[WAY + lane], k[TURN + lane], f[ENTRY + lane], 0
    street_c, street_s = COSINES[way], SINES[way]
    at_x = f[NODE_X + lane] - street_c * entry_m + street_s * n.lane_offset_m
    at_y = f[NODE_Y + lane] - street_s * entry_m - street_c * n.lane_offset_m
    at_h = HEADINGS_RAD[way]
    if turn == 2:
        # Out of the lane to the right, round to the left, and into the lane back.
        swing = math.acos((n.lane_offset_m + n.right_radius_m) / (2.0 * n.right_radius_m))
        for i in range(3):
            angle = PI + 2.0 * swing if i == 1 else swing
            curvature = (1.0 if i == 1 else -1.0) / n.right_radius_m
            _lay(lanes.arcs[lane, i], at_x, at_y, at_h, curvature, n.right_radius_m * angle)
            bent = angle if i == 1 else -angle
            along, across, _, _ = _arc(bent)
            dx, dy = n.right_radius_m * angle * along, n.right_radius_m * angle * across
            at_c, at_s = math.cos(at_h), math.sin(at_h)
            at_x, at_y = at_x + at_c * dx - at_s * dy, at_y + at_s * dx + at_c * dy
            at_h += bent
        arcs = 3
    elif turn:
        curvature = 1.0 / n.left_radius_m if turn == 1 else -1.0 / n.right_radius_m
        _lay(lanes.arcs[lane, 0], at_x, at_y, at_h, curvature, abs(1.0 / curvature) * PI / 2.0)
        arcs = 1
    way = (way + turn) & 3
    k[WAY + lane], k[TURN + lane], k[ARCS + lane] = way, -1, arcs
    columns = len(lanes.xs[lane])
    k[NODE + lane] += (1, columns, -1, -columns)[way]
    _face(n, lanes, lane, way)
    if arcs:
        _follow_arcs(lanes, lane, 0.0, 0)


@compiled
def _lay(arc: Floats, x: float, y: float, heading: float, curvature: float, length: float) -> None:
    arc[0], arc[1], arc[2], arc[3], arc[4] = x, y, heading, curvature, length


@inlined
def _finish(n: Numbers, lanes: Lanes, lane: int, row: Floats) -> None:
    """The drive's ``Result``, as far as its start did not tell it."""
    f, k = lanes.f, lanes.k
    xx, xy, yy = f[XX + lane], f[XY + lane], f[YY + lane]
    half_sum, half_gap = 0.5 * (xx + yy), 0.5 * (xx - yy)
    ex, ey = f[BX + lane] - f[X + lane], f[BY + lane] - f[Y + lane]
    eh = _wrap(f[BH + lane] - f[H + lane])
    row[0], row[1] = k[OUTCOME + lane], f[TRAVELLED + lane]
    row[2], row[3] = f[STEPS + lane] * n.step_s, f[STEPS + lane]
    row[8], row[9], row[10] = k[PASSED + lane], k[DETECTED + lane], k[REFUSED + lane]
    row[11], row[12], row[13] = k[DECISIONS + lane], k[TURNS + lane], k[GOALS + lane]
    row[14], row[15] = f[FIRST_GOAL + lane], f[FIRST_AXIS + lane]
    row[16] = 4.0 * math.sqrt(half_sum + math.sqrt(half_gap * half_gap + xy * xy))
    row[17] = math.hypot(ex, ey)
    row[18] = _nees(ex, ey, eh, xx, xy, f[XH + lane], yy, f[YH + lane], f[HH + lane])
    row[19], row[20] = f[GOAL_ERROR + lane], f[FURTHEST + lane]
    row[21] = max(f[LONGEST_GAP + lane], f[TRAVELLED + lane] - f[LAST_FIX + lane])
