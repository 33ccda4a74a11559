"""PandaSet sequences: streams, odometry and truth agree with the drive."""

from pathlib import Path

import numpy as np
import pytest

from crosscue.datasets.adapters.pandaset import read_pandaset_poses
from crosscue.datasets.real.label_pandaset import write_labels
from crosscue.datasets.truth.truth import read_truth, write_carried
from crosscue.datasets.truth.tum import heading_rad, read_tum
from crosscue.replay.columns import Table
from crosscue.replay.errors import LogFormatError
from crosscue.replay.ledger import Ledger
from support.accounted import read_topics
from support.data import shared
from support.pandaset_drive import COUNT, SPEED_MPS, START_S, YAW_RATE_RADPS, pandaset_drive

CAMERA = Path("camera") / "front_camera"


def rows(path: Path) -> tuple[dict[str, int], Ledger]:
    found, ledger = read_topics(path)
    return {topic: sum(map(len, blocks)) for topic, blocks in found.items()}, ledger


def test_odometry_matches_simulated_motion(tmp_path: Path) -> None:
    table = read_pandaset_poses(pandaset_drive(tmp_path / "002")).odometry().rows
    assert isinstance(table, Table)

    # A chord of 0.2 s at 0.2 rad/s is 0.007 % shorter than its arc.
    np.testing.assert_allclose(np.asarray(table["speed_x_mps"], float)[1:-1], SPEED_MPS, rtol=1e-4)
    np.testing.assert_allclose(
        np.asarray(table["yaw_rate_radps"], float), YAW_RATE_RADPS, rtol=1e-5
    )


def test_truth_equals_camera_track(tmp_path: Path) -> None:
    truth = read_truth(
        write_carried("pandaset", pandaset_drive(tmp_path / "002"), tmp_path / "truth")
    )
    track = read_tum(tmp_path / "truth" / str(truth.pose))

    assert truth.pose_point == "camera"
    assert truth.start_ns == round(START_S * 1e6) * 1000
    np.testing.assert_allclose(
        heading_rad(track), 0.1 * YAW_RATE_RADPS * np.arange(COUNT), atol=1e-6
    )


@pytest.mark.parametrize("number", [0, 7, COUNT - 1])
def test_missing_picture_is_dropped(tmp_path: Path, number: int) -> None:
    path = pandaset_drive(tmp_path / "002")
    (path / CAMERA / f"{number:02d}.jpg").unlink()

    found, ledger = rows(path)

    assert found["front_camera"] == COUNT - 1
    assert ledger.accounts["front_camera"].dropped == {"a time without its picture": 1}


@pytest.mark.parametrize("name", ["poses.json", "timestamps.json"])
@pytest.mark.parametrize("text", ["{", "[]", "{}", '["a"]', "null", "[" * 9999])
def test_damaged_json_file_is_reported_as_loss(tmp_path: Path, name: str, text: str) -> None:
    path = pandaset_drive(tmp_path / "002")
    (path / CAMERA / name).write_text(text)

    found, ledger = rows(path)

    assert not ledger.is_whole
    assert found["gnss"] == COUNT


def test_real_sequence_is_read_with_known_speed_and_distance() -> None:
    """The sequence has 80 pictures in 8 s; the car starts at rest and travels 21.5 m."""
    path = shared("sequences", "pandaset_002")

    found, ledger = rows(path)
    table = read_pandaset_poses(path).odometry().rows
    assert isinstance(table, Table)
    speed = table["speed_x_mps"]

    assert found == {"front_camera": 80, "odometry": 80, "gnss": 80}
    assert ledger.is_whole
    assert speed[0] == pytest.approx(0.07, abs=0.05)
    assert float(speed.sum()) * 0.1 == pytest.approx(21.5, abs=0.3)


def test_pickled_boxes_are_refused_without_opening(tmp_path: Path) -> None:
    """A pickle can run code when it is read, so the file is refused."""
    folder = pandaset_drive(tmp_path / "002", 2)
    (folder / "camera" / "front_camera" / "intrinsics.json").write_text(
        '{"fx": 20.0, "fy": 20.0, "cx": 12.0, "cy": 8.0}'
    )
    boxes = folder / "annotations" / "cuboids"
    boxes.mkdir(parents=True)
    (boxes / "00.pkl.gz").write_bytes(b"not read")

    with pytest.raises(LogFormatError, match="published as pickles, which are not read"):
        write_labels(folder, tmp_path / "labels.json")

    assert not (tmp_path / "labels.json").exists()
