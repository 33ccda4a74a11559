"""A simulated KITTI odometry sequence in the published layout: a constant left turn."""

from pathlib import Path
from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation

from support.pictures import picture

SPEED_MPS: Final = 10.0
YAW_RATE_RADPS: Final = 0.2
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
