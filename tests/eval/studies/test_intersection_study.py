"""The intersections study on few, small simulated drives: tables, resumption and bad input."""

import json
from pathlib import Path
from typing import Any

import pytest

from crosscue.detectors.base import DetectorChoice
from crosscue.eval.batch.jobs import in_turn
from crosscue.eval.cli import run
from crosscue.eval.studies import simulated_drives
from crosscue.eval.studies.intersections import run as study_intersections
from crosscue.replay.vehicle.cue_table import groups
from crosscue.replay.vehicle.vehicle import DetectorSection, RangeCurve, Ranges, Vehicle
from crosscue.replay.vehicle.vehicle import load as load_vehicle

pytestmark = pytest.mark.slow

ARGUMENTS = ("--layouts", "A,E", "--runs", "1", "--width", "192", "--detectors", "oracle")


def _with_oracle(path: Path) -> Vehicle:
    """Load the drive's vehicle file with a detector that returns the truth, without a network."""
    vehicle = load_vehicle(path)
    oracle = DetectorSection(
        kind="support.oracle:build", settings={"objects": str(path.parent / "objects.json")}
    )
    focal_px = vehicle.camera.focal_px
    assert focal_px is not None
    ranges = Ranges(
        stop_sign=RangeCurve(parameters=(0.75 * focal_px,), residual_sd_m=2.0),
        traffic_light=RangeCurve(parameters=(1.0 * focal_px,), residual_sd_m=6.0),
    )
    return vehicle.model_copy(update={"detectors": {"oracle": oracle}, "ranges": ranges})


def _run_in_this_process(patch: pytest.MonkeyPatch) -> None:
    """Run drives in this process, because a worker process would not have the patched detectors."""
    patch.setattr(simulated_drives, "load", _with_oracle)
    patch.setattr(study_intersections, "engine_of", lambda *_args: in_turn)
    oracle = DetectorChoice("oracle", "support.oracle:build")
    patch.setattr(study_intersections, "choices_of", lambda _: {"oracle": oracle})


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("study")
    with pytest.MonkeyPatch.context() as patch:
        _run_in_this_process(patch)
        assert run(["study", "intersections", "-o", str(out), *ARGUMENTS, "-q"]) == 0
    return out


def _tables(out: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((out / "study.json").read_text())
    return found


def test_tables_are_marked_as_simulated_and_include_published_values(study: Path) -> None:
    tables = _tables(study)

    assert tables["is_simulated"] is True
    assert tables["done"] == tables["wanted"] == 2
    assert tables["published"] == {"detected_m": 34.4, "full_m": 16.2}
    assert [row["intersection"] for row in tables["intersections"]] == ["A", "E"]
    assert {row["cue"] for row in tables["attribution"]} == set(groups())
    page = (study / "study.html").read_text()
    assert "simulated" in page
    assert "http" not in page.replace("http-equiv", "")
    assert (study / "detections.jpg").stat().st_size > 10_000


def test_true_objects_as_detections_yield_right_cues(study: Path) -> None:
    rows = {row["cue"]: row for row in _tables(study)["cues"]}

    assert rows["stop sign"]["precision"] == rows["traffic light"]["precision"] == 1.0
    assert rows["stop sign"]["positives"] > 20
    assert rows["road"]["positives"] == 0
    assert rows["cross traffic"]["tracks"].keys() >= {"precision", "recall", "positives"}
    assert rows["cross traffic"]["tracks"]["recall_of"] == rows["cross traffic"]["recall_of"] > 0
    assert rows["road"]["tracks"] is None


def test_attribution_shows_intersection_lost_without_stop_signs(study: Path) -> None:
    rows = {row["cue"]: row for row in _tables(study)["attribution"]}

    assert rows["stop_sign"]["detected_lost"] == 1
    assert rows["lanes_past"]["detected_lost"] == 0


def test_second_start_of_study_replays_nothing(
    study: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = (study / "study.json").read_bytes()
    _run_in_this_process(monkeypatch)
    monkeypatch.setattr(
        simulated_drives, "replay_drive", lambda *_args, **_more: pytest.fail("ran again")
    )

    assert run(["study", "intersections", "-o", str(study), *ARGUMENTS, "-q"]) == 0

    assert (study / "study.json").read_bytes() == before
