"""Write OpenStreetMap extracts of made-up streets."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

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
    latitude = math.radians(origin[0])
    north_m = 111_132.92 - 559.82 * math.cos(2.0 * latitude)
    east_m = 111_412.84 * math.cos(latitude) - 93.5 * math.cos(3.0 * latitude)
    lines = ["<osm version='0.6'>"]
    for name, (x, y) in points_m.items():
        at = f"lat='{origin[0] + y / north_m:.8f}' lon='{origin[1] + x / east_m:.8f}'"
        lines.append(f"<node id='{name}' {at}>{_tags((tags or {}).get(name, ''))}</node>")
    for number, (names, said) in enumerate(roads):
        inside = "".join(f"<nd ref='{name}'/>" for name in names)
        kind = "" if "highway=" in said else "highway=residential "
        lines.append(f"<way id='{number}'>{inside}{_tags(kind + said)}</way>")
    path.write_text("\n".join([*lines, "</osm>"]))
    return path


def write_crossing(path: Path) -> Path:
    """Write a street to the east with a crossing at 60 m."""
    points_m = {"a": (-80.0, 0.0), "b": (60.0, 0.0), "c": (160.0, 0.0), "d": (60.0, 70.0)}
    return write_map(path, points_m, [("abc", ""), ("bd", "")])


def _tags(text: str) -> str:
    pairs = (one.split("=") for one in text.split())
    return "".join(f"<tag k='{key}' v='{value}'/>" for key, value in pairs)
