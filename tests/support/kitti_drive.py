"""KITTI drives in the published layouts, raw and of the odometry benchmark: a left turn."""

from pathlib import Path
from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation

from crosscue.datasets.geodesy import ecef_to_enu_matrix, ecef_to_geodetic, geodetic_to_ecef
from crosscue.replay.columns import Floats
from support.pictures import picture

ORIGIN = (49.0, 8.4, 110.0)
SPEED_MPS = 10.0
YAW_RATE_RADPS = 0.2
FIRST = "2011-09-26 13:02:"


def dates(count: int, start_ns: int = 964_389_445) -> str:
    """Text of ``timestamps.txt`` at 10 Hz from 13:02:00 on, in nanoseconds."""
    lines = []
    for i in range(count):
        whole, rest = divmod(start_ns + 100_000_000 * i, 1_000_000_000)
        lines.append(f"{FIRST}{whole:02d}.{rest:09d}")
    return "\n".join(lines) + "\n"


def true_path(count: int) -> tuple[Floats, Floats]:
    """East and north in metres, shape (N, 2), and yaw in rad, shape (N,)."""
    yaw: Floats = YAW_RATE_RADPS * 0.1 * np.arange(count, dtype=np.float64)
    radius = SPEED_MPS / YAW_RATE_RADPS
    return radius * np.column_stack([np.sin(yaw), 1.0 - np.cos(yaw)]), yaw


def packet_lines(count: int) -> list[str]:
    east_north, yaw = true_path(count)
    enu = np.column_stack([east_north, np.zeros(count)])
    matrix = ecef_to_enu_matrix(np.radians(ORIGIN[0]), np.radians(ORIGIN[1]))
    lat, lon, alt = ecef_to_geodetic(geodetic_to_ecef(*ORIGIN) + enu @ matrix)
    lines = []
    for i in range(count):
        north, east = SPEED_MPS * np.sin(yaw[i]), SPEED_MPS * np.cos(yaw[i])
        sideways = SPEED_MPS * YAW_RATE_RADPS
        numbers = np.r_[
            (lat[i], lon[i], alt[i], 0.0, 0.0, np.arctan2(np.sin(yaw[i]), np.cos(yaw[i]))),
            (north, east, SPEED_MPS, 0.0, 0.0),  # velocities
            (0.0, sideways, 9.81, 0.0, sideways, 9.81),  # accelerations in two systems
            (0.0, 0.0, YAW_RATE_RADPS, 0.0, 0.0, YAW_RATE_RADPS, 0.05, 0.02),  # rates, accuracies
        ]
        lines.append(" ".join(repr(float(n)) for n in numbers) + " 4 9 4 4 0")
    return lines


def raw_drive(path: Path, count: int = 30, cameras: tuple[str, ...] = ("image_02",)) -> Path:
    (path / "oxts" / "data").mkdir(parents=True)
    (path / "oxts" / "timestamps.txt").write_text(dates(count))
    for i, line in enumerate(packet_lines(count)):
        (path / "oxts" / "data" / f"{i:010d}.txt").write_text(line + "\n")
    for camera in cameras:
        (path / camera / "data").mkdir(parents=True)
        (path / camera / "timestamps.txt").write_text(dates(count, 950_000_000))
        for i in range(count):
            (path / camera / "data" / f"{i:010d}.png").write_bytes(picture(i))
    return path


def tracking_drive(path: Path, count: int = 30) -> Path:
    """Write one sequence in the layout of the tracking benchmark."""
    (path / "oxts").mkdir(parents=True)
    (path / "oxts" / "0003.txt").write_text("\n".join(packet_lines(count)) + "\n")
    (path / "image_02" / "0003").mkdir(parents=True)
    for i in range(count):
        (path / "image_02" / "0003" / f"{i:06d}.png").write_bytes(picture(i))
    return path


FOCAL_PX: Final = 718.856


def pose_line(seconds: float) -> str:
    """The upper rows of the camera's pose matrix, with axes right, down, ahead."""
    yaw = YAW_RATE_RADPS * seconds
    radius = SPEED_MPS / YAW_RATE_RADPS
    # Left is -x and ahead is z. A left turn is negative about y, which points down.
    place = [-radius * (1.0 - np.cos(yaw)), 0.0, radius * np.sin(yaw)]
    matrix = np.column_stack([Rotation.from_euler("y", -yaw).as_matrix(), place])
    return " ".join(f"{value:.9e}" for value in matrix.ravel())


def kitti_odometry_drive(path: Path, count: int = 20) -> Path:
    """Write a sequence below ``path`` with its poses, and return its folder."""
    folder = path / "sequences" / "04"
    (folder / "image_2").mkdir(parents=True)
    for i in range(count):
        (folder / "image_2" / f"{i:06d}.png").write_bytes(picture(i))
    (folder / "times.txt").write_text("".join(f"{0.1 * i:.6e}\n" for i in range(count)))
    matrix = f"{FOCAL_PX} 0 607.19 {{}} 0 {FOCAL_PX} 185.22 0 0 0 1 0"
    lines = [f"P{i}: {matrix.format(-45.0 * i)}\n" for i in range(4)]
    (folder / "calib.txt").write_text("".join(lines))
    (path / "poses").mkdir()
    poses = "".join(f"{pose_line(0.1 * i)}\n" for i in range(count))
    (path / "poses" / "04.txt").write_text(poses)
    return folder
