"""Lanes of a map as a graph of roads: those that cross, or turn off, are inside an intersection."""

from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np

from crosscue.replay.columns import Floats

from .road_map import SIDE_RAD, Control, Road, RoadMap

# Longest turn from one road into another.
TURN_M: Final = 50.0
# Lanes that cross at another height do not meet.
BRIDGE_M: Final = 3.0
# Most steps along a piece of a lane, whatever length a file states, and most points of a map.
MAX_STEPS: Final = 500
MAX_POINTS: Final = 1_000_000


class Lane(NamedTuple):
    """A lane in a local frame.

    Attributes:
        ends: Keys of its first and last point; a lane's first is the last of the lane before it.
        middle_m: Its middle line, shape (N, 2).
        width_m: Its mean width.
        height_m: Its mean height.
    """

    ends: tuple[str, str]
    middle_m: Floats
    width_m: float
    height_m: float = 0.0


def lane_graph(
    lanes: Mapping[str, Lane],
    controls: Mapping[str, tuple[Control, float | None]],
    *,
    two_way: Collection[str] = (),
    turns: Collection[str] = (),
) -> RoadMap:
    """Connect lanes.

    Args:
        lanes: Lanes by key; two with the same ends, in opposite directions, are one road.
        controls: Control at an end, with the heading that it is for.
        two_way: Keys of lanes that may be driven in both directions.
        turns: Keys of lanes that the map says are inside an intersection.
    """
    points_m: dict[str, Floats] = {}
    roads: dict[tuple[str, str], Road] = {}
    for key, lane in lanes.items():
        names = [f"{key}:{row}" for row in range(len(lane.middle_m))]
        names[0], names[-1] = lane.ends
        points_m |= zip(names, lane.middle_m, strict=True)
        opposite = roads.get((lane.ends[1], lane.ends[0]))
        if opposite is not None:
            roads[lane.ends[1], lane.ends[0]] = replace(opposite, is_one_way=False)
        else:
            roads[lane.ends] = Road(tuple(names), lane.width_m, key not in two_way)
    count = Counter(at for lane in lanes.values() for at in lane.ends)
    inside = [
        (lane,)
        for key, lane in lanes.items()
        if key in turns or (max(count[at] for at in lane.ends) > 2 and _turns(lane))
    ]
    # A lane that nothing continues may be a crossing for people, drawn as a road.
    linked = [lane for lane in lanes.values() if any(count[at] > 1 for at in lane.ends)]
    met = [
        [at for lane in some for at in _nodes(roads, *lane.ends)]
        for some in (*inside, *_crossings(linked))
    ]
    return RoadMap(points_m, list(roads.values()), controls, met, min_leg_m=0.0)


def step_count(length_m: float, step_m: float) -> int:
    """Return how many steps of ``step_m``, or of more if it is long, a piece of a lane has."""
    return int(min(max(length_m / step_m, 1.0), MAX_STEPS))


def _nodes(roads: Mapping[tuple[str, str], Road], a: str, b: str) -> tuple[str, ...]:
    return (roads.get((a, b)) or roads[b, a]).nodes


def _turns(lane: Lane) -> bool:
    """Whether a lane is as short as one inside an intersection, and leads left or right."""
    ways = np.diff(lane.middle_m, axis=0)
    (x0, y0), (x1, y1) = ways[0], ways[-1]
    turn_rad = abs(np.arctan2(x0 * y1 - y0 * x1, x0 * x1 + y0 * y1))
    return bool(turn_rad > SIDE_RAD and np.hypot(*ways.T).sum() < TURN_M)


def _crossings(lanes: Sequence[Lane]) -> Iterator[tuple[Lane, Lane]]:
    """Yield pairs of lanes whose middles cross and that have no common end."""
    low = np.array([one.middle_m.min(axis=0) for one in lanes])
    high = np.array([one.middle_m.max(axis=0) for one in lanes])
    for row, one in enumerate(lanes):
        near = ((low[row + 1 :] <= high[row]) & (high[row + 1 :] >= low[row])).all(axis=1)
        for other in (lanes[row + 1 + at] for at in np.flatnonzero(near).tolist()):
            apart = {*one.ends}.isdisjoint(other.ends)
            if (
                apart
                and abs(one.height_m - other.height_m) < BRIDGE_M
                and cross(one.middle_m, other.middle_m)
            ):
                yield one, other


def cross(one_m: Floats, other_m: Floats) -> bool:
    """Return whether two lines, shape (N, 2) each, cross."""
    a, b = one_m[:, None], other_m[None]
    ways_a, ways_b = np.diff(a, axis=0), np.diff(b, axis=1)

    def side(way: Floats, off: Floats) -> Floats:
        return np.sign(way[..., 0] * off[..., 1] - way[..., 1] * off[..., 0])

    of_b = side(ways_a, b - a[:-1])
    of_a = side(ways_b, a - b[:, :-1])
    return bool(((of_b[:, :-1] * of_b[:, 1:] < 0) & (of_a[:-1] * of_a[1:] < 0)).any())
