"""Read the roads of an OpenStreetMap extract in XML, ``.osm``.

Roads for cars are read, but not ``highway=service``: a driveway is no intersection. Their width is
that of ``width``, else ``lanes`` of 3.25 m, else that of two lanes (one, if one-way). Controls are
``highway=traffic_signals`` and ``highway=stop``, with their ``direction``.
https://wiki.openstreetmap.org/wiki/OSM_XML
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from crosscue.datasets.geodesy import geodetic_to_enu
from crosscue.replay.errors import AnnotationError
from crosscue.replay.limits import MIB

from .label_xml import XmlReader
from .road_map import Control, Road, RoadMap

MAX_BYTES: Final = 512 * MIB
LANE_M: Final = 3.25
MAX_WIDTH_M: Final = 60.0
KINDS: Final = frozenset(
    f"{name}{link}"
    for name in ("motorway", "trunk", "primary", "secondary", "tertiary")
    for link in ("", "_link")
) | {"unclassified", "residential", "living_street", "road"}
_CONTROLS: Final[Mapping[str, Control]] = {"traffic_signals": "traffic_light", "stop": "stop_sign"}


@dataclass(frozen=True, slots=True)
class MapExtract:
    """Contents of an extract.

    Attributes:
        points: Latitude and longitude of each point, degrees.
        roads: Roads for cars.
        controls: Control at a point, with its direction ("forward", "backward" or other text).
        rounds: Points of each roundabout.
    """

    points: Mapping[str, tuple[float, float]]
    roads: Sequence[Road]
    controls: Mapping[str, tuple[Control, str]]
    rounds: Sequence[tuple[str, ...]]

    def around(self, origin: tuple[float, float, float]) -> RoadMap:
        """Return the roads in a local frame.

        Args:
            origin: Latitude and longitude, degrees, and height of the frame's origin.
        """
        used = sorted({at for road in self.roads for at in road.nodes})
        degrees = np.array([self.points[at] for at in used])
        height_m = np.full(len(used), origin[2])
        xy_m = geodetic_to_enu(degrees[:, 0], degrees[:, 1], height_m, origin)[:, :2]
        points_m = dict(zip(used, xy_m, strict=True))
        controls: dict[str, tuple[Control, float | None]] = {}
        for road in self.roads:
            for row, at in enumerate(road.nodes):
                if at in self.controls:
                    control, direction = self.controls[at]
                    ends = road.nodes[max(row - 1, 0) : row + 2]
                    x, y = points_m[ends[-1]] - points_m[ends[0]]
                    ahead = float(np.arctan2(y, x))
                    toward = {"forward": ahead, "backward": ahead + np.pi}.get(direction)
                    controls[at] = control, toward
        return RoadMap(points_m, self.roads, controls, self.rounds)


@dataclass(slots=True)
class MapReader(XmlReader):
    """Points, roads and controls of a file."""

    kind = "OpenStreetMap's or Lanelet2's XML"
    max_depth = 16
    points: dict[str, tuple[float, float]] = field(default_factory=dict)
    controls: dict[str, tuple[Control, str]] = field(default_factory=dict)
    roads: list[Road] = field(default_factory=list)
    rounds: list[tuple[str, ...]] = field(default_factory=list)
    _key: str = ""
    _nodes: list[str] = field(default_factory=list)
    _tags: dict[str, str] = field(default_factory=dict)

    def start(self, tag: str, found: Mapping[str, str]) -> None:
        """Begin an element; a point's position is noted."""
        if not self._path and tag != "osm":
            raise AnnotationError(f"{self.where}: <{tag}>: expected <osm> of {self.kind}")
        XmlReader.start(self, tag, found)
        if tag in ("node", "way", "relation"):
            self._key, self._nodes, self._tags = found.get("id", ""), [], {}
        if tag == "node":
            try:
                at = float(found["lat"]), float(found["lon"])
            except (KeyError, ValueError):
                raise AnnotationError(
                    f"{self.where}: node {self._key}: expected lat and lon in degrees"
                ) from None
            if not (abs(at[0]) <= 90.0 and abs(at[1]) <= 180.0):
                raise AnnotationError(f"{self.where}: node {self._key}: {at}: expected degrees")
            self.points[self._key] = at
        elif tag == "nd":
            self._nodes.append(found.get("ref", ""))
        elif tag == "tag":
            self._tags[found.get("k", "")] = found.get("v", "")

    def extract(self) -> MapExtract:
        """Return the roads.

        Raises:
            AnnotationError: There is none.
        """
        if not self.roads:
            raise AnnotationError(
                f"{self.where}: no road for cars (way with highway=residential, ...), no lanelet"
            )
        return MapExtract(self.points, self.roads, self.controls, self.rounds)

    def end(self, tag: str) -> None:
        """End an element; a control or a road is noted."""
        XmlReader.end(self, tag)
        if tag == "node" and self._tags.get("highway") in _CONTROLS:
            tags = self._tags
            said = tags.get("traffic_signals:direction") or tags.get("direction", "")
            self.controls[self._key] = _CONTROLS[tags["highway"]], said
        elif tag == "way" and self._tags.get("highway") in KINDS:
            # An extract may cut a road; points outside of it have no position.
            nodes = tuple(at for at in self._nodes if at in self.points)
            if self._tags.get("oneway") == "-1":
                nodes = nodes[::-1]
            if len(nodes) > 1:
                is_round = self._tags.get("junction") in ("roundabout", "circular")
                self.roads.append(_road(nodes, self._tags, is_round))
                self.rounds += [nodes] * is_round


def _road(nodes: tuple[str, ...], tags: Mapping[str, str], is_round: bool) -> Road:
    motorway = tags["highway"] == "motorway"
    one_way = tags.get("oneway", "yes" if is_round or motorway else "no") in ("yes", "1", "-1")
    lanes = _number(tags.get("lanes", "")) or (1.0 if one_way else 2.0)
    width_m = _number(tags.get("width", "")) or lanes * LANE_M
    return Road(nodes, min(width_m, MAX_WIDTH_M), one_way)


def _number(text: str) -> float:
    """Return a positive number, in metres where it has that unit; else 0."""
    match = re.fullmatch(r"\s*(\d{1,3}(?:\.\d+)?)\s*m?\s*", text)
    return float(match[1]) if match else 0.0
