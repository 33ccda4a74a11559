"""Known positions of a drive: its GNSS, or a truth file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final, TypeAlias

import numpy as np

from crosscue.datasets.geodesy import geodetic_to_enu
from crosscue.datasets.truth.tum import heading_rad
from crosscue.eval.scoring.pose.score import load_truth, mounting_of
from crosscue.localization.fixes import Fixes
from crosscue.replay.base import EmptyResultError, Floats, Int64s
from crosscue.replay.signals.kinds import Samples
from crosscue.replay.vehicle.vehicle import Vehicle

GeodeticOrigin: TypeAlias = tuple[float, float, float]
"""Latitude and longitude in degrees, altitude in metres."""
SPACING_NS: Final = 1_000_000_000
"""Positions nearer to each other say little more: their errors last."""
TRUTH_SD_M: Final = 0.3
"""Where a truth file says nothing about its own quality; the fit finds out."""


@dataclass(frozen=True, slots=True, eq=False)
class Reference:
    """Positions of a point of the car, in a plane local frame.

    Attributes:
        name: Where they come from.
        fixes: About a second apart.
        lever_m: The point, ahead of and to the left of the rear axle.
        heading_rad: Shape (N,): of the body whose track it is; None where it has none.
        is_of_camera: Whether that body is the camera.
        is_map: Whether the frame is the map of a truth file, in which runs are scored.
        origin: Where the frame's zero lies.
    """

    name: str
    fixes: Fixes
    lever_m: tuple[float, float]
    heading_rad: Floats | None = None
    is_of_camera: bool = False
    is_map: bool = False
    origin: GeodeticOrigin | None = None


def of_gnss(name: str, samples: Samples, vehicle: Vehicle) -> Reference:
    """The receiver's positions, in a frame about the first of them.

    Args:
        name: Of the topic.
        samples: Of ``Signal.POSITION``.
        vehicle: The antenna's place, and how good positions are that say nothing of it.
    """
    gnss = vehicle.gnss
    t_ns = samples.t_ns - round(gnss.delay_s * 1e9)
    lat, lon, alt, sd = samples.values.T
    alt = np.where(np.isfinite(alt), alt, 0.0)
    origin = float(lat[0]), float(lon[0]), float(alt[0])
    xyz = geodetic_to_enu(lat, lon, alt, origin)
    rows = spaced(t_ns)
    var = np.where(np.isfinite(sd), sd, gnss.position_sd_m)[rows] ** 2
    fixes = Fixes(t_ns[rows], xyz[rows, :2], var[:, None, None] * np.eye(2))
    return Reference(f"GNSS ({name})", fixes, (gnss.x_m, gnss.y_m), origin=origin)


def of_truth(path: Path, vehicle: Vehicle, spacing_ns: int = SPACING_NS) -> Reference:
    """A truth file's track.

    Args:
        path: ``truth.json`` or its folder.
        vehicle: Where the camera and the antenna sit, unless the truth says so.
        spacing_ns: How far apart its poses are taken.

    Raises:
        SchemaError: The file does not fit, or holds no pose.
    """
    truth, track = load_truth(path)
    rows = spaced(track.t_ns, spacing_ns)
    if not len(rows):
        raise EmptyResultError(f"{path}: its track has no pose; expected the true positions")
    var = (truth.position_sd_m or TRUTH_SD_M) ** 2
    cov = np.tile(var * np.eye(2), (len(rows), 1, 1))
    fixes = Fixes(track.t_ns[rows], track.xyz_m[rows, :2], cov)
    is_of_camera = truth.pose_point == "camera"
    mounting = mounting_of(truth, vehicle)
    lever_m = (mounting.x_m, mounting.y_m)
    return Reference(
        truth.source or path.name,
        fixes,
        lever_m,
        heading_rad(track)[rows],
        is_of_camera,
        is_map=True,
    )


def spaced(t_ns: Int64s, spacing_ns: int = SPACING_NS) -> Int64s:
    """Indices of rows about so far apart, the first among them."""
    kept: list[int] = []
    for row, t in enumerate(t_ns.tolist()):
        # A little early is on time: a row of a jittery clock.
        if not kept or t - int(t_ns[kept[-1]]) >= spacing_ns * 0.95:
            kept.append(row)
    return np.array(kept, np.int64)
