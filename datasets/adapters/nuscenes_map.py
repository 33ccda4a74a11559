"""Read the lanes of nuScenes' map expansion, ``maps/expansion/LOCATION.json``, version 1.3.

Lanes for cars and lane connectors are read along their ``arcline_path_3``; connectors are inside
intersections where they cross or turn. A stop line of a sign or a light is for the lanes that end
on it. The layout is that of nuscenes-devkit, python-sdk/nuscenes/map_expansion. It was implemented
without access to a map.
"""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from crosscue.datasets.truth.lanes import MAX_POINTS, Lane, cross, lane_graph, step_count
from crosscue.datasets.truth.road_map import Control, RoadMap
from crosscue.replay.columns import Floats
from crosscue.replay.errors import LogFormatError
from crosscue.replay.files.bounded import read_whole
from crosscue.replay.files.tree_text import json_tree
from crosscue.replay.limits import MIB

MAX_BYTES: Final = 512 * MIB
STEP_M: Final = 2.0
# Width of every lane, because connectors have no polygon.
LANE_M: Final = 3.5
# Part of a lane at its end on which its stop line lies.
END_M: Final = 10.0
_CONTROLS: Final[Mapping[str, Control]] = {
    "STOP_SIGN": "stop_sign",
    "TRAFFIC_LIGHT": "traffic_light",
}


def read_expansion(path: Path) -> RoadMap:
    """Read the lanes of a location.

    Raises:
        LogFormatError: The file cannot be read, or is no map expansion.
    """
    try:
        tree = json_tree(read_whole(path, MAX_BYTES))
        nodes = {row["token"]: (float(row["x"]), float(row["y"])) for row in tree["node"]}
        areas = {
            row["token"]: np.array([nodes[at] for at in row["exterior_node_tokens"]])
            for row in tree["polygon"]
        }
        lanes = _lanes(tree)
        return lane_graph(lanes, dict(_controls(tree, areas, lanes)))
    except OSError as error:
        raise LogFormatError(f"{path}: {error.strerror}; expected a map expansion") from None
    except (ValueError, LookupError, TypeError, AttributeError, ArithmeticError) as error:
        why = f"{type(error).__name__} {str(error)[:80]!r}"
        raise LogFormatError(f"{path}: {why}: not a map expansion of nuScenes, 1.3") from None


def _lanes(tree: Mapping[str, Any]) -> dict[str, Lane]:
    plain = {row["token"] for row in tree["lane"] if row.get("lane_type", "CAR") == "CAR"}
    all_lanes = plain | {row["token"] for row in tree["lane_connector"]}
    links: Mapping[str, Mapping[str, Sequence[str]]] = tree["connectivity"]

    def last(token: str) -> str:
        """Return the point that a lane shares with those behind it."""
        after = next((one for one in links.get(token, {}).get("outgoing", ()) if one in plain), "")
        return f"{after}<" if after else f"{token}>"

    def first(token: str) -> str:
        before = next(
            (one for one in links.get(token, {}).get("incoming", ()) if one in all_lanes), ""
        )
        return last(before) if before and token not in plain else f"{token}<"

    found = {}
    points = 0
    for token in sorted(all_lanes & tree["arcline_path_3"].keys()):
        pieces = []
        for piece in tree["arcline_path_3"][token]:
            pieces.append(_line(piece))
            points += len(pieces[-1])
            if points > MAX_POINTS:
                raise ValueError(f"lanes of over {MAX_POINTS * STEP_M / 1e3:.0f} km")
        middle = np.concatenate(pieces)
        middle = middle[np.r_[True, np.hypot(*np.diff(middle, axis=0).T) > 0.01]]
        if len(middle) > 1:
            found[token] = Lane((first(token), last(token)), middle, LANE_M)
    return found


def _line(piece: Mapping[str, Any]) -> Floats:
    """Return points along three arcs or straight lines, ``shape`` such as LSR."""
    x, y, yaw = (float(one) for one in piece["start_pose"])
    points = [(x, y)]
    for letter, length in zip(piece["shape"], piece["segment_length"], strict=True):
        count = step_count(float(length), STEP_M)
        turn = {"L": 1.0, "S": 0.0, "R": -1.0}[letter] / float(piece["radius"])
        step_m, turn_rad = float(length) / count, turn * float(length) / count
        if not np.isfinite([x, y, yaw, step_m, turn_rad]).all():
            raise ValueError("a lane without an end")
        for _ in range(count):
            chord_m = step_m * np.sinc(turn_rad / (2.0 * np.pi))
            x += chord_m * np.cos(yaw + 0.5 * turn_rad)
            y += chord_m * np.sin(yaw + 0.5 * turn_rad)
            yaw += turn_rad
            points.append((x, y))
    return np.array(points)


def _controls(
    tree: Mapping[str, Any], areas: Mapping[str, Floats], lanes: Mapping[str, Lane]
) -> Iterator[tuple[str, tuple[Control, float | None]]]:
    stops = [(row["polygon_token"], row["stop_line_type"]) for row in tree["stop_line"]]
    for kind, control in _CONTROLS.items():
        for area in (areas[token] for token, said in stops if said == kind):
            for lane in lanes.values():
                end = lane.middle_m[-1]
                near = np.hypot(*(lane.middle_m - end).T) < END_M
                off_m = np.hypot(*(area - end).T).min()
                if off_m < END_M and cross(lane.middle_m[near], np.vstack([area, area[:1]])):
                    x, y = end - lane.middle_m[-2]
                    yield lane.ends[1], (control, float(np.arctan2(y, x)))
