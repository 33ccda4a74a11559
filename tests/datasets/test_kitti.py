"""KITTI drives and odometry: streams, times and truth agree; what is missing is reported."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import crosscue
from crosscue.datasets.adapters.kitti import TOPICS, open_kitti, write_kitti_truth
from crosscue.datasets.adapters.kitti_files import COLUMNS, Packets, parse_oxts
from crosscue.datasets.adapters.kitti_odometry import read_kitti_poses, write_kitti_odometry_truth
from crosscue.datasets.truth.coco import read_coco
from crosscue.datasets.truth.truth import read_truth
from crosscue.datasets.truth.truth import read_truth as load_truth
from crosscue.datasets.truth.tum import heading_rad, read_tum
from crosscue.replay.base import Selection
from crosscue.replay.columns import Images, Table
from crosscue.replay.errors import LogFormatError
from crosscue.replay.ledger import Ledger
from crosscue.replay.limits import DEFAULT_LIMITS
from crosscue.replay.logs.opening import open_log
from crosscue.replay.vehicle.drafting.camera import KnowsItsCameras
from support.accounted import column, read_topics, times
from support.data import shared
from support.kitti_drive import (
    FOCAL_PX,
    SPEED_MPS,
    YAW_RATE_RADPS,
    kitti_odometry_drive,
    packet_lines,
    raw_drive,
    tracking_drive,
    true_path,
)


def test_columns_match_simulated_motion(tmp_path: Path) -> None:
    by_topic, _ = read_topics(raw_drive(tmp_path / "drive", 60))

    assert (column(by_topic["oxts/imu"], "gyro_z_radps") == YAW_RATE_RADPS).all()
    assert (column(by_topic["oxts/imu"], "accel_y_mps2") == SPEED_MPS * YAW_RATE_RADPS).all()
    assert (column(by_topic["oxts/ins_speed"], "speed_mps") == SPEED_MPS).all()
    np.testing.assert_allclose(column(by_topic["oxts/gnss"], "speed_mps"), SPEED_MPS)
    yaw = true_path(60)[1]
    course = column(by_topic["oxts/gnss"], "course_rad")
    np.testing.assert_allclose(np.cos(course - yaw), 1.0)


@pytest.mark.parametrize("period_ms", [103.5, 96.0])
def test_tracking_period_is_estimated_from_speeds_and_positions(
    period_ms: float, tmp_path: Path
) -> None:
    drive = tracking_drive(tmp_path / "drive")
    (file,) = (drive / "oxts").glob("*.txt")
    rows = [line.split() for line in file.read_text().splitlines()]
    for row in rows:
        # East, north, ahead, left and up: slower in proportion to the time between frames.
        row[6:11] = [repr(float(value) * 100.0 / period_ms) for value in row[6:11]]
    file.write_text("".join(f"{' '.join(row)}\n" for row in rows))

    by_topic, _ = read_topics(drive)

    period_ns = round(period_ms * 1e6)
    assert times(by_topic["oxts/gnss"]) == [period_ns * i for i in range(30)]
    assert times(by_topic["image_02"]) == [period_ns * i for i in range(30)]


@pytest.mark.parametrize("make", [raw_drive, tracking_drive])
def test_truth_equals_simulated_path(make: Callable[[Path], Path], tmp_path: Path) -> None:
    drive = make(tmp_path / "drive")

    truth_file = write_kitti_truth(drive, tmp_path / "truth")

    truth = json.loads(truth_file.read_text())
    track = read_tum(truth_file.parent / truth["pose"])
    east_north, yaw = true_path(30)
    np.testing.assert_allclose(track.xyz_m[:, :2], east_north, atol=1e-6)
    np.testing.assert_allclose(track.xyz_m[:, 2], 0.0, atol=1e-3)
    np.testing.assert_allclose(heading_rad(track), yaw, atol=1e-12)
    assert truth["start_ns"] == track.t_ns[0]
    assert truth["origin"]["latitude_deg"] == pytest.approx(49.0)


@given(roll=st.floats(-1.0, 1.0), pitch=st.floats(-1.0, 1.0), yaw=st.floats(-3.0, 3.0))
def test_attitude_is_yaw_then_pitch_then_roll(roll: float, pitch: float, yaw: float) -> None:
    numbers = np.zeros((1, len(COLUMNS)))
    numbers[0, 3:6] = roll, pitch, yaw
    w, x, y, z = Packets(np.zeros(1, np.int64), numbers).attitude_wxyz()[0]

    def turn(angle: float, i: int, j: int) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
        matrix = np.eye(3)
        matrix[[i, j], [i, j]] = np.cos(angle)
        matrix[i, j], matrix[j, i] = -np.sin(angle), np.sin(angle)
        return matrix

    expected = turn(yaw, 0, 1) @ turn(pitch, 2, 0) @ turn(roll, 1, 2)
    forward = [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)]
    up = [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)]
    np.testing.assert_allclose(forward, expected[:, 0], atol=1e-12)
    np.testing.assert_allclose(up, expected[:, 2], atol=1e-12)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("", "0 numbers; expected 30"),
        (" ".join(packet_lines(1)[0].split()[:29]), "29 numbers; expected 30"),
        (packet_lines(1)[0].replace("9.81", "much", 1), "not all values are numbers"),
        (packet_lines(1)[0].replace("9.81", "nan", 1), "a number is not finite"),
        (packet_lines(1)[0].replace("49", "149", 1), "out of range"),
    ],
)
def test_damaged_packet_is_dropped_with_file_and_reason(
    tmp_path: Path, text: str, why: str
) -> None:
    drive = raw_drive(tmp_path / "drive", 5)
    (drive / "oxts" / "data" / "0000000003.txt").write_text(text)

    by_topic, ledger = read_topics(drive)

    assert len(times(by_topic["oxts/imu"])) == 4
    assert ledger.topic("oxts/imu").dropped == {"not an OXTS packet": 1}
    assert any(why in loss.detail and "0000000003" in loss.detail for loss in ledger.drops())


def test_oxts_without_timestamps_is_dropped_and_yields_no_truth(tmp_path: Path) -> None:
    drive = raw_drive(tmp_path / "drive", 5)
    (drive / "oxts" / "timestamps.txt").unlink()

    by_topic, ledger = read_topics(drive)

    assert set(by_topic) == {"image_02"}
    assert {name: sum(ledger.topic(name).dropped.values()) for name in TOPICS} == dict.fromkeys(
        TOPICS, 5
    )
    with pytest.raises(LogFormatError, match="contains no truth"):
        write_kitti_truth(drive, tmp_path / "truth")


def test_drive_with_timestamps_only_is_refused(tmp_path: Path) -> None:
    drive = raw_drive(tmp_path / "drive", 2, cameras=())
    for path in (drive / "oxts" / "data").iterdir():
        path.unlink()

    with pytest.raises(LogFormatError, match="no stream of a KITTI raw drive can be read"):
        open_log(drive)


@given(fraction=st.floats(0.0, 1.0))
def test_truncated_tracking_file_yields_only_complete_lines(
    tmp_path: Path, fraction: float
) -> None:
    text = "\n".join(packet_lines(6)) + "\n"
    path = tmp_path / "oxts" / "0003.txt"
    path.parent.mkdir(exist_ok=True)
    cut = text[: int(fraction * len(text))]
    path.write_text(cut)

    ledger = Ledger("drive")
    imu = Selection(frozenset({"oxts/imu"}))
    blocks = list(open_kitti(tmp_path, DEFAULT_LIMITS).read(ledger, imu))

    account = ledger.topic("oxts/imu")
    assert len(times(blocks)) == account.used
    assert account.in_file == len(cut.splitlines())
    assert all((column([block], "gyro_z_radps") == YAW_RATE_RADPS).all() for block in blocks)


@given(st.binary(max_size=400))
def test_any_bytes_parse_to_packet_or_reason(raw: bytes) -> None:
    parsed = parse_oxts(raw)

    assert isinstance(parsed, str) or (len(parsed) == 30 and np.isfinite(parsed).all())


def test_real_sequence_has_known_heading_change_distance_and_frame_rate(tmp_path: Path) -> None:
    drive = shared("odometry", "kitti_tracking_0001")

    by_topic, ledger = read_topics(drive)
    track = read_tum(write_kitti_truth(drive, tmp_path).parent / "pose.tum")

    assert ledger.is_whole
    assert len(times(by_topic["oxts/imu"])) == 447
    assert isinstance(by_topic["image_02"][0].rows, Images)
    heading = np.unwrap(heading_rad(track))
    assert abs(np.degrees(heading[-1] - heading[0])) == pytest.approx(74.0, abs=0.1)
    steps_m = np.diff(track.xyz_m[:, :2], axis=0)
    speed_mps = column(by_topic["oxts/ins_speed"], "speed_mps")
    assert speed_mps.sum() * 0.1 == pytest.approx(321.0, abs=0.5)
    # The true frame rate is 9.65 Hz: positions are 3.6 % further apart than speeds at 10 Hz imply.
    period_s = np.hypot(*steps_m.T).sum() / ((speed_mps[1:] + speed_mps[:-1]) / 2).sum()
    assert period_s == pytest.approx(0.1036, abs=0.0003)
    assert "103.7 ms each" in ledger.notices[0]
    moving = speed_mps[1:] > 3.0
    course = np.arctan2(steps_m[:, 1], steps_m[:, 0])
    off = np.angle(np.exp(1j * (course - heading[1:])))[moving]
    assert np.degrees(np.abs(np.median(off))) < 1.0


def test_tracking_labels_become_objects_of_truth(tmp_path: Path) -> None:
    drive = tracking_drive(tmp_path / "drive")
    (drive / "label_02").mkdir()
    (drive / "label_02" / "0003.txt").write_text(
        "0 -1 DontCare -1 -1 -10 5 5 9 9 -1000 -1000 -1000 -10 -1 -1 -1\n"
        "2 7 Van 0 1 -1.5 10 2 20.5 14 1.5 1.7 4.2 3.0 1.6 20.0 -1.5\n"
        "2 7 Van 0 ? -1.5 10\n"
    )

    truth = load_truth(write_kitti_truth(drive, tmp_path / "truth"))

    assert truth.objects is not None
    assert "1 damaged labels" in truth.source
    first, second = read_coco(tmp_path / "truth" / truth.objects).pictures
    assert (first.t_ns, second.t_ns) == (0, 200_000_000)
    assert all(thing.is_crowd for thing in first.things)
    (van,) = second.things
    assert (van.label, van.track, van.visible) == ("car", 7, 0.7)
    assert van.box_px == (10.0, 2.0, 20.5, 14.0)


def test_intrinsics_are_read_from_rectified_calibration(tmp_path: Path) -> None:
    drive = tracking_drive(tmp_path / "drive")
    (drive / "calib").mkdir()
    line = "721.5 0 609.6 44.9 0 721.5 172.9 0.2 0 0 1 0.003\n"
    (drive / "calib" / "0003.txt").write_text(f"P1: {line.replace('721.5', '1')}P2: {line}")
    raw = raw_drive(tmp_path / "day" / "raw")
    (tmp_path / "day" / "calib_cam_to_cam.txt").write_text(f"calib_time: x\nP_rect_02: {line}")

    for path in (drive, raw):
        with open_log(path) as log:
            assert isinstance(log, KnowsItsCameras)
            assert log.intrinsics("image_02") == (721.5, 609.6, 172.9)
            assert log.intrinsics("image_03") is None


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
