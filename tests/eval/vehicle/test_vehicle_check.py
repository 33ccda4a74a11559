"""Vehicle files: mounting from the drive alone, a road network, and the check against a drive."""

import math
import shutil
from importlib import util
from pathlib import Path

import cv2
import numpy as np
import pytest

import crosscue
from crosscue.datasets.real import recordings
from crosscue.detectors.catalog import places
from crosscue.eval.cli import run
from crosscue.eval.drives.demo import fetch_drive
from crosscue.eval.quality.verdict import LogCheck
from crosscue.eval.vehicle.check import Checked, _normalized, check_drive_signals
from crosscue.eval.vehicle.drive_check import check_vehicle
from crosscue.replay.base import EVERYTHING
from crosscue.replay.columns import Block, Bytes, Images, Int64s, Messages, Table, Topic
from crosscue.replay.errors import UsageError
from crosscue.replay.ledger import Ledger
from crosscue.replay.signals.extractor import SampleExtractor
from crosscue.replay.signals.plan import pictures_only
from crosscue.replay.vehicle.drafting.series import Series
from crosscue.replay.vehicle.pose import Odometry
from crosscue.replay.vehicle.vehicle import Vehicle, parse
from support.data import shared
from support.memory_log import GYRO, WHEELS, MemoryLog, gyro_block
from support.pandaset_drive import pandaset_drive
from support.pictures import picture_log
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


NAMES = ("yolox-nano", "road-segmentation-adas-0001")


@pytest.fixture
def log(tmp_path: Path) -> Path:
    """A folder with three pictures."""
    return picture_log(tmp_path / "log", [np.full((48, 64), 40 * i, np.uint8) for i in range(3)])


def test_drafted_vehicle_finds_road_and_objects(log: Path) -> None:
    drafted = crosscue.draft_vehicle(log, road=True)

    assert tuple(drafted.vehicle.detectors) == NAMES
    for name in NAMES:
        card = crosscue.model(name)
        (line,) = [one for one in drafted.text.splitlines() if one.startswith(f"# {name}: ")]
        assert card.card.licence in line
        assert f"{card.size_mb:.1f} MB" in line
        assert "ms of CPU time per image" in line
    assert "crosscue model fetch yolox-nano road-segmentation-adas-0001" in drafted.text
    assert "pip install openvino" in drafted.text


def test_vehicle_is_drafted_without_networks_by_default(log: Path) -> None:
    assert not crosscue.draft_vehicle(log).vehicle.detectors


def test_help_of_demo_states_cost_and_licence(capsys: pytest.CaptureFixture[str]) -> None:
    run(["demo", "--help"])

    text = " ".join(capsys.readouterr().out.split()).replace("- ", "-")
    said = text.partition("--road ")[2]
    assert "road-segmentation-adas-0001 (Apache-2.0, 0.7 MB, needs openvino)" in text
    assert "CPU time" in said


def test_road_is_refused_for_a_simulated_drive() -> None:
    with pytest.raises(UsageError, match="road: applies only to a real drive"):
        crosscue.demo(road=True)


def test_road_without_openvino_is_refused_with_what_to_install(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(util, "find_spec", lambda name: None)

    with pytest.raises(UsageError, match="road: needs the package openvino: pip install openvino"):
        fetch_drive(with_road=True)


def test_real_drive_gets_both_networks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("openvino")
    source = shared("sequences", "pandaset_002").parents[1]
    monkeypatch.setenv(recordings.VARIABLE, str(tmp_path / "drives"))
    monkeypatch.setenv(places.VARIABLE, str(tmp_path / "models"))

    drive = fetch_drive(source, with_road=True)

    assert drive.detectors == NAMES
    assert all(crosscue.model(name).is_fetched for name in NAMES)
