"""``crosscue estimate``: from stored detections to cues, ranges and beliefs, without pictures."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from crosscue.datasets.scenes.drive import write_scene
from crosscue.datasets.scenes.rendering.camera import SceneCamera
from crosscue.datasets.scenes.settings import SceneSettings
from crosscue.eval.cli import run
from crosscue.eval.runs.folder import RunFolder, open_run
from support.oracle import Oracle

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
    write_scene(folder, SceneSettings("A", camera=SceneCamera(width_px=192, height_px=108)))
    text = (folder / "vehicle.toml").read_text()
    text = text[: text.index("[camera]")] if "[ranges" in text else text
    (folder / "vehicle.toml").write_text(text + DETECTORS.format(objects=folder / "objects.json"))
    _replay(folder, folder / "run")
    return folder


def _replay(folder: Path, out: Path, *more: str) -> None:
    arguments = [
        "replay",
        str(folder / "drive.mcap"),
        "--vehicle",
        str(folder / "vehicle.toml"),
        "-o",
        str(out),
        "--cache",
        str(folder / "cache.sqlite"),
        "-q",
        *more,
    ]
    assert run(arguments) == 0


def _tables(run_path: Path) -> dict[str, bytes]:
    return {file.name: file.read_bytes() for file in sorted(run_path.glob("*.parquet"))}


def _manifest(run_path: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((run_path / "manifest.json").read_text())
    return found


def test_intersection_probability_is_high_at_end_of_approach(drive: Path) -> None:
    folder = open_run(drive / "run")

    belief = folder.table("belief")
    assert belief["intersection"].to_pylist()[-1] > 0.9
    assert set(belief["approach"].to_pylist()) == {1}
    ranges = folder.table("range")
    assert set(ranges["reference"].to_pylist()) == {"start"}
    assert all(v > 0 for v in ranges["var_m2"].to_pylist())


def test_cues_table_has_row_for_each_frame_and_evaluated_cue(drive: Path) -> None:
    folder = open_run(drive / "run")

    frames = folder.table("frames").num_rows
    by_cue: dict[str, int] = {}
    for cue in folder.table("cues")["cue"].to_pylist():
        by_cue[cue] = by_cue.get(cue, 0) + 1
    assert by_cue["stop_sign"] == by_cue["one_way_left"] == frames
    assert by_cue["parked_left"] == frames - 1
    assert "road_left" not in by_cue


def test_manifest_accounts_for_messages_of_every_topic(drive: Path) -> None:
    manifest = _manifest(drive / "run")

    topics = manifest["account"]["reading"][0]["topics"]
    for account in topics.values():
        gone = sum(account["skipped"].values()) + sum(account["dropped"].values())
        assert account["used"] + gone == account["in"] == account["declared"]
    camera = topics["/camera/image/compressed"]
    assert camera["used"] == camera["in"] == manifest["scene"]["frames"]
    assert topics["/can/car"]["used"] > 0
    assert manifest["detect"]["camera"] == "/camera/image/compressed"
    assert manifest["scene"]["frames"] == manifest["detect"]["counts"]["frames"]


def test_rejected_candidates_are_explained_in_manifest_and_summary(
    drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(drive / "run", tmp_path / "run")
    text = (drive / "vehicle.toml").read_text()
    curve = text[text.index("[ranges.stop_sign]") : text.index("[ranges.traffic_light]")]
    none_passes = "\n[cues]\ntraffic_light_score = 1.0\n[cars]\nscore = 1.0\n"
    (tmp_path / "v.toml").write_text(text.replace(curve, "") + none_passes)
    shutil.copy(drive / "simulated_car.dbc", tmp_path)
    arguments = ["estimate", str(tmp_path / "run"), "--logs", str(drive), "--vehicle"]
    assert run([*arguments, str(tmp_path / "v.toml")]) == 0

    printed = " ".join(capsys.readouterr().out.split())
    scene = _manifest(tmp_path / "run")["scene"]
    for one in (*scene["candidates"].values(), *scene["ranged"].values()):
        assert one["seen"] == one["used"] + sum(one["skipped"].values())
    cars = scene["candidates"]["parked_left"]
    assert cars["seen"] == cars["skipped"]["below score"] > 0
    highest = f"none above 1.00 (highest {cars['max_score']:.2f})"
    assert f"parked_right: {cars['seen']:,} detections, {highest}" in printed
    signs = scene["ranged"]["stop_sign"]["skipped"]["no range curve"]
    assert f"range: {signs:,} stop signs measured, no curve" in printed


def _fail_if_called(self: Oracle, frames: Sequence[object]) -> Sequence[object]:
    raise AssertionError("a detector ran")


def test_estimate_applies_new_settings_without_decoding_pictures(
    drive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(drive / "run", tmp_path / "run")
    before = _tables(tmp_path / "run")
    settings = (drive / "vehicle.toml").read_text() + "\n[fusion]\nestablished = 0.99\n"
    (tmp_path / "v.toml").write_text(settings)
    shutil.copy(drive / "simulated_car.dbc", tmp_path)
    monkeypatch.setattr("crosscue.detectors.runner.decode", _fail_if_called)
    monkeypatch.setattr("crosscue.detectors.images.decode", _fail_if_called)
    monkeypatch.setattr(Oracle, "__call__", _fail_if_called)

    assert run(["estimate", str(tmp_path / "run"), "--logs", str(drive), "-q"]) == 0
    assert _tables(tmp_path / "run") == before
    vehicle = str(tmp_path / "v.toml")
    assert (
        run(["estimate", str(tmp_path / "run"), "--logs", str(drive), "--vehicle", vehicle, "-q"])
        == 0
    )

    after = _tables(tmp_path / "run")
    assert after["belief.parquet"] != before["belief.parquet"]
    assert after["detections.parquet"] == before["detections.parquet"]


def test_only_detector_with_changed_settings_runs_again(
    drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = (drive / "vehicle.toml").read_text()
    slower = 'kind = "signs"\n[detectors.signs.settings]\nmin_votes = 9'
    (tmp_path / "v.toml").write_text(text.replace('kind = "signs"', slower))
    shutil.copy(drive / "simulated_car.dbc", tmp_path)

    arguments = [
        "replay",
        str(drive / "drive.mcap"),
        "--vehicle",
        str(tmp_path / "v.toml"),
        "-o",
        str(tmp_path / "run"),
        "--cache",
        str(drive / "cache.sqlite"),
        "--json",
    ]
    assert run(arguments) == 0

    reported = json.loads(capsys.readouterr().out)["detected"]
    assert reported["ran"] == {"oracle": 0, "signs": reported["frames"]}


def test_resumed_run_writes_same_bytes_as_uninterrupted_run(
    drive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def killed(*_args: object, **_more: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("crosscue.eval.pipeline.replay.estimate_into", killed)
        arguments = [
            "replay",
            str(drive / "drive.mcap"),
            "-o",
            str(tmp_path / "run"),
            "-q",
            "--vehicle",
            str(drive / "vehicle.toml"),
            "--no-cache",
        ]
        assert run(arguments) == 130
    monkeypatch.setattr("crosscue.eval.pipeline.replay.detect_into", killed)

    _replay(drive, tmp_path / "run", "--resume")

    assert _tables(tmp_path / "run") == _tables(drive / "run")


def test_estimate_refuses_missing_or_changed_log(
    drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    copy = tmp_path / "drive"
    shutil.copytree(drive, copy)
    assert run(["estimate", str(copy / "run"), "-q"]) == 0
    with (copy / "drive.mcap").open("ab") as file:
        file.write(b"more")

    assert run(["estimate", str(copy / "run")]) == 4
    assert "has changed since" in capsys.readouterr().err
    (copy / "drive.mcap").unlink()
    assert run(["estimate", str(copy / "run")]) == 4
    assert "is gone; name its folder with --logs DIR" in capsys.readouterr().err


def test_replay_without_detectors_succeeds_and_reports_it(
    drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log, vehicle = str(drive / "drive.mcap"), str(drive / "vehicle.toml")
    out = str(tmp_path / "run")
    assert run(["replay", log, "--vehicle", vehicle, "--detectors", "none", "-o", out]) == 0

    assert "no detector ran on the camera" in capsys.readouterr().out
    assert not RunFolder(tmp_path / "run").file("belief.parquet").exists()


def test_custom_cue_and_feature_are_configured_in_vehicle_file(drive: Path, tmp_path: Path) -> None:
    shutil.copytree(drive / "run", tmp_path / "run")
    shutil.copy(drive / "simulated_car.dbc", tmp_path)
    (tmp_path / "v.toml").write_text(
        (drive / "vehicle.toml").read_text()
        + "\n[cues.own.any_car]\nlabels = ['car']\nscore = 0.5\n"
        + "\n[fusion.features]\nbusy = {}\n"
        + "\n[fusion.cues]\nany_car = { precision = 0.8, supports = ['busy'] }\n"
    )

    assert (
        run(
            [
                "estimate",
                str(tmp_path / "run"),
                "-q",
                "--logs",
                str(drive),
                "--vehicle",
                str(tmp_path / "v.toml"),
            ]
        )
        == 0
    )

    folder = open_run(tmp_path / "run")
    counts = [row["count"] for row in folder.table("cues").to_pylist() if row["cue"] == "any_car"]
    assert len(counts) == folder.table("frames").num_rows
    assert max(counts) > 0
    assert folder.table("belief")["busy"].to_pylist()[-1] > 0.9


def test_custom_cue_with_existing_name_is_refused(
    drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = (drive / "vehicle.toml").read_text() + "\n[cues.own.stop_sign]\nlabels = ['x']\n"
    (tmp_path / "v.toml").write_text(text)

    arguments = ["estimate", str(drive / "run"), "--vehicle", str(tmp_path / "v.toml")]
    assert run(arguments) == 2

    assert "a cue of this name already exists" in capsys.readouterr().err
