"""Focal length, angles, height and delay of a camera, from the drive alone."""

import math
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

import crosscue
from crosscue.eval.quality.verdict import LogCheck
from crosscue.replay.columns import Block, Bytes, Images, Int64s, Messages, Topic
from crosscue.replay.ledger import Ledger
from crosscue.replay.signals.extractor import SampleExtractor
from crosscue.replay.signals.plan import pictures_only
from crosscue.replay.vehicle.vehicle import parse
from support.data import shared

RATE_HZ = 9.64
FOCAL_PX, CENTER_PX = 707.0912, (601.8873, 183.1104)


def sequence(folder: Path, source: Path, *, calibrated: bool, step_deg: float = 0.0) -> Path:
    """A sequence in the published layout; the camera may pitch in the middle of it."""
    (folder / "image_0").mkdir(parents=True)
    files = sorted(one for one in source.iterdir() if one.suffix in (".png", ".jpg"))
    for i, file in enumerate(files):
        grey = np.asarray(cv2.imread(str(file), cv2.IMREAD_GRAYSCALE), np.uint8)
        if step_deg and i >= len(files) // 2:
            grey = pitched(grey, step_deg)
        cv2.imwrite(str(folder / "image_0" / f"{i:06d}.png"), grey)
    times = "".join(f"{i / RATE_HZ:.6f}\n" for i in range(len(files)))
    (folder / "times.txt").write_text(times)
    shutil.copy(source.parent / "poses.txt", folder)
    if calibrated:
        text = (source.parent / "calib.txt").read_text()
        (folder / "calib.txt").write_text(text if text.startswith("P0") else f"P0: {text}")
    return folder


def pitched(grey: Bytes, by_deg: float) -> Bytes:
    """The picture of a camera that points further down."""
    matrix = np.array([[FOCAL_PX, 0, CENTER_PX[0]], [0, FOCAL_PX, CENTER_PX[1]], [0, 0, 1.0]])
    cos, sin = math.cos(math.radians(by_deg)), math.sin(math.radians(by_deg))
    turn = np.array([[1.0, 0, 0], [0, cos, -sin], [0, sin, cos]])
    size = (grey.shape[1], grey.shape[0])
    moved = cv2.warpPerspective(
        grey, matrix @ turn @ np.linalg.inv(matrix), size, borderMode=cv2.BORDER_REPLICATE
    )
    return np.asarray(moved, np.uint8)


def test_focal_length_and_delay_of_a_real_turn_are_found(tmp_path: Path) -> None:
    source = shared("sequences", "kitti_seq2_right_turn_98deg", "image_l")
    text = crosscue.draft_vehicle(sequence(tmp_path / "04", source, calibrated=False)).text

    camera = parse(text, "the draft").camera
    assert camera.focal_px == pytest.approx(718.856, rel=0.05)
    assert "px, from turns" in text
    # The pictures' true delay is not known, but it is small, so it is not set.
    assert camera.delay_s == 0.0
    late_ms = float(text.partition("# delay_s = ")[2].split()[0]) * 1e3
    assert abs(late_ms) < 15.0
    assert "pitch and yaw not estimated" in text


def test_angles_and_height_of_a_real_straight_road_are_found(tmp_path: Path) -> None:
    source = shared("sequences", "kitti_t_junction", "image_0")
    text = crosscue.draft_vehicle(sequence(tmp_path / "05", source, calibrated=True)).text

    camera = parse(text, "the draft").camera
    assert camera.z_m == pytest.approx(1.65, rel=0.05)
    # By the published poses the axis points 1.22 degrees below the direction of travel, and 0.12 to
    # its right.
    assert math.degrees(camera.pitch_rad) == pytest.approx(1.22, abs=0.3)
    assert math.degrees(camera.yaw_rad) == pytest.approx(-0.12, abs=0.3)


@pytest.mark.parametrize("step_deg", [0.0, 0.5])
def test_step_of_half_a_degree_on_a_real_road_is_found_and_none_where_there_is_none(
    tmp_path: Path, step_deg: float
) -> None:
    source = shared("sequences", "kitti_t_junction", "image_0")
    log = sequence(tmp_path / "05", source, calibrated=True, step_deg=step_deg)

    (row,) = crosscue.check(log, purposes=["range"])

    assert isinstance(row.result, LogCheck)
    found = [one.text for one in row.result.findings if one.check == "mounting"]
    if not step_deg:
        assert found == []
    else:
        (text,) = found
        assert "pitch changed by" in text
        assert float(text.split("by ")[1].split()[0]) == pytest.approx(step_deg, abs=0.25)


def test_delay_of_the_vehicle_file_is_subtracted_from_the_stamps_of_pictures() -> None:
    topic = Topic("camera", "crosscue/Images", "columns")
    raw = np.zeros(4, np.uint8)
    at = np.arange(2, dtype=np.int64) * 2
    t_ns: Int64s = np.array([1_000_000_000, 1_100_000_000], np.int64)
    block = Block("camera", t_ns, Images(Messages(raw, at, at + 2), ("png", "png")))
    shown: list[Int64s] = []
    vehicle = parse("version = 1\n[camera]\ndelay_s = 0.025\n", "test")
    extractor = SampleExtractor(
        pictures_only((0, topic)),
        vehicle,
        0,
        Ledger(""),
        on_pictures=lambda block: shown.append(block.log_ns),
    )

    assert [*extractor(block)] == []

    (times,) = shown
    assert (t_ns - times).tolist() == [25_000_000, 25_000_000]
