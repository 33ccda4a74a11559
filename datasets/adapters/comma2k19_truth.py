"""Write the true pose of a comma2k19 segment as ``truth.json`` with a TUM trajectory."""

from pathlib import Path
from typing import Final

import numpy as np

from crosscue.datasets.geodesy import ecef_to_enu_matrix, ecef_to_geodetic
from crosscue.datasets.truth.truth import Origin
from crosscue.datasets.truth.tum import Trajectory, mounting_in_car, write_track_truth
from crosscue.replay.columns import Floats
from crosscue.replay.errors import LogFormatError

from .comma2k19 import read_column

# Upper bound on times of recordings, in seconds since 1970 or since the start.
LATEST_S: Final = 9e9


def write_comma_truth(path: Path, folder: Path) -> Path:
    """Write the camera's true trajectory, relative to its first position.

    Raises:
        LogFormatError: The segment contains no pose.
        OutputError: It cannot be written.
    """
    from scipy.spatial.transform import Rotation

    times, position, quat = (
        _numbers(path / "global_pose" / name, shape)
        for name, shape in (
            ("frame_times", ()),
            ("frame_positions", (3,)),
            ("frame_orientations", (4,)),
        )
    )
    n = min(len(times), len(position), len(quat))
    if n < 2:
        raise LogFormatError(f"{path}/global_pose: {n} poses; the segment contains no usable truth")
    if not (np.diff(times[:n]) > 0.0).all() or np.abs(times).max() > LATEST_S:
        raise LogFormatError(f"{path}/global_pose/frame_times: expected increasing times")
    if not np.linalg.norm(quat[:n], axis=1).all():
        raise LogFormatError(f"{path}/global_pose/frame_orientations: zeros; copy it again")
    t_ns = np.rint(times[:n] * 1e9).astype(np.int64)
    xyz = position[:n]
    latitude, longitude, altitude = (float(part[0]) for part in ecef_to_geodetic(xyz[:1]))
    enu_r_ecef = ecef_to_enu_matrix(np.deg2rad(latitude), np.deg2rad(longitude))
    east_north_up = (xyz - xyz[0]) @ enu_r_ecef.T
    # The quaternions (w first) rotate the camera's forward, right and down axes to earth-fixed
    # axes. The data set's documentation specifies the inverse, but only with this convention does
    # forward agree with the recorded velocity (to 0.998).
    ecef_r_camera = Rotation.from_quat(np.roll(quat[:n], -1, axis=1))
    camera_r_car = Rotation.from_matrix(np.diag([1.0, -1.0, -1.0]))
    enu_r_car = Rotation.from_matrix(enu_r_ecef) * ecef_r_camera * camera_r_car
    quat_wxyz = np.roll(enu_r_car.as_quat(canonical=True), 1, axis=1)
    track = Trajectory(t_ns, east_north_up, quat_wxyz)
    note = "comma2k19 global_pose: the camera in a local frame, x east, y north, z up"
    return write_track_truth(
        folder,
        path.name,
        track,
        note,
        pose_point="camera",
        **mounting_in_car(track),
        origin=Origin(latitude_deg=latitude, longitude_deg=longitude, altitude_m=altitude),
        source="comma2k19: tightly coupled INS, GNSS and vision, smoothed offline",
    )


def _numbers(path: Path, shape: tuple[int, ...]) -> Floats:
    """Read rows of finite numbers with one shape."""
    rows = read_column(path).rows
    if rows.dtype.kind not in "iuf" or rows.shape[1:] != shape or not np.isfinite(rows).all():
        raise LogFormatError(
            f"{path}: expected finite numbers in rows of {shape or 1}, found {rows.dtype} in rows "
            f"of {rows.shape[1:] or 1}; copy it again"
        )
    return np.asarray(rows, np.float64)
