"""Ground truth of intersections from a map, for a drive with positions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final, Literal

import numpy as np

from crosscue.datasets.truth.lanelet2 import read_map
from crosscue.datasets.truth.road_map import Ahead, Leg, RoadMap, approaches_along
from crosscue.datasets.truth.truth import Approach, Features, WrittenTruth
from crosscue.datasets.truth.tum import Trajectory
from crosscue.eval.logs.log import DriveGiven, opened
from crosscue.replay.columns import Int64s
from crosscue.replay.errors import EmptyResultError
from crosscue.replay.files.whole_file import write_text
from crosscue.replay.vehicle.vehicle import Vehicle, vehicle_given

from .gnss_truth import gnss_truth, save_with_track

RANGES: Final = "ranges.csv"
# Tag of an approach of which the map states no control.
NOT_STATED: Final = "control_not_stated"
# Time between two positions that are matched to the map.
STEP_NS: Final = 50_000_000


def truth_from_map(
    log: DriveGiven,
    road_map: Path | str,
    output: Path | str,
    vehicle: Vehicle | Path | str | None = None,
) -> WrittenTruth:
    """Write the intersections of a map that a drive with GNSS positions comes to.

    Each approach has its legs, its control where the map states one, and its distances. The map is
    an OpenStreetMap extract, or a Lanelet2 map with latitude and longitude. An approach without a
    stated control has the control "none" and the condition control_not_stated: maps rarely contain
    stop signs. The track is that of truth from-gnss.

    Examples:
        crosscue truth from-map drive.mcap map.osm --vehicle car.toml -o truth/

    Args:
        log: The drive, or its path; ``log.part(...)`` for a part of it.
        road_map: OpenStreetMap extract or Lanelet2 map, .osm, around the drive.
        output: Folder for the truth file, its track and its ranges.
        vehicle: Vehicle file with the antenna's mounting.

    Raises:
        EmptyResultError: The log has no position with a heading, or the map no intersection there.
        AnnotationError: The map cannot be read.
        OutputError: The files cannot be written.
    """
    settings = vehicle_given(vehicle)
    path = Path(road_map)
    extract = read_map(path)
    with opened(log) as drive:
        truth, track = gnss_truth(drive.logs, settings, drive.selection)
    assert truth.origin is not None
    origin = truth.origin.latitude_deg, truth.origin.longitude_deg, truth.origin.altitude_m
    approaches, ranges = _approaches(track, extract.around(origin), settings.gnss.x_m)
    if not approaches:
        raise EmptyResultError(f"{path}: no intersection on the roads that the drive follows")
    folder = Path(output)
    folder.mkdir(parents=True, exist_ok=True)
    write_text(folder / RANGES, "\n".join(["t_ns,approach,start_m,end_m", *ranges, ""]))
    unstated = sum(NOT_STATED in one.conditions for one in approaches)
    return WrittenTruth(
        save_with_track(
            truth.model_copy(
                update={
                    "approaches": tuple(approaches),
                    "ranges": RANGES,
                    "source": f"{truth.source}; intersections from the map {path.name}, widths by "
                    f"its lanes; control not stated for {unstated} of {len(approaches)}",
                }
            ),
            track,
            folder,
        )
    )


def _approaches(
    track: Trajectory, roads: RoadMap, antenna_x_m: float
) -> tuple[list[Approach], list[str]]:
    """Return the approaches, and the rows of their ranges."""
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
            start_m, end_m = (float(m) + antenna_x_m for m in (one.start_m, one.end_m))
            ranges.append(f"{t},{number},{start_m:.2f},{end_m:.2f}")
    return approaches, ranges


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
