"""Roads of a map, their junctions, and what a vehicle that follows them comes to next."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final, Literal, NamedTuple

import numpy as np

from crosscue.replay.columns import Floats, Int64s

Control = Literal["stop_sign", "traffic_light"]
Side = Literal["left", "right", "straight", "back"]

# Junctions of a map that are closer along a road belong to one intersection: dual carriageways
# and staggered arms have several.
SAME_M: Final = 25.0
# A leg's direction is that of its first part; a shorter dead end is no leg.
LEG_M: Final = 20.0
MIN_LEG_M: Final = 8.0
# Turn from which on a leg leads left or right, and from which on it leads back.
SIDE_RAD: Final = np.radians(40.0)
BACK_RAD: Final = np.radians(155.0)
# Angle from which on a lane inside an intersection crosses a way, and does not join it.
CROSS_RAD: Final = np.radians(60.0)
# A side road's kerbs are prolonged by at most so much to the way straight on.
LEG_REACH_M: Final = 15.0
# Distance from which on a vehicle approaches an intersection.
REACH_M: Final = 100.0
# A control stands at most so far ahead of its intersection.
CONTROL_M: Final = 30.0
# Farthest position from a road's centre line, and the scales with which a road is chosen.
OFF_M: Final = 20.0
_SCALE_M: Final = 5.0
_SCALE_RAD: Final = np.radians(20.0)
_CHANGE: Final = 1.0


@dataclass(frozen=True, slots=True)
class Road:
    """A drivable way between points.

    Attributes:
        nodes: Keys of its points, in its direction.
        width_m: Width between its kerbs.
        is_one_way: True if it may only be driven in its direction.
    """

    nodes: tuple[str, ...]
    width_m: float
    is_one_way: bool = False


class Leg(NamedTuple):
    """A road that leads away from an intersection."""

    xy_m: Floats
    heading_rad: float
    width_m: float
    is_in: bool
    is_out: bool


@dataclass(frozen=True, slots=True)
class Ahead:
    """The next intersection of a vehicle on a road.

    Attributes:
        junction: Number of the intersection.
        start_m: Distance to the near kerb of its crossroad.
        end_m: Distance to the far kerb.
        heading_rad: Direction of travel at its first point.
        control: Control that the map states for this approach; None if it states none.
    """

    junction: int
    start_m: float
    end_m: float
    heading_rad: float
    control: Control | None


class _Edge(NamedTuple):
    to: str
    width_m: float
    is_out: bool
    is_in: bool


@dataclass(slots=True)
class RoadMap:
    """Roads as a graph in a local frame, x east and y north.

    Args:
        points_m: Position of each point by its key, shape (2,).
        roads: The roads.
        controls: Control at a point, with the heading that it is for; None for every heading.
        inside: Points of each roundabout, and of lanes that cross without a common point.
        min_leg_m: Length from which on a dead end is a leg.
    """

    points_m: Mapping[str, Floats]
    roads: Sequence[Road]
    controls: Mapping[str, tuple[Control, float | None]]
    inside: Sequence[Sequence[str]] = ()
    min_leg_m: float = MIN_LEG_M
    _edges: dict[str, list[_Edge]] = field(init=False, default_factory=dict)
    _junction: dict[str, int] = field(init=False, default_factory=dict)
    _legs: dict[int, tuple[Leg, ...]] = field(init=False, default_factory=dict)
    _kerbs: dict[tuple[str, str], tuple[float, float] | None] = field(
        init=False, default_factory=dict
    )

    def __post_init__(self) -> None:
        """Connect the roads, and find the junctions."""
        for road in self.roads:
            for a, b in zip(road.nodes, road.nodes[1:], strict=False):
                if a == b:
                    continue
                two_way = not road.is_one_way
                one = _Edge(b, road.width_m, True, two_way)
                self._edges.setdefault(a, []).append(one)
                back = one._replace(to=a, is_out=two_way, is_in=True)
                self._edges.setdefault(b, []).append(back)
        self._find_junctions()

    def _find_junctions(self) -> None:
        forks = {at for at, edges in self._edges.items() if len({e.to for e in edges}) > 2}
        parent = {at: at for at in forks}

        def root(at: str) -> str:
            while parent[at] != at:
                parent[at] = parent[parent[at]]
                at = parent[at]
            return at

        def join(points: Sequence[str]) -> None:
            for at in points:
                parent.setdefault(at, at)
                parent[root(at)] = root(points[0])

        for points in self.inside:
            join(points)
        for fork in sorted(forks):
            for edge in self._edges[fork]:
                chain, length_m = self._chain(fork, edge, SAME_M)
                if length_m < SAME_M and chain[-1] in parent:
                    join(chain)
        numbers = {one: n for n, one in enumerate(sorted({root(at) for at in parent}))}
        self._junction = {at: numbers[root(at)] for at in parent}
        members: dict[int, list[str]] = {}
        for at, number in self._junction.items():
            members.setdefault(number, []).append(at)
        self._legs = {number: tuple(self._legs_of(one)) for number, one in members.items()}

    def _chain(self, at: str, edge: _Edge, most_m: float) -> tuple[list[str], float]:
        """Follow a road from a point to the next fork or end, or over the given length."""
        chain, length_m = [at], 0.0
        while True:
            before, here = chain[-1], edge.to
            length_m += self._distance_m(before, here)
            chain.append(here)
            onward = [e for e in self._edges[here] if e.to != before]
            if length_m >= most_m or len(onward) != 1 or here in chain[:-1]:
                return chain, length_m
            edge = onward[0]

    def _legs_of(self, members: Sequence[str]) -> Iterator[Leg]:
        inside = set(members)
        for at in sorted(members):
            edges = self._edges[at]
            ways = np.array([self._heading_rad(at, edge.to) for edge in edges])
            inward = float(np.angle(np.exp(1j * ways).sum()))
            if self.min_leg_m == 0.0 and (np.abs(_wrapped(ways - inward)) < CROSS_RAD).all():
                # The map ends here, with the lanes inside of the intersection.
                into, out_of = any(e.is_out for e in edges), any(e.is_in for e in edges)
                heading = float(_wrapped(inward + np.pi))
                yield Leg(self.points_m[at], heading, edges[0].width_m, into, out_of)
                continue
            for edge in edges:
                if edge.to in inside:
                    continue
                chain, length_m = self._chain(at, edge, LEG_M)
                if length_m >= self.min_leg_m:
                    heading = self._heading_rad(at, chain[-1])
                    yield Leg(self.points_m[at], heading, edge.width_m, edge.is_in, edge.is_out)

    def _distance_m(self, a: str, b: str) -> float:
        return float(np.hypot(*(self.points_m[b] - self.points_m[a])))

    def _heading_rad(self, a: str, b: str) -> float:
        x, y = self.points_m[b] - self.points_m[a]
        return float(np.arctan2(y, x))

    def legs(self, ahead: Ahead) -> dict[Side, list[Leg]]:
        """Return the legs of the next intersection by their side, as seen by the vehicle."""
        found: dict[Side, list[Leg]] = {"left": [], "right": [], "straight": [], "back": []}
        for leg in self._legs[ahead.junction]:
            found[_side(leg.heading_rad - ahead.heading_rad)].append(leg)
        return found

    def along(self, xy_m: Floats, heading_rad: Floats) -> list[Ahead | None]:
        """Return the next intersection at each position of a track.

        Args:
            xy_m: Positions, shape (N, 2).
            heading_rad: Headings, shape (N,), from x, counter-clockwise.

        Returns:
            One for each position; None inside an intersection, off the roads, or where there is
            none within reach.
        """
        near = self._near(xy_m)
        if not near:
            return [None] * len(xy_m)
        starts = np.array([self.points_m[a] for a, _ in near])
        ways = np.array([self.points_m[e.to] for _, e in near]) - starts
        length = np.hypot(*ways.T)
        headings = np.arctan2(ways[:, 1], ways[:, 0])
        found: list[Ahead | None] = []
        last: set[str] = set()
        step_m = np.hypot(*np.diff(xy_m, axis=0, prepend=xy_m[:1]).T)
        for at, heading, gone_m in zip(xy_m, heading_rad.tolist(), step_m.tolist(), strict=True):
            part = np.clip(((at - starts) * ways).sum(axis=1) / length**2, 0.0, 1.0)
            off = np.hypot(*(starts + part[:, None] * ways - at).T)
            turn = np.abs(_wrapped(headings - heading))
            cost = (off / _SCALE_M) ** 2 + (turn / _SCALE_RAD) ** 2
            cost += [0.0 if a in last or e.to in last else _CHANGE for a, e in near]
            best = int(cost.argmin())
            if off[best] > OFF_M or turn[best] > SIDE_RAD:
                found.append(None)
                continue
            begin, edge = near[best]
            last = {begin, edge.to}
            one = self._ahead(begin, edge, float((1.0 - part[best]) * length[best]))
            before = found[-1] if found else None
            if one is None and before and self._junction.get(edge.to) == before.junction:
                # Lanes of an intersection begin before its kerb, as at a stop line.
                left_m, end_m = before.start_m - gone_m, before.end_m - gone_m
                one = replace(before, start_m=left_m, end_m=end_m) if left_m > 0.0 else None
            found.append(one)
        return found

    def _near(self, xy_m: Floats) -> list[tuple[str, _Edge]]:
        low, high = xy_m.min(axis=0) - OFF_M, xy_m.max(axis=0) + OFF_M
        found = []
        for at, edges in self._edges.items():
            for edge in edges:
                pair = np.array([self.points_m[at], self.points_m[edge.to]])
                beside = (pair.max(axis=0) < low).any() or (pair.min(axis=0) > high).any()
                if edge.is_out and not beside and pair[0].tolist() != pair[1].tolist():
                    found.append((at, edge))
        return found

    def _ahead(self, begin: str, edge: _Edge, left_m: float) -> Ahead | None:
        """Follow the road to the next intersection that has a side road."""
        before, at, gone_m = begin, edge.to, left_m
        control: tuple[Control, float] | None = None
        seen = {begin}
        while gone_m < REACH_M and at not in seen:
            seen.add(at)
            heading = self._heading_rad(before, at)
            stated = self.controls.get(at)
            if stated and (stated[1] is None or abs(_wrapped(stated[1] - heading)) < SIDE_RAD):
                control = stated[0], gone_m
            number = self._junction.get(at)
            kerbs = None if number is None else self._kerbs_of(number, before, at)
            if number is not None and kerbs is not None:
                if self._junction.get(before) == number:
                    return None
                stands = control is not None and gone_m - control[1] < CONTROL_M
                said = control[0] if control and stands else None
                said = said or self._control_in(number, heading)
                return Ahead(number, gone_m + kerbs[0], gone_m + kerbs[1], heading, said)
            onward = [e for e in self._edges[at] if e.is_out and e.to != before]
            if not onward:
                return None
            turns = [abs(_wrapped(self._heading_rad(at, e.to) - heading)) for e in onward]
            before, edge = at, onward[int(np.argmin(turns))]
            at = edge.to
            gone_m += self._distance_m(before, at)
        return None

    def _kerbs_of(self, number: int, before: str, at: str) -> tuple[float, float] | None:
        """Return the distances from a point to the kerbs of an intersection's side roads.

        They are where the side roads, and lanes inside of it that cross, meet the way straight on.

        Returns:
            Near and far kerb; None if no side road meets that way.
        """
        if (before, at) not in self._kerbs:
            heading = self._heading_rad(before, at)
            sides = [
                (leg.xy_m, leg.heading_rad, leg.width_m, -LEG_REACH_M, 0.0)
                for leg in self._legs[number]
                if _side(leg.heading_rad - heading) in ("left", "right")
            ]
            inside = [
                (self.points_m[a], self._heading_rad(a, e.to), e.width_m, 0.0, length_m)
                for a, edges in self._edges.items()
                if self._junction.get(a) == number
                for e in edges
                if self._junction.get(e.to) == number and (length_m := self._distance_m(a, e.to))
            ]
            spans = self._spans(at, heading, [*sides, *inside])
            # All side roads are far off the way straight on, and their lanes end beside it.
            spans = spans or self._spans(at, heading, [(*one[:3], -np.inf, 0.0) for one in sides])
            is_met = sides and spans
            near_far = (min(a for a, _ in spans), max(b for _, b in spans)) if is_met else None
            self._kerbs[before, at] = near_far
        return self._kerbs[before, at]

    def _spans(
        self,
        at: str,
        heading_rad: float,
        lines: Sequence[tuple[Floats, float, float, float, float]],
    ) -> list[tuple[float, float]]:
        """Return where lines with a width cross a way, from their least to their most distance."""
        found = []
        x, y = np.cos(heading_rad), np.sin(heading_rad)
        for begin, toward_rad, width_m, least_m, most_m in lines:
            sine = np.sin(toward_rad - heading_rad)
            if abs(sine) < np.sin(CROSS_RAD) and most_m > 0.0:
                continue
            off_x, off_y = begin - self.points_m[at]
            along_m = (off_x * y - off_y * x) / sine
            if least_m - 0.01 <= along_m <= most_m + 0.01:
                ahead_m = (off_x * np.sin(toward_rad) - off_y * np.cos(toward_rad)) / sine
                half_m = 0.5 * width_m / abs(sine)
                found.append((float(ahead_m - half_m), float(ahead_m + half_m)))
        return found

    def _control_in(self, number: int, heading_rad: float) -> Control | None:
        """Return the control that stands at a point of the intersection itself."""
        for at, (control, toward) in self.controls.items():
            if self._junction.get(at) == number and (
                toward is None or abs(_wrapped(toward - heading_rad)) < SIDE_RAD
            ):
                return control
        return None


def _side(turn_rad: float) -> Side:
    turn = _wrapped(turn_rad)
    if abs(turn) >= BACK_RAD:
        return "back"
    if abs(turn) < SIDE_RAD:
        return "straight"
    return "left" if turn > 0.0 else "right"


def _wrapped(angle_rad: Floats | float) -> Floats:
    return np.asarray((angle_rad + np.pi) % (2.0 * np.pi) - np.pi)


def approaches_along(
    t_ns: Int64s, found: Sequence[Ahead | None]
) -> list[tuple[int, int, int | None]]:
    """Group rows by the intersection ahead.

    Returns:
        First row, row after the last, and time of entering, for each approach; the time is None
        if the track ends before.
    """
    groups: list[tuple[int, int, int | None]] = []
    row = 0
    while row < len(found):
        one = found[row]
        if one is None:
            row += 1
            continue
        stop = row
        while stop < len(found):
            here = found[stop]
            if here is None or here.junction != one.junction or here.start_m <= 0.0:
                break
            stop += 1
        if stop - row > 1:
            groups.append((row, stop, int(t_ns[stop]) if stop < len(found) else None))
        row = max(stop, row + 1)
    return groups
