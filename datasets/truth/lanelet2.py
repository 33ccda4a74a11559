"""Read the lanes of a Lanelet2 map, ``.osm``, as one-way roads of a ``RoadMap``.

Lanelets for cars are read: ``subtype`` road, highway or play_street, unless ``participant`` names
others alone. A lanelet continues another one whose last points are its first points. Lanelets that
cross without a common end are inside one intersection, and so are those with ``turn_direction``.
Controls are the regulatory elements ``traffic_light`` and ``all_way_stop``, and ``right_of_way`` or
``traffic_sign`` with a stop sign. Positions are latitude and longitude.
https://github.com/fzi-forschungszentrum-informatik/Lanelet2
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from crosscue.datasets.geodesy import geodetic_to_enu
from crosscue.replay.columns import Floats
from crosscue.replay.errors import AnnotationError

from .label_xml import parse_xml
from .lanes import MAX_POINTS, Lane, lane_graph, step_count
from .openstreetmap import MAX_BYTES, MapExtract, MapReader
from .road_map import Control, RoadMap

SUBTYPES: Final = ("road", "highway", "play_street")
CARS: Final = ("participant:vehicle", "participant:vehicle:car", "participant:car")
# Subtypes of a stop sign: Lanelet2's country and number, and Autoware's name.
STOP_SIGNS: Final = ("de206", "usR1-1", "stop_sign")
STEP_M: Final = 4.0
MAX_HEIGHT_M: Final = 1e5


class _Lanelet(NamedTuple):
    key: str
    left: Sequence[str]
    right: Sequence[str]
    tags: Mapping[str, str]
    rules: Sequence[str]


@dataclass(frozen=True, slots=True)
class LaneMap:
    """Contents of a Lanelet2 map.

    Attributes:
        where: Name of the file.
        points: Latitude, longitude, degrees, and height of each point.
        lanelets: Lanelets for cars.
        controls: Control by regulatory element and lanelet; by element alone, for each lanelet.
    """

    where: str
    points: Mapping[str, tuple[float, float, float]]
    lanelets: Sequence[_Lanelet]
    controls: Mapping[tuple[str, str], Control]

    def around(self, origin: tuple[float, float, float]) -> RoadMap:
        """Return the lanes in a local frame.

        Args:
            origin: Latitude and longitude, degrees, and height of the frame's origin.

        Raises:
            AnnotationError: The lanes are too long together.
        """
        used = sorted({at for one in self.lanelets for at in (*one.left, *one.right)})
        lat, lon, height_m = np.array([self.points[at] for at in used]).T
        flat_m = geodetic_to_enu(lat, lon, np.full(len(used), origin[2]), origin)[:, :2]
        xyz_m = dict(zip(used, np.column_stack([flat_m, height_m]), strict=True))
        lanes: dict[str, Lane] = {}
        points = 0
        for one in self.lanelets:
            lanes[one.key] = _lane(one, xyz_m)
            points += len(lanes[one.key].middle_m)
            if points > MAX_POINTS:
                raise AnnotationError(
                    f"{self.where}: lanes of over {MAX_POINTS * STEP_M / 1e3:.0f} km; "
                    "cut the map to the drive"
                )
        two_way = {one.key for one in self.lanelets if one.tags.get("one_way") in ("no", "false")}
        turns = {one.key for one in self.lanelets if "turn_direction" in one.tags}
        return lane_graph(lanes, self._controls(lanes), two_way=two_way, turns=turns)

    def _controls(self, lanes: Mapping[str, Lane]) -> dict[str, tuple[Control, float | None]]:
        """Return controls at the end of the lanes they are for, or before a turn's first point."""
        found: dict[str, tuple[Control, float | None]] = {}
        for one in self.lanelets:
            said = {self.controls.get((rule, one.key)) for rule in one.rules}
            said |= {self.controls.get((rule, "")) for rule in one.rules}
            lane = lanes[one.key]
            row, at = (0, lane.ends[0]) if "turn_direction" in one.tags else (-2, lane.ends[1])
            x, y = lane.middle_m[row + 1] - lane.middle_m[row]
            for control in ("stop_sign", "traffic_light"):
                if control in said:
                    found[at] = control, float(np.arctan2(y, x))
        return found


def _lane(lanelet: _Lanelet, xyz_m: Mapping[str, Floats]) -> Lane:
    bounds = lanelet.left, lanelet.right
    left, right = (np.array([xyz_m[at] for at in side]) for side in bounds)
    names = [(side[0], side[-1]) for side in bounds]
    gaps = np.linalg.norm(left[[0, -1]] - right[[0, -1]], axis=1).sum()
    if gaps > np.linalg.norm(left[[0, -1]] - right[[-1, 0]], axis=1).sum():
        right, names[1] = right[::-1], names[1][::-1]
    x, y = np.vstack([left, right[::-1]])[:, :2].T
    if (x * np.roll(y, -1) - y * np.roll(x, -1)).sum() > 0.0:
        # The bounds are drawn against the lane's direction, in which left is on the left.
        left, right, names = left[::-1], right[::-1], [name[::-1] for name in names]
    length_m = max(np.linalg.norm(np.diff(one, axis=0), axis=1).sum() for one in (left, right))
    count = step_count(float(length_m), STEP_M) + 1
    left, right = _resampled(left, count), _resampled(right, count)
    middle = 0.5 * (left + right)
    first, last = ("/".join(sorted((names[0][end], names[1][end]))) for end in (0, 1))
    width_m = float(np.linalg.norm(left - right, axis=1).mean())
    return Lane((first, last), middle[:, :2], width_m, float(middle[:, 2].mean()))


def _resampled(line_m: Floats, count: int) -> Floats:
    steps = np.linalg.norm(np.diff(line_m, axis=0), axis=1)
    along = np.concatenate([[0.0], np.cumsum(steps)])
    at = np.linspace(0.0, along[-1], count)
    return np.column_stack([np.interp(at, along, column) for column in line_m.T])


def read_map(path: Path) -> MapExtract | LaneMap:
    """Read a Lanelet2 map, or an OpenStreetMap extract without lanelets.

    Raises:
        AnnotationError: The file cannot be read, or has no road for cars.
    """
    reader = _Reader(str(path))
    parse_xml(path, reader, MAX_BYTES)
    if reader.lanelets:
        heights = reader.heights_m
        points = {at: (*where, heights.get(at, 0.0)) for at, where in reader.points.items()}
        return LaneMap(reader.where, points, reader.lanelets, reader.stated())
    return reader.extract()


@dataclass(slots=True)
class _Reader(MapReader):
    heights_m: dict[str, float] = field(default_factory=dict)
    lanelets: list[_Lanelet] = field(default_factory=list)
    _bounds: dict[str, list[str]] = field(default_factory=dict)
    _signs: set[str] = field(default_factory=set)
    _rules: dict[str, tuple[str, list[tuple[str, str]]]] = field(default_factory=dict)
    _members: list[tuple[str, str]] = field(default_factory=list)

    def start(self, tag: str, found: Mapping[str, str]) -> None:
        MapReader.start(self, tag, found)
        if tag == "relation":
            self._members = []
        elif tag == "member":
            self._members.append((found.get("role", ""), found.get("ref", "")))

    def end(self, tag: str) -> None:
        MapReader.end(self, tag)
        tags, members = self._tags, self._members
        kind = tags.get("type")
        if tag == "node" and "ele" in tags:
            try:
                height_m = float(tags["ele"])
            except ValueError:
                height_m = np.nan
            if not abs(height_m) < MAX_HEIGHT_M:
                raise AnnotationError(
                    f"{self.where}: node {self._key}: ele {tags['ele'][:40]!r}: expected metres"
                )
            self.heights_m[self._key] = height_m
        elif tag == "way":
            # Points outside of an extract have no position.
            self._bounds[self._key] = [at for at in self._nodes if at in self.points]
            if tags.get("subtype") in STOP_SIGNS:
                self._signs.add(self._key)
        elif tag == "relation" and kind == "lanelet" and _is_for_cars(tags):
            left, right = (
                next((self._bounds.get(ref, []) for role, ref in members if role == side), [])
                for side in ("left", "right")
            )
            rules = [ref for role, ref in members if role == "regulatory_element"]
            if len(left) > 1 and len(right) > 1:
                self.lanelets.append(_Lanelet(self._key, left, right, tags, rules))
        elif tag == "relation" and kind == "regulatory_element":
            self._rules[self._key] = tags.get("subtype", ""), members

    def stated(self) -> dict[tuple[str, str], Control]:
        found: dict[tuple[str, str], Control] = {}
        for key, (kind, members) in self._rules.items():
            has_sign = any(role == "refers" and ref in self._signs for role, ref in members)
            if kind == "traffic_light":
                found[key, ""] = "traffic_light"
            elif kind == "all_way_stop" or (kind == "traffic_sign" and has_sign):
                found[key, ""] = "stop_sign"
            elif kind == "right_of_way" and has_sign:
                found |= {(key, ref): "stop_sign" for role, ref in members if role == "yield"}
        return found


def _is_for_cars(tags: Mapping[str, str]) -> bool:
    said = [tags[name] for name in tags if name.startswith("participant")]
    cars = any(tags.get(name) == "yes" for name in CARS)
    return tags.get("subtype") in SUBTYPES and (cars or not said)
