"""Read a KITTI odometry sequence in its published layout as a log, with truth from the poses.

``sequences/NN/`` holds ``image_0`` to ``image_3`` (``NNNNNN.png``), ``times.txt`` (seconds from the
first picture, one line each) and ``calib.txt`` (projection matrices P0 to P3 of the rectified
cameras). ``poses/NN.txt``, for sequences 00 to 10, has one line of twelve numbers per picture: the
upper rows of the matrix that transforms points of the left grey camera (image_0: x right, y down,
z ahead) to that camera's axes at the first picture. The scans in ``velodyne`` are not read.

Topics: one per camera folder and, if poses exist, ``odometry``: forward speed and yaw rate computed
from the poses, which are as accurate as the truth and not wheel speeds.

The truth is the left grey camera's trajectory. Its map has the first picture's axes in the
convention of REP-103: x ahead (their z), y left (their -x), z up (their -y).
"""

from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from crosscue.datasets.truth.truth import Mounting
from crosscue.datasets.truth.tum import Trajectory, mounting_in_car, write_track_truth
from crosscue.replay.columns import Floats, Int64s
from crosscue.replay.errors import LogFormatError
from crosscue.replay.limits import DEFAULT_LIMITS, Limits
from crosscue.replay.readers.held_rows import CameraDrive, HeldRows, Loss
from crosscue.replay.readers.images.files import list_pictures
from crosscue.replay.readers.time_file import read_time_file
from crosscue.replay.seal.touched import Touched

from .published import camera_of, lines_of, note_whole, numbered_files, odometry_of

SETUP: Final = (
    "Geiger, Lenz, Stiller, Urtasun, Vision meets Robotics: The KITTI Dataset (IJRR 2013), figure "
    "of the sensors' places on the car"
)
# Mounting of the GNSS/INS box; its yaw is the vehicle's, as defined in ``dataformat.txt``.
BOX: Final = Mounting(x_m=-0.05, y_m=0.32, z_m=0.93, roll_rad=None, pitch_rad=None)
# Rotation from right, down, ahead to ahead, left, up.
AXES: Final = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


class CameraTrajectory(NamedTuple):
    """Trajectory of the left grey camera.

    Attributes:
        t_ns: Times, shape (N,), int64.
        xyz_m: Positions ahead, left, up of the first picture, shape (N, 3).
        turn: N rotations from ahead, left, up of the camera to those axes.
        losses: Lines that could not be parsed.
        declared: Number of times or of poses, whichever is larger.
    """

    t_ns: Int64s
    xyz_m: Floats
    turn: Rotation
    losses: tuple[Loss, ...]
    declared: int

    def odometry(self) -> HeldRows:
        """Return forward speed and yaw rate, from differences between neighbours."""
        ahead = self.turn.apply((1.0, 0.0, 0.0))
        return odometry_of(self.t_ns, self.xyz_m, ahead, self.declared, self.losses)


class KittiOdometryDrive(CameraDrive):
    """One sequence as a ``Log``."""

    format: Final = "kitti-odometry"

    def intrinsics(self, camera: str) -> tuple[float, float, float] | None:
        """Return focal length and optical center of a rectified camera; None if not published.

        Raises:
            LogFormatError: The file is damaged.
        """
        return projection(self.path / "calib.txt", camera.rpartition("_")[2].lstrip("0") or "0")


def projection(file: Path, camera: str) -> tuple[float, float, float] | None:
    """Read focal length and optical center, px, of a rectified camera from a calibration file.

    Args:
        file: ``calib.txt`` of the odometry set, the file of a sequence of the tracking set, or
            ``calib_cam_to_cam.txt`` of the day of a raw drive.
        camera: Number of the camera.

    Raises:
        LogFormatError: The camera's line does not contain twelve numbers.
    """
    if not file.is_file():
        return None
    for line in lines_of(file):
        name, _, rest = line.partition(" ")
        if name.rstrip(":") in (f"P{camera}", f"P_rect_0{camera}"):
            numbers = _numbers(rest)
            if numbers is None or numbers[0] <= 0.0:
                raise LogFormatError(f"{file}: P{camera}: expected twelve numbers; copy it again")
            return float(numbers[0]), float(numbers[2]), float(numbers[6])
    return None


def open_kitti_odometry(path: Path, limits: Limits) -> KittiOdometryDrive:
    """Open a sequence's folder; see ``crosscue.replay.formats.FORMATS``.

    Raises:
        LogFormatError: There are no times, or no camera.
    """
    touched = Touched()
    times_file = path / "times.txt"
    if not times_file.is_file():
        raise LogFormatError(f"{times_file}: missing; expected a KITTI odometry sequence")
    times = read_time_file(times_file, limits)
    note_whole(touched, times_file)
    cameras = []
    for folder in sorted(path.glob("image_[0-9]")):
        paths = list_pictures(folder)
        if paths:
            cameras.append(camera_of(folder.name, numbered_files(paths, times.t_ns), touched))
    if not cameras:
        raise LogFormatError(f"{path}: no image_N with pictures; expected a KITTI sequence")
    unreadable: list[tuple[str, str, int | None, str]] = []
    odometry = None
    if (file := pose_file(path)) is not None:
        note_whole(touched, file)
        try:
            odometry = read_kitti_poses(path, limits).odometry()
        except LogFormatError as error:
            unreadable.append(("odometry", "file cannot be read", None, str(error)))
    notices = ["velodyne: laser scans are not read"] if (path / "velodyne").is_dir() else []
    numbers = () if odometry is None else (odometry,)
    if numbers:
        notices.append("odometry: computed from the true poses; do not score poses based on it")
    return KittiOdometryDrive(
        path, cameras, numbers, limits, touched, unreadable=unreadable, notices=notices
    )


def pose_file(path: Path) -> Path | None:
    """Find ``poses/NN.txt`` next to ``sequences``, or ``poses.txt`` in the sequence, or None."""
    here = path.resolve()
    for file in (here.parent.parent / "poses" / f"{here.name}.txt", here / "poses.txt"):
        if file.is_file():
            return file
    return None


def read_kitti_poses(path: Path, limits: Limits = DEFAULT_LIMITS) -> CameraTrajectory:
    """Read the poses of a sequence.

    Raises:
        LogFormatError: The file is missing, or contains fewer than two valid poses.
    """
    file = pose_file(path)
    if file is None:
        raise LogFormatError(
            f"{path}: no poses; expected ../../poses/{path.resolve().name}.txt, which the set "
            "publishes for sequences 00 to 10"
        )
    times = read_time_file(path / "times.txt", limits).t_ns
    found = [_numbers(line) for line in lines_of(file)]
    n = min(len(found), len(times))
    good = np.array([one is not None for one in found[:n]], np.bool_)
    bad = [f"line {i + 1}" for i, one in enumerate(found) if one is None]
    losses = (Loss("a pose that is not a matrix", len(bad), ", ".join(bad[:8])),) if bad else ()
    matrices = np.array([one for one in found[:n] if one is not None]).reshape(-1, 3, 4)
    t_ns = times[:n][good]
    if len(matrices) < 2 or not (np.diff(t_ns) > 0).all():
        raise LogFormatError(
            f"{file}: {len(matrices)} poses in order of time; expected two or more"
        )
    turn = Rotation.from_matrix(AXES @ matrices[:, :, :3] @ AXES.T)
    declared = max(len(times), len(found))
    return CameraTrajectory(t_ns, matrices[:, :, 3] @ AXES.T, turn, losses, declared)


def write_kitti_odometry_truth(path: Path, folder: Path) -> Path:
    """Write the trajectory of the left grey camera.

    Raises:
        LogFormatError: The sequence has no poses.
        OutputError: It cannot be written.
    """
    poses = read_kitti_poses(path)
    note = "KITTI odometry: the left grey camera; x ahead, y left, z up of the first picture"
    wxyz = poses.turn.as_quat()[:, [3, 0, 1, 2]]
    track = Trajectory(poses.t_ns, poses.xyz_m, wxyz)
    return write_track_truth(
        folder,
        path.resolve().name,
        track,
        note,
        pose_point="camera",
        **mounting_in_car(track, SETUP, x_m=1.03, y_m=0.0, z_m=1.65),
        source=(
            "KITTI odometry (CC BY-NC-SA 3.0): published poses of the left grey camera, image_0; "
            "other cameras sit beside it by -P[0, 3] / P[0, 0] of calib.txt, in metres to its right"
        ),
    )


def _numbers(text: str) -> Floats | None:
    """Parse twelve finite numbers; None for other lines."""
    try:
        numbers = np.array([float(part) for part in text.split()], np.float64)
    except ValueError:
        return None
    return numbers if len(numbers) == 12 and np.isfinite(numbers).all() else None
