"""Random gridded cities: blocks of many sizes, dead ends, one-way streets, always drivable.

An intersection is a crossing of a street along x with one along y. Directions are 0 east, 1 north,
2 west, 3 south. Streets that would let a car in and never out again are opened both ways, so that
from any intersection of the city every other one can be reached.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.columns import Floats

from . import settings as drive_settings
from .random_stream import Stream

EAST: Final = 0
NORTH: Final = 1
WEST: Final = 2
SOUTH: Final = 3
HEADINGS_RAD: Final = (0.0, math.pi / 2.0, math.pi, -math.pi / 2.0)
DIRECTIONS: Final = ((1, 0), (0, 1), (-1, 0), (0, -1))
TRIES: Final = 1000

Ways = NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class City:
    """A grid of streets.

    Attributes:
        xs_m: Shape (X,), increasing: the streets along y.
        ys_m: Shape (Y,), increasing: the streets along x.
        ways: Shape (X * Y, 4): may one leave intersection ``row * X + column`` in this direction?
        area_km2: As asked for; the grid ends within a block of it.
    """

    xs_m: Floats
    ys_m: Floats
    ways: Ways
    area_km2: float

    def __post_init__(self) -> None:
        """Refuse what is no city.

        Raises:
            ValueError: Shapes, no intersection, a way out of the grid, or one-way streets that
                contradict each other, so that a car can come but not go.
        """
        n = len(self.xs_m) * len(self.ys_m)
        if self.ways.shape != (n, 4):
            raise ValueError(f"ways: want ({n}, 4), got {self.ways.shape}")
        if (np.diff(self.xs_m) <= 0.0).any() or (np.diff(self.ys_m) <= 0.0).any():
            raise ValueError("streets: want increasing coordinates")
        roads = self.ways.sum(axis=1)
        comes = np.zeros(n, int)
        for node in range(n):
            for way in np.flatnonzero(self.ways[node]):
                comes[self.neighbour(node, int(way))] += 1
        if n == 0 or max(roads.max(), comes.max()) < 3:
            raise ValueError("city: no intersection, want at least one where three roads meet")
        if (stuck := np.flatnonzero((comes > 0) & (roads == 0))).size:
            x, y = self.place(int(stuck[0]))
            raise ValueError(
                f"one-way streets contradict each other at ({x:.0f} m, {y:.0f} m): "
                f"{comes[stuck[0]]} lead in, none out; open one both ways"
            )

    def __len__(self) -> int:
        return len(self.ways)

    def place(self, node: int) -> tuple[float, float]:
        """Where an intersection is."""
        row, column = divmod(node, len(self.xs_m))
        return float(self.xs_m[column]), float(self.ys_m[row])

    def neighbour(self, node: int, way: int) -> int:
        """The next intersection in a direction.

        Raises:
            ValueError: The grid ends there.
        """
        row, column = divmod(node, len(self.xs_m))
        column, row = column + DIRECTIONS[way][0], row + DIRECTIONS[way][1]
        if not (0 <= column < len(self.xs_m) and 0 <= row < len(self.ys_m)):
            raise ValueError(f"intersection {node}: direction {way} leads out of the grid")
        return row * len(self.xs_m) + column

    def options(self, node: int, way: int) -> tuple[int, ...]:
        """Ways on after coming in direction ``way``: straight, left, right; else back.

        Raises:
            ValueError: There is no way out.
        """
        found = tuple(
            out for turn in (0, 1, 3) if self.ways[node, out := (way + turn) % 4]
        ) or tuple(out for out in ((way + 2) % 4,) if self.ways[node, out])
        if not found:
            raise ValueError(f"intersection {node}: no way out")
        return found


def reachable(ways: Ways, columns: int, start: int, *, backward: bool = False) -> Ways:
    """Shape (N,): intersections that can be driven to from ``start``, or from which it can be."""
    seen = np.zeros(len(ways), bool)
    seen[start] = True
    queue = deque([start])
    steps = (1, columns, -1, -columns)
    while queue:
        node = queue.popleft()
        for way, step in enumerate(steps):
            there = node + step
            if not 0 <= there < len(ways) or seen[there]:
                continue
            if ways[there, (way + 2) % 4] if backward else ways[node, way]:
                seen[there] = True
                queue.append(there)
    return seen


def find_route(city: City, start: int, goal: int) -> list[int] | None:
    """Intersections of a shortest route in blocks that respects one-way streets, or None."""
    came: dict[int, int] = {start: start}
    queue = deque([start])
    while queue and goal not in came:
        node = queue.popleft()
        for way in np.flatnonzero(city.ways[node]):
            there = city.neighbour(node, int(way))
            if there not in came:
                came[there] = node
                queue.append(there)
    if goal not in came:
        return None
    route = [goal]
    while route[-1] != start:
        route.append(came[route[-1]])
    return route[::-1]


def check_drivable(city: City, start: int, goal: int) -> None:
    """Make sure that a car which drives anywhere from ``start`` can still reach ``goal``.

    Raises:
        ValueError: It cannot; the place is named.
    """
    columns = len(city.xs_m)
    onward = reachable(city.ways, columns, start)
    homeward = reachable(city.ways, columns, goal, backward=True)
    x, y = city.place(goal)
    if not onward[goal]:
        raise ValueError(f"goal ({x:.0f} m, {y:.0f} m): cannot be reached from the start")
    if (trap := np.flatnonzero(onward & ~homeward)).size:
        at_x, at_y = city.place(int(trap[0]))
        raise ValueError(
            f"one-way streets lead to ({at_x:.0f} m, {at_y:.0f} m) and not on to the goal "
            f"({x:.0f} m, {y:.0f} m); open one both ways"
        )


class Made(NamedTuple):
    """A city with the part of it that is driven in.

    Attributes:
        city: The streets.
        inside: Shape (N,): intersections of the largest connected part.
    """

    city: City
    inside: Ways


def make_city(random: Stream, settings: drive_settings.City) -> Made:
    """A random city; the same stream and settings give the same one."""
    span = settings.largest_km2 - settings.smallest_km2
    area_km2 = settings.smallest_km2 + span * random.uniform()
    side_m = 1000.0 * math.sqrt(area_km2)
    xs, ys = _streets(random, side_m, settings), _streets(random, side_m, settings)
    ways = _all_ways(len(xs), len(ys))
    steps = (1, len(xs), -1, -len(xs))
    for _ in range(int(settings.dead_end_share * len(ways))):
        _make_dead_end(ways, steps, random.below(len(ways)), random.below(4))
    for _ in range(int(settings.one_way_share * 2 * len(ways))):
        node, way = random.below(len(ways)), random.below(4)
        if ways[node, way] and ways[node + steps[way], (way + 2) % 4]:
            ways[node + steps[way], (way + 2) % 4] = False
    inside = _largest_part(ways, len(xs))
    # Nobody can come to what does not hang together with the rest; its streets are no streets.
    ways[~inside] = False
    _open_traps(ways, steps, inside)
    return Made(City(xs, ys, ways, area_km2), inside)


def _streets(random: Stream, side_m: float, settings: drive_settings.City) -> Floats:
    span = settings.longest_block_m - settings.shortest_block_m
    places = [0.0]
    while True:
        there = places[-1] + settings.shortest_block_m + span * random.uniform()
        if there > side_m and len(places) > 1:
            return np.array(places)
        places.append(there)


def _all_ways(columns: int, rows: int) -> Ways:
    ways = np.ones((rows, columns, 4), bool)
    ways[:, -1, EAST] = ways[-1, :, NORTH] = ways[:, 0, WEST] = ways[0, :, SOUTH] = False
    return ways.reshape(-1, 4)


def _make_dead_end(ways: Ways, steps: tuple[int, ...], node: int, keep: int) -> None:
    """Leave one street of an intersection: the first one there is, from ``keep`` on."""
    kept = False
    for way in ((keep + turn) % 4 for turn in range(4)):
        if ways[node, way] and not kept:
            kept = True
        elif ways[node, way]:
            ways[node, way] = ways[node + steps[way], (way + 2) % 4] = False


def _largest_part(ways: Ways, columns: int) -> Ways:
    """Intersections of the largest part that hangs together; of equal ones the first."""
    either = ways.copy()
    for way, step in enumerate((1, columns, -1, -columns)):
        either[np.flatnonzero(ways[:, way]) + step, (way + 2) % 4] = True
    best, left = np.zeros(len(ways), bool), np.ones(len(ways), bool)
    for start in range(len(ways)):
        if left[start]:
            part = reachable(either, columns, start)
            left &= ~part
            best = part if part.sum() > best.sum() else best
    return best


def _open_traps(ways: Ways, steps: tuple[int, ...], inside: Ways) -> None:
    """Open one-way streets both ways where they lead into, or out of, what has no way back."""
    root = int(np.argmax(inside))
    while True:
        both = reachable(ways, steps[1], root) & reachable(ways, steps[1], root, backward=True)
        if (both == inside).all():
            return
        for node in np.flatnonzero(inside):
            for way in np.flatnonzero(ways[node]):
                there = node + steps[way]
                if both[node] != both[there]:
                    ways[there, (way + 2) % 4] = True


def draw_place(random: Stream, made: Made) -> int:
    """A random intersection of the part driven in."""
    while True:
        node = random.below(len(made.city))
        if made.inside[node]:
            return node


def draw_goal(random: Stream, made: Made, start: int, at_least_m: float) -> int:
    """A random intersection at least so far from ``start``; the last one drawn after many tries."""
    x, y = made.city.place(start)
    goal = start
    for _ in range(TRIES):
        goal = draw_place(random, made)
        there_x, there_y = made.city.place(goal)
        if goal != start and (there_x - x) ** 2 + (there_y - y) ** 2 >= at_least_m**2:
            break
    return goal


def draw_landmarks(random: Stream, made: Made, per_km2: float) -> NDArray[np.int64]:
    """Intersections with a landmark, all different, in the order drawn."""
    wanted = math.floor(per_km2 * made.city.area_km2 + random.uniform())
    wanted = min(wanted, int(made.inside.sum()))
    has = np.zeros(len(made.city), bool)
    found = np.empty(wanted, np.int64)
    for i in range(wanted):
        node = draw_place(random, made)
        while has[node]:
            node = draw_place(random, made)
        has[node], found[i] = True, node
    return found
