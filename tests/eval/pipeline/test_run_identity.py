"""Runs record their inputs, and are estimated again from stored detections without pictures."""

import json
import shutil
from dataclasses import fields, replace
from pathlib import Path

import pytest

from crosscue.datasets.scenes.drive import write_scene
from crosscue.datasets.scenes.rendering.camera import SceneCamera
from crosscue.datasets.scenes.settings import SceneSettings
from crosscue.datasets.simulated.drive import DriveSettings
from crosscue.datasets.simulated.log_files import write_drive
from crosscue.detectors.base import DetectorChoice
from crosscue.eval.cli import run
from crosscue.eval.pipeline.detecting import Detecting
from crosscue.eval.runs.manifest import FORMAT_VERSION
from crosscue.replay.files.log_identity import of_row
from support.commands import output_of
from support.refusals import refusal
from support.scenes import shorten
from support.trees import contents, tree

pytestmark = pytest.mark.slow

DRIVES: int = 4
REFUSAL: str = f"format 1, this crosscue reads {FORMAT_VERSION}: replay again"


@pytest.fixture(scope="module")
def drives(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Some short drives, one of which is not a recording."""
    folder = tmp_path_factory.mktemp("place") / "drives"
    for i in range(DRIVES):
        write_drive(folder / f"D-{i}", DriveSettings(seed=i, blocks=2, block_m=40.0))
    (folder / "D-3" / "drive.mcap").write_bytes(b"junk")
    return folder


def _replay(place: Path | str, out: Path, *more: str) -> int:
    return run(["replay", str(place), "-o", str(out), "-q", *more])


def test_resume_with_another_log_or_setting_is_refused_and_changes_nothing(
    drives: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    keep = tmp_path / "keep"
    assert _replay(drives / "D-0", keep) == 0
    before, replayed = contents(keep), tree(keep)
    theirs = of_row(json.loads((keep / "input.json").read_text())["identity"])

    message = refusal(2, "replay", drives / "D-1", "-o", keep, "-q", "--resume")
    assert theirs.short in message
    assert "drive.mcap" in message
    assert contents(keep) == before

    assert _replay(drives / "D-0", keep, "--resume", "--to", "2") == 2
    assert "selection.end_ns: null there, " in capsys.readouterr().err
    assert contents(keep) == before

    assert _replay(drives / "D-0", keep, "--resume") == 0
    assert tree(keep) == replayed
    (keep / "input.json").unlink()
    assert _replay(drives / "D-1", keep, "--resume") == 2
    assert "without input.json" in capsys.readouterr().err


def test_run_of_older_format_is_refused(
    drives: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    manifest = tmp_path / "old" / "manifest.json"
    manifest.parent.mkdir()
    manifest.write_text('{"format_version": 1}')

    for argv in (
        ["estimate", "old"],
        ["view", "old", "-o", "x.rrd"],
        ["score", "old"],
        ["merge", "old", "-o", "all"],
    ):
        argv = [str(tmp_path / word) if word in ("old", "all") else word for word in argv]
        assert REFUSAL in refusal(4, *argv)
    assert _replay(drives / "D-0", manifest.parent, "--resume") == 4
    assert REFUSAL in capsys.readouterr().err


def test_moved_logs_are_accepted_and_changed_logs_refused(drives: Path, tmp_path: Path) -> None:
    place = tmp_path / "one"
    shutil.copytree(drives / "D-0", place / "drive")
    assert _replay(place / "drive", place / "run") == 0
    vehicle = str(drives / "D-0" / "vehicle.toml")
    estimate = ["estimate", str(place / "run"), "--vehicle", vehicle, "-q"]
    assert run(estimate) == 0

    # If run and logs move together, no option is needed.
    (tmp_path / "one").rename(tmp_path / "two")
    estimate[1] = str(tmp_path / "two" / "run")
    assert run(estimate) == 0
    log = tmp_path / "two" / "drive" / "drive.mcap"
    moved = tmp_path / "elsewhere" / "deep" / "drive.mcap"
    moved.parent.mkdir(parents=True)
    log.rename(moved)
    assert "is gone; name its folder with --logs DIR" in refusal(4, *estimate)
    shutil.copy(drives / "D-1" / "drive.mcap", log)
    assert "has changed since" in refusal(4, *estimate)
    assert run([*estimate, "--logs", str(drives / "D-1")]) == 4
    assert run([*estimate, "--logs", str(tmp_path / "elsewhere")]) == 0


def test_every_option_that_detects_differently_is_among_the_inputs_of_a_run() -> None:
    """A resumed run compares them, so that a forgotten one would keep stale detections."""
    plain = Detecting(())
    changed = {
        "choices": replace(plain, choices=(DetectorChoice("lamp", "lamp"),)),
        "draw": replace(plain, draw=3),
    }

    assert changed.keys() == {one.name for one in fields(Detecting) if one.compare}
    assert all(one.as_json() != plain.as_json() for one in changed.values())


DETECTORS = """
[detectors.oracle]
kind = "support.oracle:build"
[detectors.oracle.settings]
objects = "{objects}"
[detectors.signs]
kind = "signs"
[ranges.stop_sign]
parameters = [200.0]
residual_sd_m = 3.0
[ranges.traffic_light]
parameters = [250.0]
residual_sd_m = 6.0
"""


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A simulated drive with small pictures, and a run over it."""
    folder = tmp_path_factory.mktemp("drive")
    with pytest.MonkeyPatch.context() as patch:
        shorten(patch, pictures=90)
        write_scene(folder, SceneSettings("A", camera=SceneCamera(width_px=192, height_px=108)))
    text = (folder / "vehicle.toml").read_text()
    text = text[: text.index("[camera]")] if "[ranges" in text else text
    (folder / "vehicle.toml").write_text(text + DETECTORS.format(objects=folder / "objects.json"))
    line = f"replay {folder}/drive.mcap --vehicle {folder}/vehicle.toml -o {folder}/run -q"
    output_of(*line.split(), "--cache", folder / "cache.sqlite")
    return folder


def test_rejected_candidates_are_explained_in_manifest_and_summary(
    drive: Path, tmp_path: Path
) -> None:
    shutil.copytree(drive / "run", tmp_path / "run")
    text = (drive / "vehicle.toml").read_text()
    curve = text[text.index("[ranges.stop_sign]") : text.index("[ranges.traffic_light]")]
    none_passes = "\n[cues]\ntraffic_light_score = 1.0\n[cars]\nscore = 1.0\n"
    (tmp_path / "v.toml").write_text(text.replace(curve, "") + none_passes)
    shutil.copy(drive / "simulated_car.dbc", tmp_path)
    arguments = ["estimate", str(tmp_path / "run"), "--logs", str(drive), "--vehicle"]
    printed = " ".join(output_of(*arguments, tmp_path / "v.toml").split())
    scene = json.loads((tmp_path / "run" / "manifest.json").read_text())["scene"]
    for one in (*scene["candidates"].values(), *scene["ranged"].values()):
        assert one["seen"] == one["used"] + sum(one["skipped"].values())
    cars = scene["candidates"]["parked_left"]
    assert cars["seen"] == cars["skipped"]["below score"] > 0
    highest = f"none above 1.00 (highest {cars['max_score']:.2f})"
    assert f"parked_right: {cars['seen']:,} detections, {highest}" in printed
    signs = scene["ranged"]["stop_sign"]["skipped"]["no range curve"]
    assert f"range: {signs:,} stop signs measured, no curve" in printed


def test_only_detector_with_changed_settings_runs_again(drive: Path, tmp_path: Path) -> None:
    text = (drive / "vehicle.toml").read_text()
    slower = 'kind = "signs"\n[detectors.signs.settings]\nmin_votes = 9'
    (tmp_path / "v.toml").write_text(text.replace('kind = "signs"', slower))
    shutil.copy(drive / "simulated_car.dbc", tmp_path)

    arguments = (
        f"replay {drive / 'drive.mcap'} --vehicle {tmp_path / 'v.toml'} -o "
        f"{tmp_path / 'run'} --cache {drive / 'cache.sqlite'} --json"
    ).split()
    reported = json.loads(output_of(*arguments))["detected"]
    assert reported["ran"] == {"oracle": 0, "signs": reported["frames"]}
