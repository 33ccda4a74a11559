"""KITTI odometry: the camera's track in a level map frame, and its pictures."""

from pathlib import Path

import numpy as np
import pytest

import crosscue
from crosscue.datasets.adapters.kitti_odometry import read_kitti_poses, write_kitti_odometry_truth
from crosscue.datasets.truth.truth import read_truth
from crosscue.datasets.truth.tum import heading_rad, read_tum
from crosscue.replay.columns import Table
from crosscue.replay.errors import LogFormatError
from crosscue.replay.logs.opening import open_log
from support.accounted import read_topics, times
from support.kitti_odometry_drive import FOCAL_PX, SPEED_MPS, YAW_RATE_RADPS, kitti_odometry_drive


def test_left_turn_has_positive_yaw_rate_and_heading(tmp_path: Path) -> None:
    folder = kitti_odometry_drive(tmp_path)

    odometry = read_kitti_poses(folder).odometry().rows
    assert isinstance(odometry, Table)
    truth = read_truth(write_kitti_odometry_truth(folder, tmp_path / "truth"))

    np.testing.assert_allclose(np.asarray(odometry["speed_x_mps"], float), SPEED_MPS, rtol=2e-3)
    np.testing.assert_allclose(
        np.asarray(odometry["yaw_rate_radps"], float), YAW_RATE_RADPS, rtol=1e-6
    )
    assert truth.pose_point == "camera"
    assert "image_0" in truth.source
    track = read_tum(tmp_path / "truth" / str(truth.pose))
    seconds = track.t_ns * 1e-9
    radius = SPEED_MPS / YAW_RATE_RADPS
    np.testing.assert_allclose(heading_rad(track), YAW_RATE_RADPS * seconds, atol=1e-6)
    np.testing.assert_allclose(track.xyz_m[:, 0], radius * np.sin(0.2 * seconds), atol=1e-5)
    np.testing.assert_allclose(track.xyz_m[:, 1], radius * (1 - np.cos(0.2 * seconds)), atol=1e-5)
    np.testing.assert_allclose(track.xyz_m[:, 2], 0.0, atol=1e-9)


def test_damaged_pose_drops_one_row(tmp_path: Path) -> None:
    folder = kitti_odometry_drive(tmp_path)
    file = tmp_path / "poses" / "04.txt"
    lines = file.read_text().splitlines()
    lines[7] = "?" * 40
    file.write_text("\n".join(lines) + "\n")

    found, ledger = read_topics(folder)

    assert len(times(found["odometry"])) == 19
    assert ledger.topic("odometry").dropped.total() == 1
    assert not ledger.topic("odometry").dropped_unknown


def test_drafted_vehicle_has_published_intrinsics(tmp_path: Path) -> None:
    camera = crosscue.draft_vehicle(kitti_odometry_drive(tmp_path)).vehicle.camera

    assert camera.focal_px == FOCAL_PX
    assert camera.center_px == (607.19, 185.22)


def test_sequence_without_poses_has_pictures_but_no_truth(tmp_path: Path) -> None:
    folder = kitti_odometry_drive(tmp_path)
    (tmp_path / "poses" / "04.txt").unlink()

    with open_log(folder) as log:
        assert [topic.name for topic in log.topics] == ["image_2"]
    with pytest.raises(LogFormatError, match="sequences 00 to 10"):
        write_kitti_odometry_truth(folder, tmp_path / "truth")
