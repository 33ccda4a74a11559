"""Read a PandaSet sequence in its published folder layout as a log, with truth from the poses.

``camera/NAME/`` contains ``NN.jpg``, ``timestamps.json`` (seconds since 1970) and ``poses.json``
(position and orientation of the camera in a local frame; its axes are right, down, forward).
``meta/gps.json`` with ``meta/timestamps.json`` has one GNSS/INS row for each sweep of the lidar.
Lidar and annotations are not read: annotations are published as pickles, and loading a pickle runs
code. ``crosscue vehicle init`` uses the intrinsics.

Topics: one per camera; ``odometry`` (forward speed and yaw rate of the vehicle from the front
camera's poses, which are as accurate as the poses and not wheel speeds); ``gnss``.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation

from crosscue.datasets.truth.tum import Trajectory, mounting_in_car, write_track_truth
from crosscue.replay.columns import Floats, Int64s, Table, Topic
from crosscue.replay.errors import LogFormatError
from crosscue.replay.limits import Limits
from crosscue.replay.readers.held_rows import CameraDrive, HeldRows
from crosscue.replay.readers.images.files import list_pictures
from crosscue.replay.seal.touched import Touched

from .published import camera_of, json_of, note_whole, numbered_files, odometry_of

FRONT: Final = "front_camera"
_GNSS: Final = {
    "lat": "latitude_deg",
    "long": "longitude_deg",
    "height": "altitude_m",
    "xvel": "velocity_east_mps",
    "yvel": "velocity_north_mps",
}


@dataclass(frozen=True, slots=True, eq=False)
class PandasetPoses:
    """Trajectory of a camera.

    Attributes:
        t_ns: Times, shape (N,), int64.
        xyz_m: Positions in the local frame, shape (N, 3), float64.
        forward: Direction of the optical axis in that frame, shape (N, 3).
        left: Direction to the left in the picture, shape (N, 3).
        declared: Number of times or of poses, whichever is larger.
    """

    t_ns: Int64s
    xyz_m: Floats
    forward: Floats
    left: Floats
    declared: int

    def odometry(self) -> HeldRows:
        """Return forward speed and yaw rate of the vehicle."""
        return odometry_of(self.t_ns, self.xyz_m, self.forward, self.declared)


class PandasetDrive(CameraDrive):
    """One sequence as a ``Log``."""

    format: Final = "pandaset"

    def intrinsics(self, camera: str) -> tuple[float, float, float] | None:
        """Return focal length and optical center of a camera, px; None if not published.

        Raises:
            LogFormatError: The file is damaged.
        """
        file = self.path / "camera" / camera / "intrinsics.json"
        if not file.is_file():
            return None
        found = json_of(file)
        try:
            focal, x, y = (float(found[name]) for name in ("fx", "cx", "cy"))
        except (TypeError, KeyError, ValueError):
            raise LogFormatError(f"{file}: expected fx, cx and cy in pixels") from None
        if not (0.0 < focal < np.inf and np.isfinite([x, y]).all()):
            raise LogFormatError(f"{file}: fx {focal}, cx {x}, cy {y}: expected numbers of pixels")
        return focal, x, y


READ_ON_OPENING: Final = (
    "camera/*/timestamps.json",
    f"camera/{FRONT}/poses.json",
    "meta/gps.json",
    "meta/timestamps.json",
)


def open_pandaset(path: Path, limits: Limits) -> PandasetDrive:
    """Open a sequence's folder; see ``crosscue.replay.formats.FORMATS``.

    Raises:
        LogFormatError: There is neither a camera with times nor poses.
    """
    unreadable: list[tuple[str, str, int | None, str]] = []
    cameras, touched = [], Touched()
    for pattern in READ_ON_OPENING:
        note_whole(touched, *path.glob(pattern))
    for folder in sorted((path / "camera").iterdir()):
        paths = list_pictures(folder) if folder.is_dir() else []
        if not paths:
            continue
        try:
            files = numbered_files(paths, _times_ns(folder / "timestamps.json"))
        except LogFormatError as error:
            unreadable.append((folder.name, "times cannot be read", len(paths), str(error)))
            continue
        cameras.append(camera_of(folder.name, files, touched))
    rows = []
    for name, read in (("odometry", _odometry), ("gnss", _gnss)):
        try:
            found = read(path)
        except LogFormatError as error:
            unreadable.append((name, "file cannot be read", None, str(error)))
            continue
        if found is not None:
            rows.append(found)
    if not cameras and not rows:
        why = unreadable[0][3] if unreadable else "no camera with pictures and timestamps.json"
        raise LogFormatError(f"{path}: no stream of a PandaSet sequence can be read: {why}")
    notices = ("lidar: sweeps are not read",) if (path / "lidar").is_dir() else ()
    return PandasetDrive(
        path, cameras, rows, limits, touched, unreadable=unreadable, notices=notices
    )


def read_pandaset_poses(path: Path, camera: str = FRONT) -> PandasetPoses:
    """Read the poses of a camera.

    Args:
        path: Folder of the sequence.
        camera: Name of a folder in ``camera``.

    Raises:
        LogFormatError: A file is missing or damaged, or there are fewer than two poses.
    """
    folder = path / "camera" / camera
    t_ns = _times_ns(folder / "timestamps.json")
    poses = json_of(folder / "poses.json")
    try:
        xyz = np.array([[p["position"][a] for a in "xyz"] for p in poses], np.float64)
        wxyz = np.array([[p["heading"][a] for a in "wxyz"] for p in poses], np.float64)
        turn = Rotation.from_quat(wxyz[:, [1, 2, 3, 0]])
    except (TypeError, KeyError, ValueError, IndexError) as error:
        raise LogFormatError(
            f"{folder / 'poses.json'}: expected a list of position x, y, z and heading w, x, y, z: "
            f"{error!r}"
        ) from None
    n = min(len(t_ns), len(xyz))
    if n < 2 or not np.isfinite(xyz).all() or not (np.diff(t_ns) > 0).all():
        raise LogFormatError(f"{folder / 'poses.json'}: {n} poses in order; expected two or more")
    forward, left = (turn.apply(axis) for axis in ((0.0, 0.0, 1.0), (-1.0, 0.0, 0.0)))
    return PandasetPoses(t_ns[:n], xyz[:n], forward[:n], left[:n], max(len(t_ns), len(xyz)))


def write_pandaset_truth(path: Path, folder: Path) -> Path:
    """Write the trajectory of the front camera.

    Raises:
        LogFormatError: The sequence has no poses.
        OutputError: It cannot be written.
    """
    poses = read_pandaset_poses(path)
    up = np.cross(poses.forward, poses.left)
    turn = Rotation.from_matrix(np.stack([poses.forward, poses.left, up], axis=2))
    wxyz = turn.as_quat()[:, [3, 0, 1, 2]]
    note = "PandaSet: the front camera in the sequence's local frame, z up"
    track = Trajectory(poses.t_ns, poses.xyz_m, wxyz)
    return write_track_truth(
        folder,
        path.resolve().name,
        track,
        note,
        pose_point="camera",
        **mounting_in_car(track),
        source="PandaSet (Scale AI, Hesai; CC BY 4.0): published poses of the front camera",
    )


def _odometry(path: Path) -> HeldRows | None:
    if not (path / "camera" / FRONT / "poses.json").is_file():
        return None
    return read_pandaset_poses(path).odometry()


def _gnss(path: Path) -> HeldRows | None:
    file = path / "meta" / "gps.json"
    if not file.is_file():
        return None
    t_ns, rows = _times_ns(path / "meta" / "timestamps.json"), json_of(file)
    try:
        columns = {
            name: np.array([float(row[key]) for row in rows], np.float64)[: len(t_ns)]
            for key, name in _GNSS.items()
        }
    except (TypeError, KeyError, ValueError) as error:
        raise LogFormatError(
            f"{file}: expected {', '.join(_GNSS)} in each row: {error!r}"
        ) from None
    n, declared = len(columns["latitude_deg"]), max(len(t_ns), len(rows))
    topic = Topic("gnss", "sensor_msgs/msg/NavSatFix", "columns", declared=declared)
    return HeldRows(topic, t_ns[:n], Table(columns))


def _times_ns(path: Path) -> Int64s:
    found = json_of(path)
    try:
        seconds = np.array([float(value) for value in found], np.float64)
    except (TypeError, ValueError):
        raise LogFormatError(f"{path}: expected a list of seconds") from None
    if not np.isfinite(seconds).all() or (np.abs(seconds) > 9e9).any():
        raise LogFormatError(f"{path}: a time is not a number of seconds since 1970")
    # Times are published in microseconds; further digits are rounding errors of floats.
    return np.rint(seconds * 1e6).astype(np.int64) * 1000
