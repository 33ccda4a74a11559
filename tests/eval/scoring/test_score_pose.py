"""Scores of a run's pose and its files, refused truth, and rows whose log time occurs twice."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from crosscue.datasets.truth.truth import Truth, save
from crosscue.datasets.truth.tum import Trajectory, heading_rad, planar, write_tum
from crosscue.eval.drives.score import ScoringSettings, score_run
from crosscue.eval.pipeline.whole_run import replay_drive
from crosscue.eval.recording import save_rrd as save_recording
from crosscue.eval.report.opening import judged_sentences
from crosscue.eval.report.summary import pose_summary, scores_text
from crosscue.eval.runs.drive import Drive
from crosscue.eval.runs.folder import RunFolder, create
from crosscue.eval.runs.tables.log_time import ambiguous
from crosscue.eval.scoring.columns import AMBIGUOUS
from crosscue.eval.scoring.pose.score import PoseScore, load_truth, truth_track
from crosscue.eval.scoring.runs import pooled_scores
from crosscue.eval.studies.town.field_study import score_pose
from crosscue.replay.errors import SchemaError
from crosscue.replay.vehicle.pose import Start
from crosscue.replay.vehicle.vehicle import Camera, Vehicle
from support.gap_drive import Clock, replayed, write_drive
from support.memory_log import GYRO, WHEELS, MemoryLog, driven_blocks

SPEED_MPS = 10.0
YAW_RATE_RADPS = 0.1


def _circle(t_s: np.ndarray[tuple[int], np.dtype[np.float64]], ahead_m: float = 0.0) -> Trajectory:
    heading = YAW_RATE_RADPS * t_s
    radius = SPEED_MPS / YAW_RATE_RADPS
    x = radius * np.sin(heading) + ahead_m * np.cos(heading)
    y = radius * (1.0 - np.cos(heading)) + ahead_m * np.sin(heading)
    return planar(np.rint(t_s * 1e9).astype(np.int64), x, y, np.angle(np.exp(1j * heading)))


def _run(folder: Path, vehicle: Vehicle | None = None) -> RunFolder:
    log = MemoryLog(
        (WHEELS, GYRO), driven_blocks(30, SPEED_MPS, YAW_RATE_RADPS), path=Path(__file__)
    )
    vehicle = vehicle or Vehicle(version=1, start=Start(heading_rad=0.0))
    return replay_drive(Drive([log], vehicle), create(folder, overwrite=False)).run


def _truth(folder: Path, track: Trajectory, **more: object) -> Path:
    folder.mkdir(exist_ok=True)
    write_tum(folder / "pose.tum", track)
    content = {"start_ns": int(track.t_ns[0]), "end_ns": int(track.t_ns[-1]) + 1, **more}
    return save(Truth.model_validate({"version": 1, "pose": "pose.tum", **content}), folder)


def _scored(tmp_path: Path) -> tuple[RunFolder, Path, PoseScore]:
    run = _run(tmp_path / "run")
    path = _truth(tmp_path / "truth", _circle(np.arange(-1.0, 33.0, 0.05)))
    return run, path, score_pose(run, path)


def test_perfect_run_has_no_error_and_full_accounting(tmp_path: Path) -> None:
    _, _, result = _scored(tmp_path)

    assert result.ape["none"].translation_m.max < 1e-2
    assert result.rpe["100 m"].translation_m.max < 1e-2
    # NEES without any error is below its band: the filter is underconfident.
    assert result.nees_xyh.mean < 0.01
    covered = result.coverage
    # The first row is at the end of the first interval, at 0.1 s.
    assert covered.before_estimate == 22
    assert covered.scored + covered.before_estimate + covered.after_estimate == covered.truth_poses


def test_scores_of_a_drive_without_pictures_name_no_frames(tmp_path: Path) -> None:
    run, truth, _ = _scored(tmp_path)

    printed = scores_text(pooled_scores([score_run(run.path, truth, has_figures=False).one]))

    assert printed == "drives     1, without pictures: no cue, belief or range to score"


def test_camera_truth_is_compared_at_camera(tmp_path: Path) -> None:
    vehicle = Vehicle(version=1, start=Start(heading_rad=0.0), camera=Camera(x_m=2.0))
    path = _truth(tmp_path / "truth", _circle(np.arange(0.5, 29.0, 0.05), 2.0), pose_point="camera")

    assert score_pose(_run(tmp_path / "run", vehicle), path).ape["none"].translation_m.max < 1e-2


def _turned(track: Trajectory, yaw_rad: float) -> Trajectory:
    """The same track of a body mounted with a yaw offset to the left."""
    heading = heading_rad(track) + yaw_rad
    return planar(track.t_ns, track.xyz_m[:, 0], track.xyz_m[:, 1], heading)


@pytest.mark.parametrize("source", ["truth", "vehicle"])
def test_camera_yaw_offset_is_not_heading_error(tmp_path: Path, source: str) -> None:
    start = Start(heading_rad=0.0)
    at_s = np.arange(0.5, 29.0, 0.05)
    track = _turned(_circle(at_s, 2.0), 0.016)
    camera = Camera(x_m=2.0, yaw_rad=0.016) if source == "vehicle" else Camera(x_m=9.0)
    mounting = {"x_m": 2.0, "yaw_rad": 0.016} if source == "truth" else None
    path = _truth(tmp_path / "truth", track, pose_point="camera", mounting=mounting)
    result = score_pose(
        _run(tmp_path / "run", Vehicle(version=1, start=start, camera=camera)), path
    )

    assert result.ape["none"].rotation_deg.max < 0.01
    assert result.ape["none"].translation_m.max < 0.1


def test_nees_includes_uncertainty_of_truth(tmp_path: Path) -> None:
    run = _run(tmp_path / "run")
    shifted = _circle(np.arange(0.5, 29.0, 0.05))
    shifted = replace(shifted, xyz_m=shifted.xyz_m + np.array([30.0, 0.0, 0.0]))
    exact = score_pose(run, _truth(tmp_path / "exact", shifted))
    rough = score_pose(run, _truth(tmp_path / "rough", shifted, position_sd_m=1000.0))

    assert exact.nees_xy.mean > 50.0
    assert rough.nees_xy.mean < 0.01


def test_truth_on_another_clock_is_refused(tmp_path: Path) -> None:
    path = _truth(tmp_path / "truth", _circle(np.arange(1000.0, 1030.0)))

    with pytest.raises(SchemaError, match="another log or clock"):
        score_pose(_run(tmp_path / "run"), path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "not readable as JSON"),
        ('{"version": 1, "version": 1}', "duplicate key"),
        ('{"version": 1, "start_ns": 5, "end_ns": 5}', "not after start_ns"),
        ('{"version": 1, "start_ns": 5, "end_ns": 9, "pose_file": "x"}', "pose_file"),
        ('{"version": 1, "start_ns": 5, "end_ns": 9}', "pose: missing"),
    ],
)
def test_malformed_truth_is_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "truth.json").write_text(text)

    with pytest.raises(SchemaError, match=message):
        load_truth(tmp_path / "truth.json")


def test_recording_with_truth_is_larger_than_without(tmp_path: Path) -> None:
    run, path, _ = _scored(tmp_path)
    save_recording(run, tmp_path / "plain.rrd")
    save_recording(run, tmp_path / "truth.rrd", truth_track(path, run))

    sizes = [(tmp_path / f"{name}.rrd").stat().st_size for name in ("plain", "truth")]
    assert 10_000 < sizes[0] < sizes[1]


def test_nees_is_not_computed_without_common_frame(tmp_path: Path) -> None:
    run = _run(tmp_path / "run", Vehicle(version=1))
    path = _truth(tmp_path / "truth", _circle(np.arange(-1.0, 33.0, 0.05)))
    result = score_pose(run, path)

    assert np.isnan([result.nees_xy.mean, result.nees_xyh.mean]).all()
    text = pose_summary(result)
    assert "NEES not computed: the run's frame is its own" in text
    assert "NEES of" not in text
    # Errors that need no common frame are still measured.
    assert result.ape["yaw"].translation_m.max < 1e-2
    (told,) = judged_sentences(score_run(run.path, path, has_figures=False).one)
    assert told.startswith("The start heading is unknown; shifted and turned, the pose is 0.00 m")


def test_score_reports_compared_body_and_assumed_mounting(tmp_path: Path) -> None:
    track = _turned(_circle(np.arange(0.5, 29.0, 0.05), 2.0), 0.016)
    mounting = {"x_m": None, "y_m": 0.0, "yaw_rad": 0.016}
    path = _truth(
        tmp_path / "truth", track, pose_point="camera", mounting=mounting, mounting_source="by hand"
    )
    vehicle = Vehicle(version=1, start=Start(heading_rad=0.0), camera=Camera(x_m=2.0))

    result = score_pose(_run(tmp_path / "run", vehicle), path)

    at = result.compared_at
    assert (at.body, at.x_m, at.yaw_rad, at.assumed) == ("camera", 2.0, 0.016, ("x_m",))
    assert result.ape["none"].rotation_deg.max < 0.01
    text = pose_summary(result)
    assert "compared at the camera, 2.00 m ahead" in text
    assert "x_m: unknown to the truth" in text
    assert "by hand" in text


def _ambiguous_rows(run: RunFolder, name: str) -> int:
    """Return the number of rows whose stamp also occurs in the other segment."""
    timeline = run.drive_manifest().timeline
    table = run.table(name)
    log_ns, numbers = table["log_t_ns"].to_numpy(), table["segment"].to_numpy().astype(np.int64)
    return int(ambiguous(timeline, log_ns, numbers).sum())


def test_rows_with_repeated_log_time_are_counted_in_all_scores(tmp_path: Path) -> None:
    run = replayed(tmp_path, write_drive(tmp_path, Clock(set_at_s=6, by_s=-3)))
    frames, belief, ranges = (_ambiguous_rows(run, name) for name in ("frames", "belief", "range"))
    assert min(frames, belief, ranges) > 0

    scored = ScoringSettings(tmp_path / "truth.json")(run.path)

    metrics = json.loads(run.file("score/metrics.json").read_text())
    assert metrics["coverage"]["frames"] == run.table("frames").num_rows
    assert metrics["coverage"]["frames_ambiguous"] == frames
    for cue in metrics["cues"].values():
        for judged in cue["readings"].values():
            assert judged["left_out"][AMBIGUOUS] == frames
            assert judged["frames"] == judged["scored"] + sum(judged["left_out"].values())
    for one in metrics["belief"].values():
        assert one["left_out"][AMBIGUOUS] == belief
        assert one["steps"] >= run.table("belief").num_rows
    reported = [one["left_out"].get(AMBIGUOUS, 0) for one in metrics["range"].values()]
    assert sum(reported) == ranges
    pose = metrics["pose"]["coverage"]
    assert pose["ambiguous"] > 0
    assert metrics["account"]["scoring"]["poses"]["skipped"][AMBIGUOUS] == pose["ambiguous"]
    parts = ("scored", "before_estimate", "after_estimate", "in_gap", "ambiguous")
    assert pose["truth_poses"] == sum(pose[part] for part in parts)
    printed = scores_text(pooled_scores([scored.one]))
    assert f"ambiguous  {frames} frames not scored" in printed
    assert scored.one.pose is not None
    assert f"{pose['ambiguous']} whose log time comes twice" in pose_summary(scored.one.pose)
    page = scored.report.read_text()
    assert metrics["account"]["scoring"]
    for name, one in metrics["account"]["scoring"].items():
        row = f'<td>scoring</td><td class="text">{name}</td><td>{one["in"]}</td><td>{one["used"]}'
        assert row in page
        assert one["in"] == one["used"] + sum(one["skipped"].values())
    assert f"<b>Ambiguous:</b> {frames} frames" in page
    assert f"{pose['ambiguous']} lie at moments that come twice" in page
