"""Known positions of a drive, from its GNSS or a truth file."""

from dataclasses import dataclass
from pathlib import Path
from typing import Final, TypeAlias

import numpy as np

from crosscue.datasets.geodesy import geodetic_to_enu
from crosscue.datasets.truth.tum import heading_rad
from crosscue.eval.scoring.pose.score import load_truth, track_mounting
from crosscue.localization.fixes import Fixes
from crosscue.replay.columns import Floats, Int64s
from crosscue.replay.errors import EmptyResultError
from crosscue.replay.signals.kinds import Samples
from crosscue.replay.vehicle.vehicle import Vehicle

# Latitude and longitude in degrees, altitude in metres.
GeodeticOrigin: TypeAlias = tuple[float, float, float]
# Min spacing of positions; nearer ones add little, because their errors are correlated.
SPACING_NS: Final = 1_000_000_000
# Initial s.d. of a truth file that states no quality; the fit estimates it.
TRUTH_SD_M: Final = 0.3


@dataclass(frozen=True, slots=True, eq=False)
class ReferencePositions:
    """Positions of a point of the vehicle, in a plane local frame.

    Attributes:
        name: Source of the positions.
        fixes: Positions about a second apart.
        lever_m: Position of the point, ahead of and to the left of the rear axle.
        heading_rad: Heading of the tracked body, shape (N,); None if unknown.
        is_of_camera: True if the tracked body is the camera.
        is_map: True if the frame is the map of a truth file, in which runs are scored.
        origin: Geodetic position of the frame's origin.
    """

    name: str
    fixes: Fixes
    lever_m: tuple[float, float]
    heading_rad: Floats | None = None
    is_of_camera: bool = False
    is_map: bool = False
    origin: GeodeticOrigin | None = None


def of_gnss(name: str, samples: Samples, vehicle: Vehicle) -> ReferencePositions:
    """Return the receiver's positions in a frame centred on the first one.

    Args:
        name: Name of the topic.
        samples: Samples of ``Signal.POSITION``.
        vehicle: The antenna's mounting, and the s.d. of positions without a covariance.
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
    return ReferencePositions(f"GNSS ({name})", fixes, (gnss.x_m, gnss.y_m), origin=origin)


def of_truth(path: Path, vehicle: Vehicle, spacing_ns: int = SPACING_NS) -> ReferencePositions:
    """Return the track of a truth file.

    Args:
        path: ``truth.json`` or its folder.
        vehicle: Mounting of the camera and the antenna, unless the truth states it.
        spacing_ns: Spacing of the poses used.

    Raises:
        SchemaError: The file is invalid, or has no pose.
    """
    truth, track = load_truth(path)
    rows = spaced(track.t_ns, spacing_ns)
    if not len(rows):
        raise EmptyResultError(f"{path}: its track has no pose; expected the true positions")
    var = (truth.position_sd_m or TRUTH_SD_M) ** 2
    cov = np.tile(var * np.eye(2), (len(rows), 1, 1))
    fixes = Fixes(track.t_ns[rows], track.xyz_m[rows, :2], cov)
    is_of_camera = truth.pose_point == "camera"
    mounting = track_mounting(truth, vehicle)
    lever_m = (mounting.x_m, mounting.y_m)
    return ReferencePositions(
        truth.source or path.name,
        fixes,
        lever_m,
        heading_rad(track)[rows],
        is_of_camera,
        is_map=True,
    )


def spaced(t_ns: Int64s, spacing_ns: int = SPACING_NS) -> Int64s:
    """Return indices of rows that are about ``spacing_ns`` apart, including the first."""
    kept: list[int] = []
    for row, t in enumerate(t_ns.tolist()):
        # Rows slightly early are accepted, because clocks jitter.
        if not kept or t - int(t_ns[kept[-1]]) >= spacing_ns * 0.95:
            kept.append(row)
    return np.array(kept, np.int64)
