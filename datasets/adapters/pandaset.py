"""Read a PandaSet sequence in its published folder layout as a log, with truth from the poses.

``camera/NAME/`` contains ``NN.jpg``, ``timestamps.json`` (seconds since 1970) and ``poses.json``
(position and orientation of the camera in a local frame; its axes are right, down, forward).
``meta/gps.json`` with ``meta/timestamps.json`` has one GNSS/INS row for each sweep of the lidar.
Lidar and annotations are not read: annotations are published as pickles, and loading a pickle runs
code. ``crosscue vehicle init`` uses the intrinsics.

Topics: one per camera; ``odometry`` (forward speed and yaw rate of the vehicle from the front
camera's poses, which are as accurate as the poses and not wheel speeds); ``gnss``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from scipy.spatial.transform import Rotation

from crosscue.datasets.truth.truth import Truth, save
from crosscue.datasets.truth.tum import Trajectory, mounting_in_car, write_tum
from crosscue.replay.columns import Floats, Int64s, Table, Topic
from crosscue.replay.errors import LogFormatError
from crosscue.replay.files.bounded import read_at_most
from crosscue.replay.files.tree_text import json_tree
from crosscue.replay.limits import MIB, Limits
from crosscue.replay.readers.held_rows import CameraDrive, HeldRows
from crosscue.replay.readers.images.files import PictureFiles, list_pictures
from crosscue.replay.readers.timed_files import TimedFiles
from crosscue.replay.seal.touched import Touched

POSE_FILE: Final = "pose.tum"
MAX_FILE_BYTES: Final = 64 * MIB
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

    def speed_mps(self) -> Floats:
        """Return the forward speed at each pose, shape (N,), from central differences.

        A rigid vehicle has the same forward speed everywhere along its axis, so this is the speed
        of the rear axle. Differences are one-sided at both ends.
        """
        seconds = (self.t_ns - self.t_ns[0]) * 1e-9
        velocity = np.gradient(self.xyz_m, seconds, axis=0)
        return np.asarray((velocity * self.forward).sum(axis=1), np.float64)

    def heading_rad(self) -> Floats:
        """Return the heading from x, counter-clockwise, continuous, shape (N,)."""
        return np.unwrap(np.arctan2(self.forward[:, 1], self.forward[:, 0]))

    def odometry(self) -> Table:
        """Return speed and yaw rate."""
        seconds = (self.t_ns - self.t_ns[0]) * 1e-9
        yaw_rate = np.gradient(self.heading_rad(), seconds)
        return Table({"speed_x_mps": self.speed_mps(), "yaw_rate_radps": yaw_rate})


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
        found = _json(file)
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
    for file in (one for pattern in READ_ON_OPENING for one in path.glob(pattern)):
        touched.add(file, 0, file.stat().st_size)
    for folder in sorted((path / "camera").iterdir()):
        paths = list_pictures(folder) if folder.is_dir() else []
        if not paths:
            continue
        try:
            files = _timed(paths, _times_ns(folder / "timestamps.json"))
        except LogFormatError as error:
            unreadable.append((folder.name, "times cannot be read", len(paths), str(error)))
            continue
        topic = Topic(folder.name, "crosscue/Images", "columns", declared=files.declared)
        cameras.append(PictureFiles(topic, files, touched))
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
    poses = _json(folder / "poses.json")
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
    folder.mkdir(parents=True, exist_ok=True)
    track = Trajectory(poses.t_ns, poses.xyz_m, wxyz)
    write_tum(folder / POSE_FILE, track, note)
    mounting, mounting_source = mounting_in_car(track)
    truth = Truth(
        version=1,
        log=path.resolve().name,
        start_ns=int(poses.t_ns[0]),
        end_ns=int(poses.t_ns[-1]) + 1,
        pose=POSE_FILE,
        pose_point="camera",
        mounting=mounting,
        mounting_source=mounting_source,
        source="PandaSet (Scale AI, Hesai; CC BY 4.0): published poses of the front camera",
    )
    return save(truth, folder)


def _odometry(path: Path) -> HeldRows | None:
    if not (path / "camera" / FRONT / "poses.json").is_file():
        return None
    poses = read_pandaset_poses(path)
    topic = Topic("odometry", "nav_msgs/msg/Odometry", "columns", declared=poses.declared)
    return HeldRows(topic, poses.t_ns, poses.odometry())


def _gnss(path: Path) -> HeldRows | None:
    file = path / "meta" / "gps.json"
    if not file.is_file():
        return None
    t_ns, rows = _times_ns(path / "meta" / "timestamps.json"), _json(file)
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


def _timed(paths: Sequence[Path], t_ns: Int64s) -> TimedFiles:
    """Assign the time with index NN to picture ``NN``."""
    places = np.array([int(p.stem) if p.stem.isdecimal() else -1 for p in paths], np.int64)
    is_timed = (places >= 0) & (places < len(t_ns))
    found = np.full(len(paths), -1, np.int64)
    found[is_timed] = t_ns[places[is_timed]]
    is_missing = np.ones(len(t_ns), np.bool_)
    is_missing[places[is_timed]] = False
    return TimedFiles(tuple(paths), found, t_ns[is_missing], len(t_ns), ())


def _times_ns(path: Path) -> Int64s:
    found = _json(path)
    try:
        seconds = np.array([float(value) for value in found], np.float64)
    except (TypeError, ValueError):
        raise LogFormatError(f"{path}: expected a list of seconds") from None
    if not np.isfinite(seconds).all() or (np.abs(seconds) > 9e9).any():
        raise LogFormatError(f"{path}: a time is not a number of seconds since 1970")
    # Times are published in microseconds; further digits are rounding errors of floats.
    return np.rint(seconds * 1e6).astype(np.int64) * 1000


def _json(path: Path) -> Any:
    try:
        content = read_at_most(path, MAX_FILE_BYTES)
        if content is None:
            raise LogFormatError(f"{path}: over {MAX_FILE_BYTES // MIB} MiB; not read")
        return json_tree(content)
    except OSError as error:
        raise LogFormatError(f"{path}: {error.strerror}; restore the file") from None
    except ValueError as error:
        raise LogFormatError(f"{path}: not JSON: {error}") from None
