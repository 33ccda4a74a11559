"""Every data set fulfils the contract of ``crosscue.testing.check_dataset``."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Final

import numpy as np
import pytest

from crosscue.datasets.truth.truth import CARRIED
from crosscue.testing import check_dataset
from support.kitti_drive import raw_drive
from support.kitti_odometry_drive import kitti_odometry_drive
from support.nuscenes_drive import nuscenes_drive
from support.pandaset_drive import pandaset_drive


def _comma(path: Path) -> Path:
    """Write a segment of ten seconds along a straight road near Paris, with its speed."""
    times = np.arange(200) * 0.05
    east = np.outer(20.0 * times, (-0.0406, 0.9992, 0.0))
    arrays = {
        "processed_log/CAN/speed/t": times,
        "processed_log/CAN/speed/value": np.full((200, 1), 20.0),
        "global_pose/frame_times": times,
        "global_pose/frame_positions": np.array((4_201_000.0, 171_000.0, 4_780_000.0)) + east,
        "global_pose/frame_velocities": np.gradient(east, 0.05, axis=0),
        "global_pose/frame_orientations": np.tile((1.0, 0.0, 0.0, 0.0), (200, 1)),
        "global_pose/frame_gps_times": np.stack([np.full(200, 2000.0), times], axis=1),
    }
    for name, rows in arrays.items():
        (path / name).parent.mkdir(parents=True, exist_ok=True)
        with (path / name).open("wb") as file:
            np.save(file, rows)
    return path


# By format: a function that writes a small drive.
DRIVES: Final[dict[str, Callable[[Path], Path]]] = {
    "comma2k19": _comma,
    "kitti-raw": raw_drive,
    "kitti-odometry": kitti_odometry_drive,
    "nuscenes": nuscenes_drive,
    "pandaset": pandaset_drive,
}


def test_every_data_set_has_sample_drive() -> None:
    assert DRIVES.keys() == CARRIED.keys()


@pytest.mark.parametrize("name", sorted(CARRIED))
def test_every_data_set_fulfils_contract(name: str, tmp_path: Path) -> None:
    check_dataset(DRIVES[name](tmp_path / "drive"), tmp_path / "truth")
