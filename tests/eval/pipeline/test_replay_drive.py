"""Replayed poses and distances; drives of pictures alone."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

import crosscue
from crosscue.detectors import rle
from crosscue.detectors.base import Frame, RoadMask, View
from crosscue.detectors.catalog.fetch import fetch_weights
from crosscue.eval import cli
from crosscue.eval.pipeline.outcome import Outcome
from crosscue.eval.pipeline.run import Run
from crosscue.eval.pipeline.scene.road_picture import plans_of
from crosscue.eval.pipeline.scene.variants import scene_tables
from crosscue.eval.pipeline.visual import uses_pictures, with_visual_scale
from crosscue.eval.pipeline.whole_run import replay_drive
from crosscue.eval.report.frame_pictures import draw_pictures
from crosscue.eval.runs.drive import Drive
from crosscue.eval.runs.folder import RunFolder, create
from crosscue.eval.runs.manifest import EstimateManifest, SceneSummary
from crosscue.eval.runs.tables.travelled import Odometer, OdometryRow, Way, odometer_of
from crosscue.eval.scoring.run_tables import in_log_time
from crosscue.eval.scoring.scene.ranges import smoothed_rows
from crosscue.replay.columns import Block, Topic
from crosscue.replay.signals.kinds import Signal
from crosscue.replay.signals.plan import plan
from crosscue.replay.time.segments import ONE_SEGMENT
from crosscue.replay.vehicle.pose import Start
from crosscue.replay.vehicle.vehicle import Vehicle, parse
from support.commands import output_of
from support.data import shared
from support.detecting import Nothing
from support.gap_drive import VEHICLE, Clock, replayed, write_drive
from support.memory_log import GYRO, WHEELS, MemoryLog, driven_blocks, wheel_block
from support.pictures import picture_log
from support.plane_pictures import CAMERA, SIZE_PX, arc, picture
from support.refusals import refusal

SECOND = 1_000_000_000
SEGMENT = ("comma2k19", "Example_1", "b0c9d2329ad1606b_2018-08-02--08-34-47", "40")


def _replay(path: Path, blocks: list[Block], vehicle: Vehicle | None = None) -> Outcome:
    log = MemoryLog((WHEELS, GYRO), blocks, path=Path(__file__))
    vehicle = vehicle or Vehicle(version=1, start=Start(heading_rad=0.0))
    return replay_drive(Drive([log], vehicle), create(path, overwrite=True))


def test_full_circle_ends_at_start(tmp_path: Path) -> None:
    yaw_rate = 2.0 * math.pi / 19.9

    table = _replay(tmp_path / "run", driven_blocks(20, 10.0, yaw_rate)).run.table("pose")

    end = np.array([table["x_m"][-1].as_py(), table["y_m"][-1].as_py()])
    assert np.linalg.norm(end) < 1e-6


@pytest.mark.parametrize("speed_mps", [0.0, 3.0, 17.0])
def test_all_tables_hold_only_driven_speed(tmp_path: Path, speed_mps: float) -> None:
    unknown = wheel_block([-SECOND, -SECOND // 2], [math.nan, math.nan])
    drive = driven_blocks(20, speed_mps, 0.05)
    with_a_gap = [unknown, *drive[:10], *drive[30:]]

    run = _replay(tmp_path / "run", with_a_gap).run

    found = {}
    for file in sorted(run.path.glob("*.parquet")):
        table = pq.read_table(file)
        for name in {"speed_mps", "ego_speed_mps"} & {*table.column_names}:
            speeds = table[name].to_numpy()
            found[file.stem] = speeds[np.isfinite(speeds)]
    assert {"pose", "measurements"} <= found.keys()
    for name, speeds in found.items():
        np.testing.assert_allclose(speeds, speed_mps, atol=1e-6, err_msg=name)


def test_mirrored_input_yields_mirrored_path(tmp_path: Path) -> None:
    left, right = (
        _replay(tmp_path / f"{rate}", driven_blocks(20, 10.0, rate)).run.table("pose")
        for rate in (0.1, -0.1)
    )

    np.testing.assert_allclose(left["x_m"], right["x_m"], rtol=0, atol=1e-9)
    np.testing.assert_allclose(left["y_m"].to_numpy(), -right["y_m"].to_numpy(), atol=1e-9)
    assert left["y_m"][-1].as_py() > 1.0


def test_real_comma2k19_segment_replays_from_command_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    segment, dbc = shared(*SEGMENT), shared("comma2k19", "toyota_2017.dbc")
    car, run = tmp_path / "car.toml", tmp_path / "run"

    # One array of this recording is truncated, which readers report: exit status 3.
    assert cli.run(["vehicle", "init", str(segment), "--dbc", str(dbc), "-o", str(car)]) == 3
    assert "hard iron: headings cover" in output_of(
        "fit", "compass", segment, "--vehicle", car, "-o", car, status=3
    )
    status = cli.run(["replay", str(segment), "--vehicle", str(car), "-o", str(run)])

    assert status == 3
    assert "dropped 64 of reading imu/magnetometer_uncalibrated" in capsys.readouterr().out
    assert "--overwrite" in refusal(1, "replay", segment, "--vehicle", car, "-o", run)


def _odometer() -> Odometer:
    """Odometry at 10 m/s: two seconds, an assumed gap of two seconds, and two more seconds."""
    start = np.array([0, 1, 2, 4, 5]) * SECOND
    stop = np.array([1, 2, 4, 5, 6]) * SECOND
    distance_m = np.array([10.0, 10.0, 20.0, 10.0, 10.0])
    is_gap = np.array([False, False, True, False, False])
    columns = (start, stop, distance_m, 0.1 * distance_m, 0.01 * distance_m, is_gap)
    return Odometer(map(OdometryRow._make, zip(*(one.tolist() for one in columns), strict=True)))


def test_distance_across_gap_is_reported_as_assumed() -> None:
    odometer = _odometer()

    assert odometer.until(SECOND) == Way(10.0, 0.1, 1.0, SECOND)
    assert odometer.until(3 * SECOND) == Way(20.0, 0.2, 2.0, 2 * SECOND, SECOND, 10.0)
    rest = odometer.until(6 * SECOND)
    assert (rest.distance_m, rest.assumed_m) == pytest.approx((30.0, 10.0))


def test_distance_before_skip_is_not_counted() -> None:
    odometer = _odometer()

    odometer.skip_to(3 * SECOND)

    assert odometer.until(5 * SECOND) == Way(10.0, 0.1, 1.0, SECOND)


@pytest.mark.parametrize("kind", ["curve", "motion"])
def test_process_noise_of_a_range_enters_in_one_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    """Noise that grows with the distance reaches the filter, tracks and the smoother."""
    run = replayed(tmp_path, write_drive(tmp_path, Clock(), seconds=9))
    sections = f'[ranges]\nkind = "{kind}"\n[ranges.stop_sign]\n'
    vehicle = parse(VEHICLE.replace("[ranges.stop_sign]\n", sections), "car.toml")
    before = scene_tables(run, vehicle)
    rows = in_log_time("run", {"range": before["range"]}, ONE_SEGMENT).ranges
    assert rows is not None
    smoothed = smoothed_rows(rows, odometer_of(run))

    def more(travelled_m: float, odometry_var_m2: float, seconds: float) -> float:
        return odometry_var_m2 + (0.3 * travelled_m) ** 2

    monkeypatch.setattr("crosscue.eval.runs.tables.travelled.range_noise_m2", more)
    after = scene_tables(run, vehicle)

    widths = [np.array(one["range"]["var_m2"].to_pylist()) for one in (before, after)]
    assert len(widths[0]) == len(widths[1]) > 20
    assert widths[1].mean() > 1.02 * widths[0].mean()
    assert not np.array_equal(smoothed.range_m, smoothed_rows(rows, odometer_of(run)).range_m)


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


class StraightRoad:
    """A detector to which the ground is road, up to three heights of the camera to each side."""

    view, identity, labels = View(is_grey=True), "straight road", ()

    def __call__(self, frames: Sequence[Frame], /) -> list[RoadMask]:
        """Return the road's pixels, from 20 rows below the middle of each picture on."""
        width, height = SIZE_PX
        below = np.arange(height)[:, None] - height // 2
        pixels = (np.abs(np.arange(width) - width // 2) < 3 * below) & (below > 20)
        mask = rle.encode_mask(pixels, (0, 0), SIZE_PX)
        return [RoadMask(frame.t_ns, SIZE_PX, mask, SIZE_PX) for frame in frames]


def scene_of(run: Run) -> tuple[EstimateManifest, SceneSummary]:
    """Return the manifest of a run, and its scene."""
    manifest = run.manifest
    assert isinstance(manifest, EstimateManifest)
    assert manifest.scene is not None
    return manifest, manifest.scene


def replayed_pictures(folder: Path, more: str = "", detector: object = Nothing) -> Run:
    """Replay a rendered drive: three pictures standing, then six steps of a gentle turn."""
    poses = [(0.0, 0.0, 0.0)] * 2 + arc(STEP_M, math.radians(1.0), 6)
    log = picture_log(folder / "log", [picture(*pose) for pose in poses])
    (folder / "car.toml").write_text(SETUP + more)
    return crosscue.replay_drive(log, folder / "run", folder / "car.toml", [detector])


def test_pictures_alone_give_odometry_that_is_named_in_the_account(tmp_path: Path) -> None:
    run = replayed_pictures(tmp_path)
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
    run = replayed_pictures(tmp_path, detector=StraightRoad())
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
    run = replayed_pictures(tmp_path)
    before = run["measurements"]
    again = crosscue.estimate_run(run)
    assert again["measurements"].equals(before)
    (tmp_path / "wheels.toml").write_text(f'{SETUP}[odometry]\nkind = "wheels"\n')
    wheels = crosscue.estimate_run(run, tmp_path / "wheels.toml")
    assert not wheels["measurements"].num_rows
    assert scene_of(wheels)[1].without_odometry > 0


def test_pictures_are_not_followed_where_the_file_says_wheels(tmp_path: Path) -> None:
    run = replayed_pictures(tmp_path, '[odometry]\nkind = "wheels"\n')
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
