"""Write OpenStreetMap extracts and Lanelet2 maps of made-up streets."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from crosscue.datasets.truth.lanelet2 import read_map
from crosscue.datasets.truth.road_map import Ahead, RoadMap

# Latitude and longitude of the frame's origin, degrees.
ORIGIN = (49.0, 8.4)


def write_map(
    path: Path,
    points_m: Mapping[str, tuple[float, float]],
    roads: Sequence[tuple[str, str]],
    tags: Mapping[str, str] | None = None,
    origin: tuple[float, float] = ORIGIN,
) -> Path:
    """Write an extract.

    Metres become degrees by the usual series of WGS 84.

    Args:
        path: The file.
        points_m: Position of each point, east and north of the origin, by its one-letter name.
        roads: Points of each road, such as "abc", and its tags, such as "lanes=2 oneway=yes".
        tags: Tags of points.
        origin: Latitude and longitude of the origin.
    """
    lines = ["<osm version='0.6'>"]
    for name, xy_m in points_m.items():
        said = _tags((tags or {}).get(name, ""))
        lines.append(f"<node id='{name}' {_degrees(xy_m, origin)}>{said}</node>")
    for number, (names, said) in enumerate(roads):
        inside = "".join(f"<nd ref='{name}'/>" for name in names)
        kind = "" if "highway=" in said else "highway=residential "
        lines.append(f"<way id='{number}'>{inside}{_tags(kind + said)}</way>")
    path.write_text("\n".join([*lines, "</osm>"]))
    return path


def _degrees(xy_m: tuple[float, float], origin: tuple[float, float]) -> str:
    latitude = math.radians(origin[0])
    north_m = 111_132.92 - 559.82 * math.cos(2.0 * latitude)
    east_m = 111_412.84 * math.cos(latitude) - 93.5 * math.cos(3.0 * latitude)
    return f"lat='{origin[0] + xy_m[1] / north_m:.8f}' lon='{origin[1] + xy_m[0] / east_m:.8f}'"


Bound = Sequence[tuple[float, float]]
LANE_M = 3.5
# A crossing, 60 to 67 m east, whose roads have a lane each way; its lanes end 4 m before the kerbs.
WEST, EAST, SOUTH, NORTH = 56.0, 71.0, -7.5, 7.5
MIDDLE = 63.5


def straight_lane(a: tuple[float, float], b: tuple[float, float]) -> tuple[Bound, Bound]:
    """Left and right bound of a lane whose left bound is the road's middle line."""
    (x0, y0), (x1, y1) = a, b
    length = math.hypot(x1 - x0, y1 - y0)
    right = LANE_M * (y1 - y0) / length, -LANE_M * (x1 - x0) / length
    return [a, b], [(x0 + right[0], y0 + right[1]), (x1 + right[0], y1 + right[1])]


def joined_lane(a: tuple[Bound, Bound], b: tuple[Bound, Bound]) -> tuple[Bound, Bound]:
    """A turn from the end of a lane to the begin of another one."""
    return [a[0][-1], b[0][0]], [a[1][-1], b[1][0]]


def crossing_lanes() -> dict[str, tuple[Bound, Bound, str]]:
    """Bounds and tags of the lanes of a crossing."""
    arms = {
        "w": ((-80.0, 0.0), (WEST, 0.0)),
        "e": ((160.0, 0.0), (EAST, 0.0)),
        "s": ((MIDDLE, -80.0), (MIDDLE, SOUTH)),
        "n": ((MIDDLE, 80.0), (MIDDLE, NORTH)),
    }
    to = {name: straight_lane(far, near) for name, (far, near) in arms.items()}
    away = {name: straight_lane(near, far) for name, (far, near) in arms.items()}
    found = {f"{name}-in": (*lane, "") for name, lane in to.items()}
    found |= {f"{name}-out": (*lane, "") for name, lane in away.items()}
    for a in arms:
        found |= {f"{a}-{b}": (*joined_lane(to[a], away[b]), "") for b in arms if a != b}
    return found


def write_lanelets(
    path: Path,
    lanelets: Mapping[str, tuple[Bound, Bound, str]],
    rules: Mapping[str, tuple[str, str]] | None = None,
    *,
    heights_m: Mapping[str, float] | None = None,
    reversed_bounds: bool = False,
) -> Path:
    """Write a Lanelet2 map.

    Args:
        path: The file.
        lanelets: Left bound, right bound and tags of each lanelet; equal points are one node.
        rules: Kind of each regulatory element, and the lanelets it is for; "stop" stands for a
            right of way with a stop sign.
        heights_m: Height of a lanelet's points.
        reversed_bounds: Draw the left bounds against their lanes, as Lanelet2 allows.
    """
    nodes: dict[tuple[float, float], int] = {}
    lines, ways, relations = [], [], []
    rules = rules or {}
    for key, (left, right, said) in lanelets.items():
        for role, bound in (("left", left), ("right", right)):
            for point in bound:
                xy_m = round(point[0], 3), round(point[1], 3)
                if xy_m not in nodes:
                    nodes[xy_m] = len(nodes) + 1
                    height = _tags(f"ele={(heights_m or {}).get(key, 0.0)}")
                    at = _degrees(xy_m, ORIGIN)
                    lines.append(f"<node id='{nodes[xy_m]}' {at}>{height}</node>")
            drawn = [nodes[round(x, 3), round(y, 3)] for x, y in bound]
            drawn = drawn[::-1] if reversed_bounds and role == "left" else drawn
            inside = "".join(f"<nd ref='{node}'/>" for node in drawn)
            ways.append(f"<way id='{key}-{role}'>{inside}</way>")
        members = [("way", f"{key}-{role}", role) for role in ("left", "right")]
        members += [
            ("relation", rule, "regulatory_element")
            for rule, (_, of) in rules.items()
            if key in of.split()
        ]
        kind = "" if "subtype=" in said else "subtype=road "
        relations.append(_relation(key, members, f"type=lanelet {kind}{said}"))
    for rule, (kind, of) in rules.items():
        members = [("way", "sign", "refers")] + [("relation", key, "yield") for key in of.split()]
        kind = "right_of_way" if kind == "stop" else kind
        relations.append(_relation(rule, members, f"type=regulatory_element subtype={kind}"))
    ways.append(f"<way id='sign'>{_tags('type=traffic_sign subtype=de206')}</way>")
    path.write_text("\n".join(["<osm version='0.6'>", *lines, *ways, *relations, "</osm>"]))
    return path


def _relation(key: str, members: Sequence[tuple[str, str, str]], said: str) -> str:
    inside = "".join(f"<member type='{t}' ref='{ref}' role='{role}'/>" for t, ref, role in members)
    return f"<relation id='{key}'>{inside}{_tags(said)}</relation>"


def write_crossing(path: Path) -> Path:
    """Write a street to the east with a crossing at 60 m."""
    points_m = {"a": (-80.0, 0.0), "b": (60.0, 0.0), "c": (160.0, 0.0), "d": (60.0, 70.0)}
    return write_map(path, points_m, [("abc", ""), ("bd", "")])


def roads_of(path: Path) -> RoadMap:
    return read_map(path).around((*ORIGIN, 0.0))


def ahead_of(roads: RoadMap, x_m: float, y_m: float, heading_rad: float = 0.0) -> Ahead | None:
    """The next intersection from a place."""
    return roads.along(np.array([[x_m, y_m]]), np.array([heading_rad]))[0]


def _tags(text: str) -> str:
    pairs = (one.split("=") for one in text.split())
    return "".join(f"<tag k='{key}' v='{value}'/>" for key, value in pairs)
