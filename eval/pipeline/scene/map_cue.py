"""The cue ``map``: the legs of the next intersection on the vehicle file's map, by the pose."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Final

import numpy as np

from crosscue.detectors.cues.rules import counts_of
from crosscue.eval.runs.tables.parquet import TableFolder
from crosscue.replay.errors import VehicleError
from crosscue.replay.vehicle.vehicle import Vehicle

# Longest time between a frame and its pose, and largest 2-sigma ellipse of a pose on a map.
NEAREST_NS: Final = 500_000_000
MAX_AXIS_M: Final = 20.0


def map_ahead(run: TableFolder, vehicle: Vehicle) -> Callable[[int], Mapping[str, int]]:
    """Return a function from a frame's time to the counts of the map's cues; none without a map.

    Raises:
        VehicleError: The geodetic position of the pose's origin is unknown.
        AnnotationError: The map cannot be read.
    """
    if vehicle.road_map is None:
        return lambda t_ns: {}
    from crosscue.datasets.truth.lanelet2 import read_map

    origin = vehicle.start.map_origin
    if origin is None:
        raise VehicleError(
            "road_map: the position on the map is unknown; expected GNSS in the first seconds, "
            "with the vehicle moving, or start.map_origin in the vehicle file"
        )
    roads = read_map(Path(vehicle.road_map)).around(origin)
    table = run.table("pose", ["t_ns", "x_m", "y_m", "heading_rad", "major_axis_m"])
    t_ns, x_m, y_m, heading_rad, axis_m = (one.to_numpy() for one in table.columns)
    ahead = roads.along(np.column_stack([x_m, y_m]), heading_rad) if len(t_ns) else []

    def counts(frame_ns: int) -> Mapping[str, int]:
        row = int(np.searchsorted(t_ns, frame_ns, side="right")) - 1
        one = ahead[row] if row >= 0 else None
        if one is None or frame_ns - t_ns[row] > NEAREST_NS or axis_m[row] > MAX_AXIS_M:
            return {}
        legs = roads.legs(one)
        sides = {side for side in legs if any(leg.is_out for leg in legs[side])}
        return {cue: one.number or 0 for cue, one in counts_of("map", sides, vehicle).items()}

    return counts
