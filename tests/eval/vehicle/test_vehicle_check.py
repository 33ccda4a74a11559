"""Check of a vehicle file against a drive: signals, and intrinsics against pictures."""

from pathlib import Path

import numpy as np
import pytest

from crosscue.eval.vehicle.check import Checked, _normalized, check_drive_signals
from crosscue.eval.vehicle.drive_check import check_vehicle
from crosscue.replay.base import EVERYTHING
from crosscue.replay.columns import Block, Table, Topic
from crosscue.replay.vehicle.drafting.series import Series
from crosscue.replay.vehicle.pose import Odometry
from crosscue.replay.vehicle.vehicle import Vehicle
from support.memory_log import GYRO, WHEELS, MemoryLog, gyro_block
from support.pandaset_drive import pandaset_drive
from support.refusals import refusal

FIX = Topic("fix", "sensor_msgs/msg/NavSatFix", "columns")


def checked_signals(yaw_sign: float = 1.0, wheel_scale: float = 1.0) -> Checked:
    """Check a simulated log: 20 s of bends at 10 m/s with wheels, gyro and GNSS."""
    times = np.arange(400, dtype=np.int64) * 50_000_000
    yaw_rate = 0.3 * np.sin(0.8 * times * 1e-9)
    course = np.cumsum(yaw_rate) * 0.05
    blocks: list[Block] = []
    for start in range(0, 400, 20):
        some = slice(start, start + 20)
        speeds = {
            f"{end}_{side}_mps": wheel_scale * (10.0 + sign * 0.775 * yaw_rate[some])
            for end in ("front", "rear")
            for side, sign in (("left", -1.0), ("right", 1.0))
        }
        blocks.append(Block("wheels", times[some], Table(speeds)))
        blocks.append(gyro_block(times[some].tolist(), (yaw_sign * yaw_rate[some]).tolist()))
        fix = {"course_rad": course[some], "speed_mps": np.full(20, 10.0)}
        blocks.append(Block("fix", times[some], Table(fix)))
    log = MemoryLog((WHEELS, GYRO, FIX), blocks, path=Path(__file__))
    return check_drive_signals([log], Vehicle(version=1), EVERYTHING)


def test_yaw_rate_of_wrong_sign_is_a_contradiction() -> None:
    assert any(
        "positive to the right" in text for text in checked_signals(yaw_sign=-1.0).contradictions
    )


def test_steering_is_compared_without_offset_at_a_ratio_of_15() -> None:
    odometry = Odometry(steering_ratio=30.0, steering_offset_rad=0.1)
    wheel = Series.of("steering", np.array([0, 1], np.int64), np.array([0.1, 0.5]))

    found = _normalized(wheel, Vehicle(version=1, odometry=odometry))

    np.testing.assert_allclose(found.values, [0.0, 0.2], atol=1e-12)


def write_vehicle(path: Path, camera: str) -> Path:
    path.write_text(f"version = 1\n[camera]\n{camera}\n")
    return path


@pytest.mark.parametrize(
    ("camera", "message"),
    [
        ("focal_px = 1970.0\ncenter_px = [970.5, 483.0]", "center_px = (970.5, 483): outside"),
        ("focal_px = 20000.0", "focal_px = 20000: images"),
        ("focal_px = 1970.0\nsize_px = [1920, 1080]", "size_px = [1920, 1080]: the images are"),
        ("focal_px = 1500.0", "the data set publishes 1970"),
    ],
)
def test_intrinsics_of_other_pictures_are_contradictions(
    tmp_path: Path, camera: str, message: str
) -> None:
    drive = pandaset_drive(tmp_path / "002")
    vehicle = write_vehicle(tmp_path / "car.toml", camera)

    found = check_vehicle(drive, vehicle)

    # The generated pictures are tiny, with the published intrinsics of 1920 x 1080.
    assert any(message in text for text in found.contradictions)
    assert f"WRONG    {found.contradictions[0]}" in repr(found)


@pytest.mark.parametrize(
    ("arguments", "status", "message"),
    [
        (["-o", "page.pdf"], 2, "expected a page or a picture"),
        (["--seconds", "0"], 2, "--seconds 0: expected more than 0"),
        (["--start-s", "1000"], 1, "no signal and no picture"),
    ],
)
def test_invalid_check_options_are_refused_in_one_line(
    tmp_path: Path, arguments: list[str], status: int, message: str
) -> None:
    drive = pandaset_drive(tmp_path / "002")
    vehicle = write_vehicle(tmp_path / "car.toml", "focal_px = 1500.0")

    assert message in refusal(status, "check", drive, vehicle, *arguments)
