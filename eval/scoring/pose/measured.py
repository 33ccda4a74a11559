"""Read the measurements of the pose filter, for the batch smoother."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from crosscue.eval.runs.folder import RunFolder
from crosscue.eval.runs.tables.measurements import NUMBERS, TABLE
from crosscue.localization.ekf import PoseBelief
from crosscue.localization.fixes import Fixes
from crosscue.localization.odometry import BY_NOTHING, BY_YAW_RATE, Increments
from crosscue.localization.pose_track import Headings
from crosscue.replay.columns import Floats
from crosscue.replay.errors import RunError


@dataclass(frozen=True, slots=True, eq=False)
class RunMeasurements:
    """All measurements of a run.

    Attributes:
        start: The first belief.
        increments: Odometry.
        headings: Headings that the filter used.
        fixes: Positions of the camera from landmarks, and of the antenna from GNSS.
        is_gnss: Shape (N,): True for fixes from GNSS.
    """

    start: PoseBelief
    increments: Increments
    headings: Headings
    fixes: Fixes
    is_gnss: NDArray[np.bool_]


def read_measured(run: RunFolder) -> RunMeasurements:
    """Read the measurements of a finished run.

    Raises:
        RunError: The table is missing (a run of an older crosscue), damaged, or empty.
    """
    import pyarrow as pa
    import pyarrow.compute as pc

    table = run.table(TABLE)

    def of(*kinds: str) -> dict[str, Floats]:
        part = table.filter(pc.is_in(table["kind"].cast("string"), pa.array(kinds)))
        names = ("start_ns", "t_ns", *NUMBERS)
        return {name: part[name].to_numpy() for name in names}

    start, heading, gaps = map(of, ("start", "heading", "gap"))
    odometry, fixes = of("odometry", "gap"), of("landmark", "position")
    is_gap = np.isin(odometry["t_ns"], gaps["t_ns"]) & np.isin(
        odometry["start_ns"], gaps["start_ns"]
    )
    if len(start["t_ns"]) != 1 or not len(odometry["t_ns"]):
        raise RunError(f"{run.path}: contains no odometry, so there is nothing to smooth")
    cov = np.zeros((4, 4))
    cov[:2, :2] = _matrices(start)[0]
    cov[2, 2], cov[3, 3] = start["heading_var_rad2"][0], start["speed_var_m2ps2"][0]
    mean = np.array([start[name][0] for name in ("x_m", "y_m", "heading_rad", "speed_mps")])
    return RunMeasurements(
        PoseBelief(int(start["t_ns"][0]), mean, cov),
        Increments(
            start_ns=odometry["start_ns"].astype(np.int64),
            stop_ns=odometry["t_ns"].astype(np.int64),
            distance_m=odometry["distance_m"],
            turn_rad=odometry["turn_rad"],
            distance_var_m2=odometry["distance_var_m2"],
            turn_var_rad2=odometry["turn_var_rad2"],
            speed_mps=odometry["speed_mps"],
            speed_var_m2ps2=odometry["speed_var_m2ps2"],
            turn_source=np.where(is_gap, BY_NOTHING, BY_YAW_RATE).astype(np.uint8),
            is_gap=is_gap,
        ),
        Headings(
            heading["t_ns"].astype(np.int64), heading["heading_rad"], heading["heading_var_rad2"]
        ),
        Fixes(
            fixes["t_ns"].astype(np.int64),
            np.column_stack([fixes["x_m"], fixes["y_m"]]),
            _matrices(fixes),
        ),
        np.isin(fixes["t_ns"], of("position")["t_ns"]),
    )


def _matrices(columns: Mapping[str, Floats]) -> Floats:
    xx, xy, yy = (columns[name] for name in ("xx_m2", "xy_m2", "yy_m2"))
    return np.stack([np.stack([xx, xy], -1), np.stack([xy, yy], -1)], -2)
