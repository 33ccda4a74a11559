"""The demonstration on a recorded drive: download, checksums, replay and score."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

import crosscue
from crosscue.datasets.real import annotate_pandaset, recordings
from crosscue.detectors.catalog import fetch as weights
from crosscue.detectors.catalog import places
from crosscue.eval.cli import run
from support.data import shared
from support.range_server import serving
from support.stand_in import StandIn, stand_in

PICTURE = "drive/camera/front_camera/03.jpg"


@pytest.fixture
def stand_in_drive(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[StandIn]:
    monkeypatch.chdir(tmp_path)
    with serving() as server:
        yield stand_in(tmp_path / "stand_in", server, monkeypatch)


def test_real_demo_is_fetched_once_replayed_and_scored(
    stand_in_drive: StandIn, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["demo", "--real"]) == 0
    printed = capsys.readouterr().out
    requests = len(stand_in_drive.server.gets)

    assert requests == len(stand_in_drive.known.files) + 1
    assert "against our annotations" in printed
    assert "stop_sign" in printed
    assert "pictures   nobody" in printed
    for line in ("report     ", "recording  "):
        (named,) = [one for one in printed.splitlines() if one.startswith(line)]
        assert Path(named.removeprefix(line)).is_file()

    assert run(["demo", "--real", "--overwrite", "--json"]) == 0
    tree = json.loads(capsys.readouterr().out)
    assert len(stand_in_drive.server.gets) == requests
    assert Path(tree["log"]) == recordings.recording_folder(stand_in_drive.known)
    assert tree["metrics"]["coverage"]


def test_existing_demo_is_not_replaced(
    stand_in_drive: StandIn, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["demo", "--real", "-q"]) == 0
    assert run(["demo", "--real"]) == 1

    assert "--overwrite" in capsys.readouterr().err


def test_local_data_folder_needs_no_download(
    stand_in_drive: StandIn, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert run(["demo", "--real", "--data", str(stand_in_drive.folder), "-q"]) == 0
    shutil.rmtree(recordings.recording_folder(stand_in_drive.known).parent)
    shutil.rmtree(places.model_folder())
    monkeypatch.setenv(weights.DATA, str(stand_in_drive.folder))

    drive = crosscue.fetch_drive()

    assert drive.log.is_dir()
    assert not stand_in_drive.server.gets


@pytest.mark.parametrize("name", [PICTURE, "net.onnx"])
def test_file_of_wrong_checksum_is_not_kept(stand_in_drive: StandIn, name: str) -> None:
    stand_in_drive.server.files[name] = stand_in_drive.server.files[name][:-1] + b"\0"

    with pytest.raises(crosscue.CrosscueError, match="expected SHA-256"):
        crosscue.fetch_drive()

    below = (recordings.recording_folder(stand_in_drive.known), places.model_folder())
    names = [path.name for folder in below for path in folder.rglob("*")]
    assert Path(name).name not in names


def test_folder_without_the_recording_is_refused(stand_in_drive: StandIn, tmp_path: Path) -> None:
    with pytest.raises(crosscue.LogError, match="expected a folder with"):
        crosscue.fetch_drive(tmp_path)

    other = stand_in_drive.folder / "sequences" / "pandaset_002" / PICTURE.removeprefix("drive/")
    other.write_bytes(b"another")
    with pytest.raises(crosscue.UsageError, match="recording pandaset_002 requires"):
        crosscue.fetch_drive(stand_in_drive.folder)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("--real --layout C", "--layout: applies only to a simulated drive"),
        ("--real --seed 0", "--seed: applies only to a simulated drive"),
        ("--data .", "--data: applies only to a real drive; add --real"),
    ],
)
def test_options_of_the_other_demo_are_refused(
    line: str, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["demo", *line.split()]) == 2
    assert message in capsys.readouterr().err


def test_source_for_simulated_demo_is_refused() -> None:
    with pytest.raises(crosscue.UsageError, match="add real=True"):
        crosscue.demo(source="folder")


def test_stored_truth_equals_output_of_annotation_script(tmp_path: Path) -> None:
    sequence = shared("sequences", "pandaset_002")

    annotate_pandaset.annotate_sequence(sequence, tmp_path)

    for name in ("truth.json", "ranges.csv"):
        assert (tmp_path / name).read_bytes() == (annotate_pandaset.FOLDER / name).read_bytes()


@pytest.mark.slow
def test_real_demo_on_recorded_drive_meets_precision_and_recall(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = shared("sequences", "pandaset_002").parents[1]
    shared("weights", "yolox_nano")
    monkeypatch.setenv(recordings.VARIABLE, str(tmp_path / "drives"))
    monkeypatch.setenv(places.VARIABLE, str(tmp_path / "models"))

    made = crosscue.demo(tmp_path / "demo", real=True, source=source)

    cues = {row["cue"]: row for row in made.scored.cues.to_pylist()}
    assert cues["traffic_light"]["precision"] >= 0.95
    assert cues["traffic_light"]["recall"] >= 0.8
    assert cues["stop_sign"]["precision_of"] == 0
    assert made.recording.stat().st_size > 1_000_000
    assert "PandaSet" in repr(made)
