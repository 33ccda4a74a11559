"""The catalog's road network is set up in one option, with its cost and licence stated."""

from importlib import util
from pathlib import Path

import numpy as np
import pytest

import crosscue
from crosscue.datasets.real import recordings
from crosscue.detectors.catalog import places
from crosscue.eval.cli import run
from crosscue.eval.drives.demo import fetch_drive
from crosscue.replay.errors import UsageError
from support.data import shared
from support.pictures import picture_log

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
