"""The demonstration on a recorded drive: download, checksums, replay and score."""

from collections.abc import Iterator
from pathlib import Path
from runpy import run_path

import pytest

import crosscue
from crosscue.datasets.real import recordings
from crosscue.detectors import registry
from crosscue.detectors.catalog import places
from crosscue.eval.cli import run
from crosscue.eval.drives.demo import fetch_drive
from support.commands import json_of, output_of
from support.data import shared
from support.range_server import serving
from support.refusals import refusal
from support.stand_in import StandIn, stand_in

PICTURE = "drive/camera/front_camera/03.jpg"


@pytest.fixture
def stand_in_drive(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[StandIn]:
    monkeypatch.chdir(tmp_path)
    with serving() as server:
        yield stand_in(tmp_path / "stand_in", server, monkeypatch)


def test_real_demo_is_fetched_once_replayed_and_scored(stand_in_drive: StandIn) -> None:
    printed = output_of("demo", "--real")
    requests = len(stand_in_drive.server.gets)

    assert requests == len(stand_in_drive.known.files) + 1
    assert "against our annotations" in printed
    assert "stop_sign" in printed
    assert "pictures   nobody" in printed
    for line in ("report     ", "recording  "):
        (named,) = [one for one in printed.splitlines() if one.startswith(line)]
        assert Path(named.removeprefix(line)).is_file()

    tree = json_of("demo", "--real", "--overwrite")
    assert len(stand_in_drive.server.gets) == requests
    assert Path(tree["log"]) == recordings.recording_folder(stand_in_drive.known)
    assert tree["metrics"]["coverage"]


def test_simulated_demo_prints_25_lines(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With those printed while it runs; the files to open are last."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(registry, "EMBEDDED", "signs")

    printed = output_of("demo", "--width", "64").splitlines()
    assert printed[0].startswith("simulating a drive")
    assert len(printed) <= 25
    assert printed[-1].split() == ["look", "at", "it", "with:", "crosscue", "view", "demo/run"]


@pytest.mark.parametrize("name", [PICTURE, "net.onnx"])
def test_file_of_wrong_checksum_is_not_kept(stand_in_drive: StandIn, name: str) -> None:
    stand_in_drive.server.files[name] = stand_in_drive.server.files[name][:-1] + b"\0"

    with pytest.raises(crosscue.CrosscueError, match="expected SHA-256"):
        fetch_drive()

    below = (recordings.recording_folder(stand_in_drive.known), places.model_folder())
    names = [path.name for folder in below for path in folder.rglob("*")]
    assert Path(name).name not in names


def test_fetch_writes_the_recording_and_never_replaces_another_file(
    stand_in_drive: StandIn, tmp_path: Path
) -> None:
    place, name = tmp_path / "mine", PICTURE.removeprefix("drive/")
    stand_in_drive.server.failing = 1

    assert run(["fetch", "pandaset_002", "-o", str(place)]) == 1
    assert f"crosscue info {place}" in output_of("fetch", "pandaset_002", "-o", place)
    files = {one.name for one in stand_in_drive.known.files}
    assert {p.relative_to(place).as_posix() for p in place.rglob("*") if p.is_file()} == files
    assert run(["info", str(place)]) == 0
    for other in (place / name, place / "notes.txt"):
        before = other.read_bytes() if other.exists() else b""
        other.write_bytes(b"my own")
        assert f"holds {other.relative_to(place)}, which is not of" in refusal(
            1, "fetch", "pandaset_002", "-o", place
        )
        assert other.read_bytes() == b"my own"
        other.write_bytes(before)


def test_known_recordings_are_listed_in_the_help_and_complete() -> None:
    """The minute of the tutorial has its DBC file from another publisher, the only such file."""
    text = " ".join((recordings.fetch.__doc__ or "").split())
    for path in recordings.FOLDER.glob("*/recording.toml"):
        known = recordings.recording(path.parent.name)
        assert known.name == path.parent.name
        assert f"{known.name} (" in text
        assert len({one.name for one in known.files}) == len(known.files)
    minute = recordings.recording("comma2k19")
    assert [one.name for one in minute.files if one.url] == ["toyota_2017.dbc"]
    with pytest.raises(crosscue.UsageError, match="unknown; expected one of: comma2k19, pandaset"):
        recordings.recording("comma")


def test_stored_truth_equals_output_of_annotation_script(tmp_path: Path) -> None:
    sequence = shared("sequences", "pandaset_002")

    names = run_path(str(Path(__file__).parents[3] / "benchmarks" / "annotate_pandaset.py"))

    names["annotate_sequence"](sequence, tmp_path)

    for name in ("truth.json", "ranges.csv"):
        assert (tmp_path / name).read_bytes() == (names["FOLDER"] / name).read_bytes()


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


def test_start_of_a_folder_with_one_drive_names_the_drive(stand_in_drive: StandIn) -> None:
    sequences = stand_in_drive.folder / "sequences"
    assert run(["truth", str(sequences / "pandaset_002"), "-o", "truth"]) == 0

    printed = refusal(2, "replay", sequences, "--start", "truth", "-o", "run")
    assert "is a folder or list of 1; name the drive itself, such as" in printed
    assert str(sequences / "pandaset_002") in printed
