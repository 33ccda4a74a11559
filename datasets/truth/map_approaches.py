"""Approaches of a track to the intersections of a map, as truth."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np

from crosscue.replay.columns import Int64s
from crosscue.replay.files.whole_file import write_text

from .road_map import Ahead, Leg, RoadMap, approaches_along
from .truth import Approach, Features
from .tum import Trajectory

RANGES: Final = "ranges.csv"
# Tag of an approach of which the map states no control.
NOT_STATED: Final = "control_not_stated"
# Time between two positions that are matched to the map.
STEP_NS: Final = 50_000_000


def write_approaches(
    track: Trajectory, roads: RoadMap, name: str, folder: Path, ahead_m: float = 0.0
) -> tuple[dict[str, Any], str]:
    """Write the ranges of a track's approaches to the intersections of a map.

    Args:
        track: Positions in the map's frame, with headings.
        roads: The map.
        name: Name of the map.
        folder: Folder for the ranges; it is not written without an approach.
        ahead_m: Distance of the track's body ahead of the rear axle, whose ranges are wanted.

    Returns:
        Fields of ``Truth``, and a sentence on their source; no field without an approach.

    Raises:
        OutputError: The file cannot be written.
    """
    t_ns = track.t_ns
    rows = np.unique(np.searchsorted(t_ns, np.arange(t_ns[0], t_ns[-1] + 1, STEP_NS)))
    t_ns = t_ns[rows]
    w, x, y, z = track.quat_wxyz[rows].T
    heading = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    found = roads.along(track.xyz_m[rows, :2], heading)
    approaches: list[Approach] = []
    ranges: list[str] = []
    for first, stop, enter_ns in approaches_along(t_ns, found):
        near = found[stop - 1]
        assert near is not None
        number = len(approaches) + 1
        stated = [one.control for one in found[first:stop] if one and one.control]
        # A sign that stands before the kerb is not ahead of the last positions.
        near = replace(near, control=stated[-1] if stated else None)
        approaches.append(_approach(number, near, roads, t_ns[first:stop], enter_ns))
        for t, one in zip(t_ns[first:stop].tolist(), found[first:stop], strict=True):
            assert one is not None
            start_m, end_m = (float(m) + ahead_m for m in (one.start_m, one.end_m))
            ranges.append(f"{t},{number},{start_m:.2f},{end_m:.2f}")
    if not approaches:
        return {}, f"no intersection of the map {name} on the roads that the drive follows"
    folder.mkdir(parents=True, exist_ok=True)
    write_text(folder / RANGES, "\n".join(["t_ns,approach,start_m,end_m", *ranges, ""]))
    unstated = sum(NOT_STATED in one.conditions for one in approaches)
    source = (
        f"intersections from the map {name}, widths by its lanes; control not stated for "
        f"{unstated} of {len(approaches)}"
    )
    return {"approaches": tuple(approaches), "ranges": RANGES}, source


def _approach(
    number: int, near: Ahead, roads: RoadMap, t_ns: Int64s, enter_ns: int | None
) -> Approach:
    legs = roads.legs(near)
    return Approach(
        id=number,
        intersection=f"map {near.junction}",
        start_ns=int(t_ns[0]),
        enter_ns=int(t_ns[-1]) + 1 if enter_ns is None else enter_ns,
        control=near.control or "none",
        features=Features(
            left=any(leg.is_out for leg in legs["left"]),
            right=any(leg.is_out for leg in legs["right"]),
            straight=any(leg.is_out for leg in legs["straight"]),
        ),
        one_way=_one_way(legs["left"], legs["right"]),
        conditions=() if near.control else (NOT_STATED,),
        length_m=round(float(near.end_m - near.start_m), 2),
    )


def _one_way(left: Sequence[Leg], right: Sequence[Leg]) -> Literal["left", "right"] | None:
    """Return the direction of the crossroad's traffic, if all of its legs agree on one."""
    to_left = [(leg.is_out, leg.is_in) for leg in left]
    to_left += [(leg.is_in, leg.is_out) for leg in right]
    if to_left and all(one == (True, False) for one in to_left):
        return "left"
    return "right" if to_left and all(one == (False, True) for one in to_left) else None
