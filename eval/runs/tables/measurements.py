"""Table of the pose filter's inputs, which are also the smoother's.

``measurements.parquet`` has one row per measurement, with nulls where a column does not apply:
``start`` (the first belief), ``odometry`` (from ``start_ns`` to ``t_ns``), ``gap`` (likewise, the
motion assumed between two time segments), ``heading`` (accepted headings), ``landmark`` and
``position`` (accepted positions of the camera, and of the antenna by GNSS).
"""

from collections.abc import Mapping
from typing import Final

import numpy as np

from crosscue.localization.ekf import PoseBelief
from crosscue.localization.gap import Crossed
from crosscue.localization.landmarks.sighting import Sighting
from crosscue.localization.odometry import BY_STEERING, BY_WHEELS, BY_YAW_RATE, Increments
from crosscue.localization.pose_track import ACCEPTED, HeadingColumns

from .columns import OF_RUN, REAL

TABLE: Final = "measurements"
NUMBERS: Final = tuple(name for name, one in OF_RUN[TABLE].items() if one.kind == REAL)
# Sources of turns whose errors the filter can have as states.
TURNS: Final = {BY_YAW_RATE: "yaw rate", BY_STEERING: "steering", BY_WHEELS: "wheels"}


def start_rows(belief: PoseBelief) -> dict[str, object]:
    """Return the first belief as a row."""
    x, y, heading, speed = belief.mean.tolist()
    cov = belief.cov.tolist()
    return _rows(
        "start",
        np.array([belief.t_ns]),
        {
            "x_m": [x],
            "y_m": [y],
            "heading_rad": [heading],
            "speed_mps": [speed],
            "xx_m2": [cov[0][0]],
            "xy_m2": [cov[0][1]],
            "yy_m2": [cov[1][1]],
            "heading_var_rad2": [cov[2][2]],
            "speed_var_m2ps2": [cov[3][3]],
        },
    )


def odometry_rows(made: Increments, *, is_visual: bool = False) -> dict[str, object]:
    """Return increments of odometry as rows, by signals or by pictures."""
    columns: dict[str, object] = {name: getattr(made, name) for name in NUMBERS[:6]}
    if not is_visual:
        columns["turn_from"] = [TURNS.get(source) for source in made.turn_source.tolist()]
    return _rows("odometry", made.stop_ns, columns | {"start_ns": made.start_ns})


def gap_rows(start_ns: int, crossed: Crossed) -> dict[str, object]:
    """Return a gap as a row."""
    _, _, _, speed_mps = crossed.belief.mean.tolist()
    return _rows(
        "gap",
        np.array([crossed.belief.t_ns]),
        {
            "start_ns": [start_ns],
            "distance_m": [crossed.distance_m],
            "turn_rad": [0.0],
            "distance_var_m2": [crossed.distance_var_m2],
            "turn_var_rad2": [crossed.turn_var_rad2],
            "speed_mps": [speed_mps],
            "speed_var_m2ps2": [crossed.belief.cov[3, 3]],
        },
    )


def heading_rows(used: HeadingColumns) -> dict[str, object]:
    """Return accepted headings as rows."""
    good = used.outcome == ACCEPTED
    columns: dict[str, object] = {
        "heading_rad": used.heading_rad[good],
        "heading_var_rad2": used.var_rad2[good],
    }
    return _rows("heading", used.t_ns[good], columns)


def landmark_rows(sightings: list[Sighting]) -> dict[str, object]:
    """Return accepted landmarks as rows."""
    good = [s for s in sightings if s.outcome == ACCEPTED]
    columns: dict[str, object] = {
        "x_m": [s.xy_m[0] for s in good],
        "y_m": [s.xy_m[1] for s in good],
        "xx_m2": [s.cov_m2[0, 0] for s in good],
        "xy_m2": [s.cov_m2[0, 1] for s in good],
        "yy_m2": [s.cov_m2[1, 1] for s in good],
        "landmark": [s.name for s in good],
    }
    return _rows("landmark", np.array([s.t_ns for s in good], np.int64), columns)


def position_rows(used: list[tuple[int, float, float, float, float, float]]) -> dict[str, object]:
    """Return accepted GNSS positions (time, x, y, xx, xy, yy) as rows."""
    names = ("x_m", "y_m", "xx_m2", "xy_m2", "yy_m2")
    columns = {name: [one[i] for one in used] for i, name in enumerate(names, start=1)}
    return _rows("position", np.array([one[0] for one in used], np.int64), columns)


def _rows(kind: str, t_ns: object, columns: Mapping[str, object]) -> dict[str, object]:
    times = np.asarray(t_ns, np.int64)
    nothing = [None] * len(times)
    names = ("start_ns", *NUMBERS, "landmark", "turn_from")
    return {
        "kind": [kind] * len(times),
        "t_ns": times,
        **{name: columns.get(name, nothing) for name in names},
    }
