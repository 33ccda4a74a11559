"""The true pose that a comma2k19 segment carries, as ``truth.json`` with a TUM trajectory."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np

from crosscue.datasets.geodesy import ecef_to_enu_matrix, ecef_to_geodetic
from crosscue.datasets.truth.truth import Origin, Truth, save
from crosscue.datasets.truth.tum import Trajectory, write_tum
from crosscue.replay.columns import Floats
from crosscue.replay.errors import LogFormatError

from .npy import read_column

POSE_FILE: Final = "pose.tum"


def write(path: Path, folder: Path) -> Path:
    """Write the camera's true track, relative to its first position.

    Raises:
        LogFormatError: The segment carries no pose.
        OutputError: It cannot be written.
    """
    times, position, quat = (
        read_column(path / "global_pose" / name).rows
        for name in ("frame_times", "frame_positions", "frame_orientations")
    )
    n = min(len(times), len(position), len(quat))
    if n < 2:
        raise LogFormatError(f"{path}/global_pose: {n} poses; the segment carries no usable truth")
    t_ns = np.rint(np.asarray(times[:n], np.float64) * 1e9).astype(np.int64)
    xyz = np.asarray(position[:n], np.float64)
    latitude, longitude, altitude = (float(part[0]) for part in ecef_to_geodetic(xyz[:1]))
    enu_r_ecef = ecef_to_enu_matrix(np.deg2rad(latitude), np.deg2rad(longitude))
    east_north_up = (xyz - xyz[0]) @ enu_r_ecef.T
    enu_r_car = enu_r_ecef @ _matrices(np.asarray(quat[:n], np.float64)) @ np.diag([1.0, -1, -1])
    track = Trajectory(t_ns, east_north_up, _quaternions(enu_r_car))
    note = "comma2k19 global_pose: the camera in a local frame, x east, y north, z up"
    folder.mkdir(parents=True, exist_ok=True)
    write_tum(folder / POSE_FILE, track, note)
    return save(
        Truth(
            version=1,
            log=path.name,
            start_ns=int(t_ns[0]),
            end_ns=int(t_ns[-1]) + 1,
            pose=POSE_FILE,
            pose_point="camera",
            origin=Origin(latitude_deg=latitude, longitude_deg=longitude, altitude_m=altitude),
            source="comma2k19: tightly coupled INS, GNSS and vision, smoothed offline",
        ),
        folder,
    )


def _matrices(quat_wxyz: Floats) -> Floats:
    """Rotation matrices of the set's quaternions, shape (N, 3, 3).

    Their columns are the camera's forward, right and down axes in earth-fixed axes: the set's own
    text names the inverse, but only so does forward agree with the recorded velocity (to 0.998).
    """
    w, x, y, z = (quat_wxyz / np.linalg.norm(quat_wxyz, axis=1, keepdims=True)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def _quaternions(matrix: Floats) -> Floats:
    """Unit quaternions w, x, y, z of rotation matrices (Bar-Itzhack's eigenvector method)."""
    m = matrix
    k = np.empty((len(m), 4, 4))
    k[:, 0, 0] = m[:, 0, 0] + m[:, 1, 1] + m[:, 2, 2]
    vector = np.stack(
        [m[:, 2, 1] - m[:, 1, 2], m[:, 0, 2] - m[:, 2, 0], m[:, 1, 0] - m[:, 0, 1]], axis=1
    )
    k[:, 0, 1:] = vector
    k[:, 1:, 0] = vector
    k[:, 1:, 1:] = m + np.swapaxes(m, 1, 2) - k[:, :1, :1] * np.eye(3)
    quat = np.linalg.eigh(k)[1][:, :, -1]
    return quat * np.where(quat[:, :1] < 0.0, -1.0, 1.0)
