"""Drives of pictures alone: odometry and roads from the pictures, through detect and estimate."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

import crosscue
from crosscue.detectors import rle
from crosscue.detectors.base import Frame, RoadMask, View
from crosscue.detectors.catalog.fetch import fetch_weights
from crosscue.eval.pipeline.run import Run
from crosscue.eval.pipeline.scene.road_picture import plans_of
from crosscue.eval.pipeline.visual import uses_pictures, with_visual_scale
from crosscue.eval.report.frame_pictures import draw_pictures
from crosscue.eval.runs.drive import Drive
from crosscue.eval.runs.folder import RunFolder
from crosscue.eval.runs.manifest import EstimateManifest, SceneSummary
from crosscue.replay.columns import Topic
from crosscue.replay.signals.kinds import Signal
from crosscue.replay.signals.plan import plan
from crosscue.replay.vehicle.vehicle import parse
from support.data import shared
from support.detecting import Nothing
from support.pictures import picture_log
from support.plane_pictures import CAMERA, SIZE_PX, arc, picture

STEP_M = 0.8
ROADS = "road-segmentation-adas-0001"
SETUP = f"""
version = 1
[camera]
focal_px = {CAMERA.focal_px}
center_px = [320.0, 100.0]
x_m = {CAMERA.x_m}
z_m = {CAMERA.z_m}
pitch_rad = {CAMERA.pitch_rad}
"""


class LowerHalf:
    """A detector to which the ground between the walls is road."""

    view, identity, labels = View(is_grey=True), "lower half", ()

    def __call__(self, frames: Sequence[Frame], /) -> list[RoadMask]:
        """Return all pixels 20 rows below the middle of each picture."""
        width, height = SIZE_PX
        rows = np.arange(height) > height // 2 + 20
        pixels = np.broadcast_to(rows[:, None], (height, width))
        mask = rle.encode_mask(pixels, (0, 0), SIZE_PX)
        return [RoadMask(frame.t_ns, SIZE_PX, mask, SIZE_PX) for frame in frames]


def scene_of(run: Run) -> tuple[EstimateManifest, SceneSummary]:
    """Return the manifest of a run, and its scene."""
    manifest = run.manifest
    assert isinstance(manifest, EstimateManifest)
    assert manifest.scene is not None
    return manifest, manifest.scene


def replayed(folder: Path, more: str = "", detector: object = Nothing) -> Run:
    """Replay a rendered drive: three pictures standing, then six steps of a gentle turn."""
    poses = [(0.0, 0.0, 0.0)] * 2 + arc(STEP_M, math.radians(1.0), 6)
    log = picture_log(folder / "log", [picture(*pose) for pose in poses])
    (folder / "car.toml").write_text(SETUP + more)
    return crosscue.replay_drive(log, folder / "run", folder / "car.toml", [detector])


def test_pictures_alone_give_odometry_that_is_named_in_the_account(tmp_path: Path) -> None:
    run = replayed(tmp_path)
    manifest, scene = scene_of(run)
    (notice,) = [one for one in manifest.notices if "visual" in one]
    assert "8 of 8 pairs of pictures measured, 2 standing" in notice
    used = manifest.account.estimating["pairs of pictures"]
    assert (used.entered, used.used) == (8, 8)
    rows = [row for row in run["measurements"].to_pylist() if row["kind"] == "odometry"]
    assert [row["distance_m"] for row in rows] == pytest.approx([0.0] * 2 + [STEP_M] * 6, abs=0.05)
    assert sum(row["turn_rad"] for row in rows) == pytest.approx(math.radians(6.0), abs=0.004)
    assert all(row["distance_var_m2"] > 0.0 for row in rows)
    assert run.pose["x_m"][-1].as_py() == pytest.approx(6 * STEP_M, abs=0.2)
    assert scene.without_odometry == 0


def test_accumulated_road_is_drawn_in_the_recording_and_beside_pictures(tmp_path: Path) -> None:
    run = replayed(tmp_path, detector=LowerHalf())
    _, scene = scene_of(run)
    assert not scene.approaches
    assert crosscue.save_recording(run, tmp_path / "drive.rrd").stat().st_size > 10_000
    pictures: list[bytes] = []
    times = run["frames"]["t_ns"].to_pylist()
    why = draw_pictures(
        RunFolder(run.path), times[-1:], lambda _, picture, __: pictures.append(picture)
    )
    assert (why, len(pictures)) == ("", 1)
    plan = plans_of(RunFolder(run.path), times[-1:])[times[-1]]
    # Road is green, and on either side of the axis, near the car.
    greens = (plan == np.array([90, 160, 60], np.uint8)).all(axis=2)
    assert greens[:, : plan.shape[1] // 2].sum() > 200
    assert greens[:, plan.shape[1] // 2 :].sum() > 200


def test_estimating_again_needs_no_picture_and_wheels_alone_use_none(tmp_path: Path) -> None:
    run = replayed(tmp_path)
    before = run["measurements"]
    again = crosscue.estimate_run(run)
    assert again["measurements"].equals(before)
    (tmp_path / "wheels.toml").write_text(f'{SETUP}[odometry]\nkind = "wheels"\n')
    wheels = crosscue.estimate_run(run, tmp_path / "wheels.toml")
    assert not wheels["measurements"].num_rows
    assert scene_of(wheels)[1].without_odometry > 0


def test_pictures_are_not_followed_where_the_file_says_wheels(tmp_path: Path) -> None:
    run = replayed(tmp_path, '[odometry]\nkind = "wheels"\n')
    assert "visual_odometry" not in run.tables


def test_odometry_of_a_log_with_speeds_is_used_unless_the_file_says_visual() -> None:
    topics = [(0, Topic("odometry", "nav_msgs/msg/Odometry", "columns"))]
    usual, visual = (
        plan(topics, parse(f"version = 1\n[odometry]\nkind = '{kind}'\n", "here"))
        for kind in ("auto", "visual")
    )
    assert usual.source_of(Signal.WHEEL_SPEEDS) is not None
    assert visual.source_of(Signal.WHEEL_SPEEDS) is None
    assert "visual" in visual.missing[Signal.WHEEL_SPEEDS]


def test_distances_from_pictures_have_the_scale_error_of_the_cameras_height() -> None:
    assert with_visual_scale(parse(SETUP, "here")).odometry.scale_sd == 0.05
    worse = parse(f"{SETUP}[odometry]\nscale_sd = 0.2\n", "here")
    assert with_visual_scale(worse).odometry.scale_sd == 0.2


def test_pictures_are_also_compared_for_the_pitch_where_road_is_accumulated() -> None:
    for more, finds_road, expected in (
        ("", True, True),
        ('[odometry]\nkind = "wheels"\n', True, False),
        ('[regions]\nkind = "picture"\n[odometry]\nkind = "wheels"\n', False, False),
        ('[odometry]\nkind = "visual"\n', False, True),
    ):
        drive = Drive((), parse(SETUP + more, "here"))
        assert uses_pictures(drive, finds_road=finds_road) is expected


def test_a_real_side_street_is_believed_from_pictures_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """KITTI's T junction: a street to the right, nothing to the left, no light and no sign."""
    monkeypatch.setenv("CROSSCUE_MODELS", str(tmp_path / "models"))
    fetch_weights(ROADS, shared("weights") / ROADS)
    pictures = shared("sequences") / "kitti_t_junction" / "image_0"
    log = picture_log(tmp_path / "log", sorted(pictures.iterdir())[22:42], 9.64)
    (tmp_path / "car.toml").write_text(
        "version = 1\n[camera]\nfocal_px = 707.0912\ncenter_px = [601.8873, 183.1104]\n"
        f'x_m = 1.03\nz_m = 1.65\n[detectors.road]\nkind = "{ROADS}"\n'
    )
    run = crosscue.replay_drive(log, tmp_path / "run", tmp_path / "car.toml")
    travelled = np.array(run["measurements"]["distance_m"].to_pylist()[1:], np.float64)
    assert travelled == pytest.approx(np.full(len(travelled), 1.19), rel=0.1)
    last = run.belief.to_pylist()[-1]
    assert last["right"] > 0.9
    assert last["intersection"] > 0.9
    assert last["straight"] > 0.9
    assert last["left"] < 0.5
    (approach,) = scene_of(run)[1].approaches
    assert approach.reference == "start"
