"""``crosscue estimate``: from stored detections to cues, ranges and beliefs, without pictures."""

import json
import shutil
from pathlib import Path

import pytest

from crosscue.datasets.scenes.drive import write_scene
from crosscue.datasets.scenes.rendering.camera import SceneCamera
from crosscue.datasets.scenes.settings import SceneSettings
from support.commands import output_of
from support.scenes import shorten

pytestmark = pytest.mark.slow

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
