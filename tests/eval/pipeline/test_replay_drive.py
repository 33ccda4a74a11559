"""Replayed poses and travelled distances."""

import math
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from crosscue.eval import cli
from crosscue.eval.pipeline.outcome import Outcome
from crosscue.eval.pipeline.scene.variants import scene_tables
from crosscue.eval.pipeline.whole_run import replay_drive
from crosscue.eval.runs.drive import Drive
from crosscue.eval.runs.folder import create
from crosscue.eval.runs.tables.travelled import Odometer, Way, odometer_of
from crosscue.eval.scoring.run_tables import in_log_time
from crosscue.eval.scoring.scene.ranges import smoothed_rows
from crosscue.replay.columns import Block
from crosscue.replay.time.segments import ONE_SEGMENT
from crosscue.replay.vehicle.pose import Start
from crosscue.replay.vehicle.vehicle import Vehicle, parse
from support.commands import output_of
from support.data import shared
from support.gap_drive import VEHICLE, Clock, replayed, write_drive
from support.memory_log import GYRO, WHEELS, MemoryLog, driven_blocks, wheel_block
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
    return Odometer(iter([(start, stop, distance_m, 0.1 * distance_m, 0.01 * distance_m, is_gap)]))


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
