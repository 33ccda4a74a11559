"""A whole simulated drive compiled: city, decisions, car, controllers, sensors and filter.

``drive_simulator`` is the version to read; this one gives the same results number for number, up
to rounding, a thousand times as fast, and tests hold the two equal. Three things differ in form:

* The speed in the filter's state is left out: odometry carries the pose, so speed and pose never
  share a covariance, and no result depends on it.
* Sines and cosines of headings are turned along with the car, by the series of ``ekf.arc``, and
  taken afresh at each decision.
* A street's four ways are the bits of one byte.

Everything compiled stands in this one file: the compiler's cache looks at the file of the function
called and not at those of the functions that it calls.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, NamedTuple, TypeVar, cast, get_type_hints

import numpy as np
from numba import njit
from numpy.typing import NDArray

from crosscue.replay.columns import Floats

from . import drive_settings as settings_of
from . import random_stream
from .angles import TWO_PI
from .city import HEADINGS_RAD, TRIES, make_city
from .drive_simulator import (
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
from .navigation import Strategy
from .random_stream import Stream, key_of, ziggurat

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
ZERO, ONE, U11, U27, U30, U31 = (np.uint64(n) for n in (0, 1, 11, 27, 30, 31))
CITY_KEY, PLACE_KEY, SENSOR_KEY = (
    np.uint64(stream) for stream in (CITY_STREAM, PLACE_STREAM, SENSOR_STREAM)
)

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
STRATEGIES: Final = tuple(Strategy)
LANDMARKS: Final = STRATEGIES.index(Strategy.LANDMARKS)
HYBRID: Final = STRATEGIES.index(Strategy.HYBRID)


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
    drive_rows(numbers_of(settings), *ziggurat(), seeds, rows)
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
        steps: Shape (S, 16), as ``drive_row`` tells.
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
    row = np.empty(FIELDS + 3)
    drive_row(numbers_of(settings), *ziggurat(), key, row, steps, events)
    begin = row[FIELDS:]
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
def _normal(
    state: np.uint64, step: np.uint64, edge: Floats, inner: Floats
) -> tuple[float, np.uint64]:
    state += step
    bits = _mix(state)
    layer = np.int64(bits & LAYER)
    share = 2.0 * np.int64(bits >> U11) * TO_UNIT - 1.0
    if abs(share) < inner[layer]:
        return share * edge[layer], state
    return _rare_normal(state, step, edge, inner, layer, share)


@compiled
def _rare_normal(
    state: np.uint64, step: np.uint64, edge: Floats, inner: Floats, layer: np.int64, share: float
) -> tuple[float, np.uint64]:
    while True:
        if abs(share) < inner[layer]:
            return share * edge[layer], state
        if layer == 0:
            return _tail(state, step, share < 0.0)
        x = share * edge[layer]
        low = math.exp(-0.5 * (edge[layer] ** 2 - x * x))
        high = math.exp(-0.5 * (edge[layer + 1] ** 2 - x * x))
        height, state = _uniform(state, step)
        if high + height * (low - high) < 1.0:
            return x, state
        state += step
        bits = _mix(state)
        layer = np.int64(bits & LAYER)
        share = 2.0 * np.int64(bits >> U11) * TO_UNIT - 1.0


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
def _reach(
    ways: Bytes, columns: int, start: int, backward: bool, seen: NDArray[np.bool_], queue: Ints
) -> int:
    """Mark what can be reached (or from where); how many there are comes back."""
    seen[:] = False
    seen[start] = True
    queue[0], head, count = start, 0, 1
    while head < count:
        node = queue[head]
        head += 1
        for way in range(4):
            there = node + (1, columns, -1, -columns)[way]
            if there < 0 or there >= len(ways) or seen[there]:
                continue
            open_ = ways[there] >> ((way + 2) & 3) if backward else ways[node] >> way
            if open_ & 1:
                seen[there] = True
                queue[count] = there
                count += 1
    return count


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
def _largest_part(ways: Bytes, columns: int, queue: Ints) -> NDArray[np.bool_]:
    either = ways.copy()
    for node in range(len(ways)):
        for way in range(4):
            if (ways[node] >> way) & 1:
                either[node + (1, columns, -1, -columns)[way]] |= np.uint8(1 << ((way + 2) & 3))
    best, most = np.zeros(len(ways), np.bool_), 0
    part, left = np.empty(len(ways), np.bool_), np.ones(len(ways), np.bool_)
    for start in range(len(ways)):
        if left[start]:
            size = _reach(either, columns, start, False, part, queue)
            left &= ~part
            if size > most:
                most = size
                best[:] = part
    return best


@compiled
def _open_traps(ways: Bytes, columns: int, inside: NDArray[np.bool_], queue: Ints) -> None:
    root = int(np.argmax(inside))
    onward, homeward = np.empty(len(ways), np.bool_), np.empty(len(ways), np.bool_)
    while True:
        _reach(ways, columns, root, False, onward, queue)
        _reach(ways, columns, root, True, homeward, queue)
        both = onward & homeward
        if np.array_equal(both, inside):
            return
        for node in range(len(ways)):
            if not inside[node]:
                continue
            for way in range(4):
                there = node + (1, columns, -1, -columns)[way]
                if (ways[node] >> way) & 1 and both[node] != both[there]:
                    ways[there] |= np.uint8(1 << ((way + 2) & 3))


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


@compiled
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
    for node in range(size):
        row, column = node // columns, node % columns
        if column == columns - 1:
            ways[node] &= 14
        if row == len(ys) - 1:
            ways[node] &= 13
        if column == 0:
            ways[node] &= 11
        if row == 0:
            ways[node] &= 7
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
    queue = np.empty(size, np.int64)
    inside = _largest_part(ways, columns, queue)
    for node in range(size):
        if not inside[node]:
            ways[node] = 0
    _open_traps(ways, columns, inside, queue)
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


@compiled
def _arc(t: float) -> tuple[float, float, float, float]:
    """Per metre of an arc that turns by ``t``: along, across, and their derivatives by ``t``."""
    if abs(t) < SERIES_RAD:
        u = t * t
        along = 1.0 + u * (A1 + u * (A2 + u * (A3 + u * A4)))
        across = t * (0.5 + u * (B1 + u * (B2 + u * (B3 + u * B4))))
        along_by = t * (C0 + u * (C1 + u * (C2 + u * (C3 + u * C4))))
        across_by = 0.5 + u * (D1 + u * (D2 + u * (D3 + u * D4)))
        return along, across, along_by, across_by
    sine = math.sin(t)
    along, across = sine / t, 2.0 * math.sin(t / 2.0) ** 2 / t
    return along, across, (math.cos(t) - along) / t, (sine - across) / t


@compiled
def _turned(c: float, s: float, t: float) -> tuple[float, float]:
    """Cosine and sine of a heading that has turned by ``t``."""
    along, across, _, _ = _arc(t)
    dc, ds = 1.0 - t * across, t * along
    return c * dc - s * ds, s * dc + c * ds


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
    larger[: len(numbers)] = numbers
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


# -- The drive ------------------------------------------------------------------------------------


@compiled
def drive_rows(n: Numbers, edge: Floats, inner: Floats, seeds: Keys, rows: Floats) -> None:
    """Fill ``rows`` with the result of each seed's drive."""
    none = np.empty((0, TRACED)), np.empty((0, EVENT))
    for i in range(len(seeds)):
        drive_row(n, edge, inner, seeds[i], rows[i], none[0], none[1])


@compiled
def drive_row(
    n: Numbers, edge: Floats, inner: Floats, seed: np.uint64, row: Floats, trace: Floats,
    events: Floats,
) -> None:  # fmt: skip
    """Drive once; ``trace`` and ``events`` are filled as far as they go, none where they are empty.

    Args:
        n: Settings.
        edge: Of ``ziggurat``.
        inner: Likewise.
        seed: Of this drive.
        row: Shape (22,): its ``Result``; with three more, the filter's first x, y, heading follow.
        trace: Shape (S, 16): true x, y, heading, speed; left and right wheel's path as read;
            compass, NaN where none was read; then the filter's x, y, heading and their covariance
            xx, xy, xh, yy, yh, hh.
        events: Shape (E, 6): step, kind, x, y of goal or landmark, x, y that a landmark gave.
    """
    xs, ys, ways, inside, area_km2 = _make_city(_key_of(seed, CITY_KEY), n)
    columns = len(xs)
    row[:] = np.nan
    if not _is_city(ways, columns):
        row[0] = NO_CITY
        return
    # Start, goal, landmarks.
    places = _key_of(seed, PLACE_KEY)
    places_step = _step_of(places)
    start, places = _draw_place(places, places_step, inside)
    way, places = _below(places, places_step, 4)
    while not (ways[start] >> way) & 1:
        way = (way + 1) & 3
    node = start + (1, columns, -1, -columns)[way]
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
    is_visited = np.zeros(max(landmark_count, 1), np.bool_)
    noted = _note(events, 0, 0, GOAL_SET, xs, ys, goal, np.nan, np.nan)
    for i in range(landmark_count):
        noted = _note(events, noted, 0, LANDMARK_SET, xs, ys, landmarks[i], np.nan, np.nan)
    start_x, start_y = xs[start % columns], ys[start // columns]
    goal_x, goal_y = xs[goal % columns], ys[goal // columns]
    row[4] = math.hypot(goal_x - start_x, goal_y - start_y)
    row[5] = abs(goal_x - start_x) + abs(goal_y - start_y)
    row[6], row[7] = area_km2, landmark_count
    # The car, and what it believes at first.
    noise = _key_of(seed, SENSOR_KEY)
    noise_step = _step_of(noise)
    street_c, street_s = COSINES[way], SINES[way]
    node_x, node_y = xs[node % columns], ys[node // columns]
    x = start_x + n.lane_offset_m * street_s
    y = start_y - n.lane_offset_m * street_c
    heading, c, s, speed = HEADINGS_RAD[way], street_c, street_s, n.turn_mps
    off, noise = _normal(noise, noise_step, edge, inner)
    bx = x + n.start_position_sd_m * off
    off, noise = _normal(noise, noise_step, edge, inner)
    by = y + n.start_position_sd_m * off
    off, noise = _normal(noise, noise_step, edge, inner)
    bh = _wrap(heading + n.start_heading_sd_rad * off)
    bc, bs = math.cos(bh), math.sin(bh)
    if len(row) > FIELDS:
        row[FIELDS], row[FIELDS + 1], row[FIELDS + 2] = bx, by, bh
    xx = yy = n.start_position_sd_m**2
    hh = n.start_heading_sd_rad**2
    xy = xh = yh = 0.0
    # Path: no arc under way, no decision taken.
    arc_x, arc_y, arc_h = np.empty(3), np.empty(3), np.empty(3)
    arc_k, arc_length = np.empty(3), np.empty(3)
    arcs = arc = 0
    centre_x = centre_y = radius = side = along_m = entry_m = 0.0
    turn = -1
    # Where it decided before: places with a chain of options each.
    place_x, place_y = np.empty(64), np.empty(64)
    place_first, option_next = np.empty(64, np.int64), np.empty(64, np.int64)
    option_h, option_times = np.empty(64), np.empty(64)
    known = options = 0
    beside_sum = slow_sum = accel = unread_left = unread_right = since_compass = 0.0
    travelled_m = last_fix_m = longest_gap_m = furthest_m = 0.0
    first_goal_m = first_goal_axis_m = goal_error_m = math.nan
    steps = passed = detected = refused = decisions = turns = goals = 0
    # What stays the same at every step.
    step_s, half_track = n.step_s, 0.5 * n.track_width_m
    per_count, per_track = 1.0 / n.encoder_step_m, 1.0 / n.track_width_m
    per_wheelbase, per_step = 1.0 / n.wheelbase_m, 1.0 / n.step_s
    slip_var = n.slip_per_sqrt_m**2
    turn_var_per_m = 2.0 * slip_var / n.track_width_m**2
    compass_var = n.compass_sd_rad**2
    lost_16 = n.lost_above_m**2 / 16.0
    arrive_2 = n.arrive_within_m**2
    has_compass = n.compass_sd_rad >= 0.0
    while True:
        # Truth: how the car lies to its lane.
        if arcs:
            out_x, out_y = x - centre_x, y - centre_y
            apart = math.sqrt(out_x * out_x + out_y * out_y)
            beside = side * (abs(radius) - apart)
            growth = side * (-out_y * s - out_x * c) / apart
            curvature, wanted = 1.0 / radius, n.turn_mps
        else:
            beside = street_c * (y - node_y) - street_s * (x - node_x) + n.lane_offset_m
            growth = street_c * s - street_s * c
            curvature, wanted = 0.0, n.cruise_mps
            if turn > 0:
                room = street_c * (node_x - x) + street_s * (node_y - y) - entry_m
                wanted = n.turn_mps
                if room > 0.0:
                    wanted = min(n.cruise_mps, math.sqrt(n.turn_mps**2 + 2.0 * n.accel_mps2 * room))
        # Controllers.
        slow = wanted - speed
        slow_sum = min(max(slow_sum + slow * step_s, -WINDUP), WINDUP)
        push = n.speed_p * slow + n.speed_i * slow_sum - n.speed_d * accel
        push = min(max(push, -BRAKE_SHARE * n.accel_mps2), n.accel_mps2)
        accel = max(push, (SLOWEST_MPS - speed) * per_step)
        steering = n.wheelbase_m * curvature - n.steering_p * beside
        steering -= n.steering_i * beside_sum + n.steering_d * growth
        steering = min(max(steering, -STEERING_LIMIT_RAD), STEERING_LIMIT_RAD)
        # Bicycle model (eq. 5 and 6).
        distance = speed * step_s + 0.5 * accel * step_s**2
        turned = distance * steering * per_wheelbase
        along, across, _, _ = _arc(turned)
        x += distance * (c * along - s * across)
        y += distance * (s * along + c * across)
        dc, ds = 1.0 - turned * across, turned * along
        c, s = c * dc - s * ds, s * dc + c * ds
        heading = _wrap(heading + turned)
        speed += accel * step_s
        travelled_m += distance
        beside_sum = min(max(beside_sum + beside * distance, -WINDUP), WINDUP)
        if arcs:
            along_m += distance / (1.0 - beside * curvature)
        # Wheels, with slip, as their encoders tell.
        half = half_track * turned
        path = distance - half
        off, noise = _normal(noise, noise_step, edge, inner)
        unread_left += path + n.slip_per_sqrt_m * math.sqrt(abs(path)) * off
        left = np.floor(unread_left * per_count + 0.5) * n.encoder_step_m
        unread_left -= left
        path = distance + half
        off, noise = _normal(noise, noise_step, edge, inner)
        unread_right += path + n.slip_per_sqrt_m * math.sqrt(abs(path)) * off
        right = np.floor(unread_right * per_count + 0.5) * n.encoder_step_m
        unread_right -= right
        # Estimate: along the arc that odometry tells.
        gone, bend = 0.5 * (left + right), (right - left) * per_track
        gone_var, bend_var = 0.5 * slip_var * abs(gone), turn_var_per_m * abs(gone)
        along, across, along_by, across_by = _arc(bend)
        fx, fy = bc * along - bs * across, bs * along + bc * across
        tx = gone * (bc * along_by - bs * across_by)
        ty = gone * (bs * along_by + bc * across_by)
        mx, my = gone * fx, gone * fy
        bx, by, bh = bx + mx, by + my, _wrap(bh + bend)
        dc, ds = 1.0 - bend * across, bend * along
        bc, bs = bc * dc - bs * ds, bs * dc + bc * ds
        xx += my * (my * hh - 2.0 * xh) + fx * fx * gone_var + tx * tx * bend_var
        xy += mx * xh - my * yh - mx * my * hh + fx * fy * gone_var + tx * ty * bend_var
        yy += mx * (mx * hh + 2.0 * yh) + fy * fy * gone_var + ty * ty * bend_var
        xh += tx * bend_var - my * hh
        yh += ty * bend_var + mx * hh
        hh += bend_var
        steps += 1
        compass = np.nan
        if has_compass:
            since_compass += abs(gone)
            if since_compass >= n.compass_interval_m:
                since_compass -= n.compass_interval_m
                off, noise = _normal(noise, noise_step, edge, inner)
                compass = _wrap(heading + n.compass_sd_rad * off)
                innovation = _wrap(compass - bh)
                per = 1.0 / (hh + compass_var)
                kx, ky, kh = xh * per, yh * per, hh * per
                shift = kh * innovation
                bx, by = bx + kx * innovation, by + ky * innovation
                bh = _wrap(bh + shift)
                bc, bs = _turned(bc, bs, shift)
                xx -= kx * xh
                xy -= kx * yh
                yy -= ky * yh
                keep = compass_var * per
                xh, yh, hh = xh * keep, yh * keep, hh * keep
        if steps <= len(trace):
            kept = trace[steps - 1]
            kept[0], kept[1], kept[2], kept[3] = x, y, heading, speed
            kept[4], kept[5], kept[6] = left, right, compass
            kept[7], kept[8], kept[9] = bx, by, bh
            kept[10], kept[11], kept[12], kept[13], kept[14], kept[15] = xx, xy, xh, yy, yh, hh
        # How does it end? Ellipse's full major axis = 4 sqrt(half sum + radius).
        half_sum, half_gap = 0.5 * (xx + yy), 0.5 * (xx - yy)
        room = lost_16 - half_sum
        if room < 0.0 or half_gap * half_gap + xy * xy > room * room:
            outcome = LOST
            break
        away_2 = (bx - goal_x) ** 2 + (by - goal_y) ** 2
        if away_2 <= max(arrive_2, 8.0 * half_sum):
            within_2 = 4.0 * (half_sum + math.sqrt(half_gap * half_gap + xy * xy))
            if away_2 <= max(arrive_2, within_2):
                goals += 1
                goal_error_m = math.hypot(x - goal_x, y - goal_y)
                furthest_m = max(furthest_m, math.hypot(goal_x - start_x, goal_y - start_y))
                if goals == 1:
                    first_goal_m, first_goal_axis_m = travelled_m, 2.0 * math.sqrt(within_2)
                if goals == n.goals:
                    outcome = REACHED
                    break
                goal, places = _draw_goal(
                    places, places_step, xs, ys, inside, node, n.goal_at_least_m
                )
                goal_x, goal_y = xs[goal % columns], ys[goal // columns]
                noted = _note(events, noted, steps, GOAL_SET, xs, ys, goal, np.nan, np.nan)
                if n.landmark_per_goal:
                    if landmark_count:
                        landmark_at[landmarks[0]] = -1
                    share, places = _uniform(places, places_step)
                    landmark_count = 1 if share < n.landmarks_per_km2 * area_km2 else 0
                    if landmark_count:
                        landmarks[0], places = _draw_place(places, places_step, inside)
                        landmark_at[landmarks[0]] = 0
                        is_visited[0] = False
                        noted = _note(
                            events, noted, steps, LANDMARK_SET, xs, ys, landmarks[0], np.nan, np.nan
                        )
        if travelled_m > n.longest_m or steps * step_s > n.longest_s:
            outcome = GIVEN_UP
            break
        # Path.
        if arcs:
            if along_m < arc_length[arc]:
                continue
            along_m -= arc_length[arc]
            arc += 1
            if arc == arcs:
                arcs, along_m = 0, 0.0
                continue
        else:
            remaining = street_c * (node_x - x) + street_s * (node_y - y)
            if turn < 0 and remaining <= n.decide_at_m:
                c, s = math.cos(heading), math.sin(heading)
                bc, bs = math.cos(bh), math.sin(bh)
                at_x, at_y = bx + remaining * bc, by + remaining * bs
                # Goal, or the landmark sought on the way to it.
                target_x, target_y = goal_x, goal_y
                axis_4 = half_sum + math.sqrt(half_gap * half_gap + xy * xy)
                seeks = n.strategy == LANDMARKS or (
                    n.strategy == HYBRID and 4.0 * math.sqrt(axis_4) > n.hybrid_above_m
                )
                while seeks:
                    found = _landmark_ahead(
                        at_x, at_y, goal_x, goal_y, xs, ys, landmarks, landmark_count, is_visited
                    )
                    if found < 0:
                        break
                    lx, ly = xs[landmarks[found] % columns], ys[landmarks[found] // columns]
                    if (lx - at_x) ** 2 + (ly - at_y) ** 2 > max(arrive_2, 4.0 * axis_4):
                        target_x, target_y = lx, ly
                        break
                    is_visited[found] = True
                # Eq. 4.
                place = _recognised(place_x, place_y, known, at_x, at_y, n.recognise_within_m)
                turn, least, chosen_h = 2, np.inf, _wrap(bh + QUARTER_TURNS[2])
                for quarter in (0, 1, 3):
                    if not (ways[node] >> ((way + quarter) & 3)) & 1:
                        continue
                    after = _wrap(bh + QUARTER_TURNS[quarter])
                    bearing = math.atan2(
                        target_y - (at_y + n.after_m * math.sin(after)),
                        target_x - (at_x + n.after_m * math.cos(after)),
                    )
                    cost = abs(_wrap(after - bearing))
                    if place >= 0:
                        option = _option(
                            place, place_first, option_next, option_h, after, n.same_option_rad
                        )
                        if option >= 0:
                            cost += n.penalty_rad * option_times[option]
                    if cost < least:
                        turn, least, chosen_h = quarter, cost, after
                # Remember.
                if place < 0:
                    if known == len(place_x):
                        place_x, place_y = _doubled(place_x), _doubled(place_y)
                        place_first = _doubled(place_first)
                    place, place_x[known], place_y[known] = known, at_x, at_y
                    place_first[known] = -1
                    known += 1
                option = _option(
                    place, place_first, option_next, option_h, chosen_h, n.same_option_rad
                )
                if option < 0:
                    if options == len(option_h):
                        option_h, option_times = _doubled(option_h), _doubled(option_times)
                        option_next = _doubled(option_next)
                    option_h[options], option_times[options] = chosen_h, 1.0
                    # New ones last: of options equally near, the first remembered counts.
                    option_next[options] = -1
                    if place_first[place] < 0:
                        place_first[place] = options
                    else:
                        last = place_first[place]
                        while option_next[last] >= 0:
                            last = option_next[last]
                        option_next[last] = options
                    options += 1
                else:
                    option_times[option] += 1.0
                decisions += 1
                turns += turn != 0
                entry_m = 0.0
                if turn == 1:
                    entry_m = n.left_radius_m - n.lane_offset_m
                elif turn == 3:
                    entry_m = n.right_radius_m + n.lane_offset_m
            if turn < 0 or remaining > entry_m:
                continue
            # Enter the intersection; perhaps a landmark is recognised there.
            if landmark_at[node] >= 0:
                passed += 1
                share, noise = _uniform(noise, noise_step)
                if share >= n.detection_rate:
                    noted = _note(
                        events, noted, steps, LANDMARK_MISSED, xs, ys, node, np.nan, np.nan
                    )
                else:
                    off, noise = _normal(noise, noise_step, edge, inner)
                    seen_x = x + n.landmark_sd_m * off
                    off, noise = _normal(noise, noise_step, edge, inner)
                    seen_y = y + n.landmark_sd_m * off
                    ix, iy = seen_x - bx, seen_y - by
                    is_visited[landmark_at[node]] = True
                    sxx, syy = xx + n.landmark_sd_m**2, yy + n.landmark_sd_m**2
                    per = 1.0 / (sxx * syy - xy * xy)
                    wx, wy = (syy * ix - xy * iy) * per, (sxx * iy - xy * ix) * per
                    if ix * wx + iy * wy > n.landmark_gate_nis:
                        refused += 1
                        noted = _note(
                            events, noted, steps, LANDMARK_REFUSED, xs, ys, node, seen_x, seen_y
                        )
                    else:
                        detected += 1
                        noted = _note(
                            events, noted, steps, LANDMARK_TAKEN, xs, ys, node, seen_x, seen_y
                        )
                        longest_gap_m = max(longest_gap_m, travelled_m - last_fix_m)
                        last_fix_m = travelled_m
                        bx, by = bx + xx * wx + xy * wy, by + xy * wx + yy * wy
                        bh = _wrap(bh + xh * wx + yh * wy)
                        bc, bs = math.cos(bh), math.sin(bh)
                        # P - P H' S^-1 H P, entry by entry.
                        axx, axy = (syy * xx - xy * xy) * per, (sxx * xy - xy * xx) * per
                        ayx, ayy = (syy * xy - xy * yy) * per, (sxx * yy - xy * xy) * per
                        ahx, ahy = (syy * xh - xy * yh) * per, (sxx * yh - xy * xh) * per
                        xx, xy, xh, yy, yh, hh = (
                            xx - axx * xx - axy * xy, xy - axx * xy - axy * yy,
                            xh - axx * xh - axy * yh, yy - ayx * xy - ayy * yy,
                            yh - ayx * xh - ayy * yh, hh - ahx * xh - ahy * yh,
                        )  # fmt: skip
            arc, arcs, along_m = 0, 0, 0.0
            if turn:
                at_x = node_x - street_c * entry_m + street_s * n.lane_offset_m
                at_y = node_y - street_s * entry_m - street_c * n.lane_offset_m
                at_h = HEADINGS_RAD[way]
                if turn == 2:
                    # Out of the lane to the right, round to the left, and into the lane back.
                    swing = math.acos(
                        (n.lane_offset_m + n.right_radius_m) / (2.0 * n.right_radius_m)
                    )
                    for i in range(3):
                        arc_k[i] = (1.0 if i == 1 else -1.0) / n.right_radius_m
                        angle = PI + 2.0 * swing if i == 1 else swing
                        arc_x[i], arc_y[i], arc_h[i] = at_x, at_y, at_h
                        arc_length[i] = n.right_radius_m * angle
                        bent = angle if i == 1 else -angle
                        along, across, _, _ = _arc(bent)
                        dx, dy = arc_length[i] * along, arc_length[i] * across
                        at_c, at_s = math.cos(at_h), math.sin(at_h)
                        at_x, at_y = at_x + at_c * dx - at_s * dy, at_y + at_s * dx + at_c * dy
                        at_h += bent
                    arcs = 3
                else:
                    arc_k[0] = 1.0 / n.left_radius_m if turn == 1 else -1.0 / n.right_radius_m
                    arc_x[0], arc_y[0], arc_h[0] = at_x, at_y, at_h
                    arc_length[0] = abs(1.0 / arc_k[0]) * PI / 2.0
                    arcs = 1
            way = (way + turn) & 3
            node += (1, columns, -1, -columns)[way]
            turn = -1
            street_c, street_s = COSINES[way], SINES[way]
            node_x, node_y = xs[node % columns], ys[node // columns]
            if not arcs:
                continue
        radius = 1.0 / arc_k[arc]
        side = 1.0 if radius > 0.0 else -1.0
        centre_x = arc_x[arc] - radius * math.sin(arc_h[arc])
        centre_y = arc_y[arc] + radius * math.cos(arc_h[arc])
    ex, ey, eh = bx - x, by - y, _wrap(bh - heading)
    row[0], row[1], row[2], row[3] = outcome, travelled_m, steps * step_s, steps
    row[8], row[9], row[10], row[11], row[12] = passed, detected, refused, decisions, turns
    row[13], row[14], row[15] = goals, first_goal_m, first_goal_axis_m
    row[16] = 4.0 * math.sqrt(half_sum + math.sqrt(half_gap * half_gap + xy * xy))
    row[17], row[18] = math.hypot(ex, ey), _nees(ex, ey, eh, xx, xy, xh, yy, yh, hh)
    row[19], row[20] = goal_error_m, furthest_m
    row[21] = max(longest_gap_m, travelled_m - last_fix_m)
