"""The real drives of the documentation: their vehicle files and annotations match their logs."""

import shutil
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from crosscue.datasets.real import recordings
from crosscue.datasets.real.recordings import FOLDER
from crosscue.datasets.truth.truth import read_truth as load_truth
from crosscue.detectors.catalog import fetch as weights
from crosscue.detectors.catalog import places
from crosscue.eval.cli import run
from crosscue.replay.errors import CrosscueError
from crosscue.replay.vehicle.vehicle import load as load_vehicle
from support.data import shared

DRIVES = ("comma2k19", "pandaset_002", "us_dashcam")


@pytest.mark.parametrize("name", DRIVES)
def test_vehicle_files_and_annotations_load_with_their_source(name: str) -> None:
    vehicle = load_vehicle(FOLDER / name / "vehicle.toml")
    truth = load_truth(FOLDER / name)

    assert vehicle.name != "unnamed"
    assert vehicle.detectors
    assert "annotated for crosscue" in truth.source
    present = {one.cue: one.present for one in truth.cues}
    assert present["traffic_light"]
    assert not present["stop_sign"]


def test_dashcam_truth_passes_check_against_frames(tmp_path: Path) -> None:
    frames = shared("sequences", "us_signalized_intersection_dashcam")
    folder = tmp_path / "dashcam"
    folder.mkdir()
    for path in frames.glob("*.jpg"):
        shutil.copy(path, folder / path.name)
    (folder / "timestamps.txt").write_text("rate_hz: 15\n")

    assert run(["check", str(FOLDER / "us_dashcam"), str(folder)]) == 0


@pytest.mark.slow
def test_can_segment_and_single_picture_are_replayed_as_one_drive(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Run the commands of the documentation, up to the traffic light in the picture."""
    (segment,) = shared("comma2k19", "Example_1").glob("*/40")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv(places.VARIABLE, str(tmp_path / "models"))
    monkeypatch.setenv(weights.DATA, str(shared("weights").parent))
    weights.fetch_weights("yolox-nano")
    front = tmp_path / "front"
    front.mkdir()
    shutil.copy(segment / "preview.png", front / "00.png")
    (front / "timestamps.txt").write_text("46408.547498\n")
    (tmp_path / "toyota_2017.dbc").symlink_to(shared("comma2k19", "toyota_2017.dbc"))
    settings = tmp_path / "vehicle.toml"
    settings.write_text((FOLDER / "comma2k19" / "vehicle.toml").read_text())
    line = f"replay {segment} front --vehicle {settings} -o run --no-cache -q"

    assert run(line.split()) == 3
    assert run(["truth", str(segment), "-o", "truth", "-q"]) in (0, 3)
    (tmp_path / "truth" / "truth.json").write_bytes(
        (FOLDER / "comma2k19" / "truth.json").read_bytes()
    )
    assert run(["score", "run", "--truth", "truth", "-q"]) == 3

    cues = pq.read_table("run/cues.parquet", filters=[("cue", "=", "traffic_light")])
    assert [count > 0 for count in cues["count"].to_pylist()] == [True]


@pytest.mark.parametrize("is_there", [False, True])
def test_fetching_without_a_network_leaves_what_was_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_there: bool
) -> None:
    monkeypatch.delenv(weights.DATA, raising=False)
    monkeypatch.setenv(places.VARIABLE, str(tmp_path / "models"))
    for mirror in (recordings.MIRROR, weights.MIRROR):
        monkeypatch.setenv(mirror, "http://127.0.0.1:9")
    folder = tmp_path / "drives" / "pandaset"
    if is_there:
        folder.mkdir(parents=True)

    with pytest.raises(CrosscueError, match="not fetched"):
        recordings.fetch("pandaset_002", folder)
    with pytest.raises(CrosscueError, match="not fetched"):
        weights.fetch_weights("yolox-nano")

    assert [*tmp_path.rglob("*")] == ([folder.parent, folder] if is_there else [])
