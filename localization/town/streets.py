"""Generate random gridded cities, with blocks of many sizes, dead ends and one-way streets.

An intersection is a crossing of a street along x with one along y, numbered row by row. Directions
are 0 east, 1 north, 2 west, 3 south; the bits of one byte are the directions in which an
intersection can be left. One-way streets that would trap a car are opened in both directions, so
that every intersection of the city can be reached from every other one.
"""

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.columns import Floats, Int64s

from .random_stream import RandomStream, below, uniform
from .settings import Parameters

HEADINGS_RAD: Final = (0.0, math.pi / 2.0, math.pi, -math.pi / 2.0)
COSINES: Final = tuple(math.cos(heading) for heading in HEADINGS_RAD)
SINES: Final = tuple(math.sin(heading) for heading in HEADINGS_RAD)
MAX_TRIES: Final = 1000
# Kinds of connection: from a place along roads, to it along roads, and in either direction.
ONWARD, HOMEWARD, EITHER = 1, 2, 4
_BOTH: Final = ONWARD | HOMEWARD
_ALL: Final = ONWARD | HOMEWARD | EITHER


class Streets(NamedTuple):
    """Streets of a city, and its largest connected part.

    Attributes:
        xs_m: Shape (X,), increasing: x of the streets along y.
        ys_m: Shape (Y,), increasing: y of the streets along x.
        ways: Shape (X * Y,), uint8: bit d is set if an intersection can be left in direction d.
        inside: Shape (X * Y,): True for intersections of the largest connected part.
        area_km2: Requested area; the grid ends within a block of it.
    """

    xs_m: Floats
    ys_m: Floats
    ways: NDArray[np.uint8]
    inside: NDArray[np.bool_]
    area_km2: float


def step_of(way: int, columns: int) -> int:
    """Difference of the numbers of an intersection's neighbour in a direction and its own."""
    return (1, columns, -1, -columns)[way]


def has_way(ways: NDArray[np.uint8], node: int, way: int) -> bool:
    """Whether intersection ``node`` can be left in a direction."""
    return (int(ways[node]) >> way) & 1 == 1


def node_position(streets: Streets, node: int) -> tuple[float, float]:
    """Position of an intersection in metres."""
    columns = len(streets.xs_m)
    return streets.xs_m[node % columns], streets.ys_m[node // columns]


def make_streets(stream: RandomStream, p: Parameters) -> Streets:
    """Generate a random city; the same stream and settings yield the same one."""
    number, stream = uniform(stream)
    area_km2 = p.min_km2 + (p.max_km2 - p.min_km2) * number
    side_m = 1000.0 * math.sqrt(area_km2)
    xs, stream = _coordinates(stream, side_m, p)
    ys, stream = _coordinates(stream, side_m, p)
    columns, size = len(xs), len(xs) * len(ys)
    ways = _all_ways(columns, size)
    for _ in range(int(p.dead_end_fraction * size)):
        node, stream = below(stream, size)
        way, stream = below(stream, 4)
        _make_dead_end(ways, columns, node, way)
    for _ in range(int(p.one_way_fraction * 2 * size)):
        node, stream = below(stream, size)
        way, stream = below(stream, 4)
        if has_way(ways, node, way):
            _close(ways, node + step_of(way, columns), (way + 2) & 3)
    gates = _gates_of(ways, columns)
    reach = _largest_part(gates, columns)
    inside = reach != 0
    # Intersections outside the connected part cannot be reached, so their streets are removed.
    for node in range(size):
        if not inside[node]:
            ways[node] = 0
    _open_traps(ways, columns, reach, gates)
    return Streets(xs, ys, ways, inside, area_km2)


def _coordinates(stream: RandomStream, side_m: float, p: Parameters) -> tuple[Floats, RandomStream]:
    span = p.max_block_m - p.min_block_m
    places = np.empty(3 + int(side_m / p.min_block_m))
    places[0], count = 0.0, 1
    while True:
        number, stream = uniform(stream)
        there = places[count - 1] + p.min_block_m + span * number
        if there > side_m and count > 1:
            return places[:count].copy(), stream
        places[count] = there
        count += 1


def _all_ways(columns: int, size: int) -> NDArray[np.uint8]:
    ways = np.full(size, 15, np.uint8)
    for node in range(0, size, columns):
        _close(ways, node, 2)
        _close(ways, node + columns - 1, 0)
    for column in range(columns):
        _close(ways, column, 3)
        _close(ways, size - columns + column, 1)
    return ways


def _close(ways: NDArray[np.uint8], node: int, way: int) -> None:
    ways[node] = np.uint8(int(ways[node]) & (15 - (1 << way)))


def _open(ways: NDArray[np.uint8], node: int, way: int) -> None:
    ways[node] = np.uint8(int(ways[node]) | (1 << way))


def _make_dead_end(ways: NDArray[np.uint8], columns: int, node: int, keep: int) -> None:
    """Close all streets of an intersection but one: the first existing one from ``keep`` on."""
    kept = False
    for turn in range(4):
        way = (keep + turn) & 3
        if not has_way(ways, node, way):
            continue
        if kept:
            _close(ways, node, way)
            _close(ways, node + step_of(way, columns), (way + 2) & 3)
        kept = True


def _gates_of(ways: NDArray[np.uint8], columns: int) -> NDArray[np.uint8]:
    """Kinds of connection that each place gets from each of its four neighbours, shape (4, N)."""
    size = len(ways)
    gates = np.zeros((4, size), np.uint8)
    for way, apart in ((0, 1), (1, columns)):
        for i in range(size - apart):
            there = int(has_way(ways, i, way))
            back = int(has_way(ways, i + apart, way + 2))
            either = (there | back) << 2
            gates[way, i] = back | there << 1 | either
            gates[way + 2, i + apart] = there | back << 1 | either
    return gates


def _spread(reach: NDArray[np.uint8], gates: NDArray[np.uint8], columns: int) -> None:
    """Propagate connections through the gates, sweep by sweep, until nothing changes.

    Few sweeps suffice because cities are mostly open; each is one pass over all places.
    """
    size, grows = len(reach), True
    while grows:
        grows = False
        for i in range(size):
            _reach_from(reach, gates, i, i - columns, 3)
            _reach_from(reach, gates, i, i - 1, 2)
        for i in range(size - 1, -1, -1):
            grows |= _reach_from(reach, gates, i, i + columns, 1)
            grows |= _reach_from(reach, gates, i, i + 1, 0)


def _reach_from(
    reach: NDArray[np.uint8], gates: NDArray[np.uint8], node: int, neighbour: int, way: int
) -> bool:
    """Propagate from a place's neighbour in direction ``way``; return True if anything changes."""
    if neighbour < 0 or neighbour >= len(reach):
        return False
    before = reach[node]
    reach[node] = before | (reach[neighbour] & gates[way, node])
    return bool(reach[node] != before)


def _largest_part(gates: NDArray[np.uint8], columns: int) -> NDArray[np.uint8]:
    """Connections of each place to the first place of the largest part."""
    size = gates.shape[1]
    best, seen = np.zeros(size, np.uint8), np.zeros(size, np.bool_)
    largest, left = 0, size
    for start in range(size):
        if seen[start]:
            continue
        reach = np.zeros(size, np.uint8)
        reach[start] = _ALL
        _spread(reach, gates, columns)
        count = 0
        for node in range(size):
            if reach[node] != 0:
                seen[node] = True
                count += 1
        if count > largest:
            largest, best = count, reach
        left -= count
        if left <= largest:
            break
    return best


def _open_traps(
    ways: NDArray[np.uint8], columns: int, reach: NDArray[np.uint8], gates: NDArray[np.uint8]
) -> None:
    """Open one-way streets in both directions where they lead into or out of a trap."""
    opened = True
    while opened:
        opened = False
        for node in range(len(ways)):
            if int(reach[node]) & _BOTH == _BOTH or reach[node] == 0:
                continue
            for way in range(4):
                there, back = node + step_of(way, columns), (way + 2) & 3
                if gates[way, node] == 0 or int(reach[there]) & _BOTH != _BOTH:
                    continue
                _open(ways, node, way)
                _open(ways, there, back)
                gates[way, node] = gates[back, there] = _ALL
                opened = True
        if opened:
            _spread(reach, gates, columns)


def has_intersection(streets: Streets) -> bool:
    """Whether a city has a place where at least three roads meet."""
    ways, columns = streets.ways, len(streets.xs_m)
    comes = np.zeros(len(ways), np.int64)
    for node in range(len(ways)):
        out = 0
        for way in range(4):
            if has_way(ways, node, way):
                out += 1
                there = node + step_of(way, columns)
                comes[there] += 1
                if comes[there] == 3:
                    return True
        if out > 2:
            return True
    return False


def draw_place(stream: RandomStream, inside: NDArray[np.bool_]) -> tuple[int, RandomStream]:
    """Draw a random intersection of the connected part."""
    while True:
        node, stream = below(stream, len(inside))
        if inside[node]:
            return node, stream


def draw_goal(
    stream: RandomStream, streets: Streets, start: int, min_m: float
) -> tuple[int, RandomStream]:
    """Draw an intersection at least ``min_m`` from ``start``; after many tries, the last one."""
    x, y = node_position(streets, start)
    goal = start
    for _ in range(MAX_TRIES):
        goal, stream = draw_place(stream, streets.inside)
        there_x, there_y = node_position(streets, goal)
        if goal != start and (there_x - x) ** 2 + (there_y - y) ** 2 >= min_m**2:
            break
    return goal, stream


def draw_landmarks(
    stream: RandomStream, streets: Streets, per_km2: float
) -> tuple[Int64s, RandomStream]:
    """Draw distinct intersections with a landmark, in random order."""
    number, stream = uniform(stream)
    wanted = min(int(per_km2 * streets.area_km2 + number), streets.inside.sum())
    has = np.zeros(len(streets.ways), np.bool_)
    found = np.empty(wanted, np.int64)
    for i in range(wanted):
        node, stream = draw_place(stream, streets.inside)
        while has[node]:
            node, stream = draw_place(stream, streets.inside)
        has[node], found[i] = True, node
    return found, stream
