"""One pass from logs to a run folder."""

import math
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from crosscue.eval import cli
from crosscue.eval.pipeline.outcome import Outcome
from crosscue.eval.pipeline.replay import replay_drive
from crosscue.eval.runs.folder import create
from crosscue.replay.base import EVERYTHING
from crosscue.replay.columns import Block
from crosscue.replay.errors import EmptyResultError, RunError, VehicleError
from crosscue.replay.vehicle.pose import Start
from crosscue.replay.vehicle.time import Time
from crosscue.replay.vehicle.vehicle import Vehicle, parse
from support.data import shared
from support.manifests import estimate_manifest
from support.memory_log import GYRO, WHEELS, MemoryLog, gyro_block, wheel_block

SECOND = 1_000_000_000
SEGMENT = ("comma2k19", "Example_1", "b0c9d2329ad1606b_2018-08-02--08-34-47", "40")


def _drive(yaw_rate_radps: float, seconds: int = 20, speed_mps: float = 10.0) -> list[Block]:
    """Ten wheel rows and twenty gyro rows per second."""
    blocks: list[Block] = []
    for second in range(seconds):
        start = second * SECOND
        gyro_t = [start + i * SECOND // 20 for i in range(20)]
        wheel_t = [start + i * SECOND // 10 for i in range(10)]
        blocks.append(gyro_block(gyro_t, [yaw_rate_radps] * 20))
        blocks.append(wheel_block(wheel_t, [speed_mps] * 10))
    return blocks


def _replay(path: Path, blocks: list[Block], vehicle: Vehicle | None = None) -> Outcome:
    log = MemoryLog((WHEELS, GYRO), blocks, path=Path(__file__))
    vehicle = vehicle or Vehicle(version=1, start=Start(heading_rad=0.0))
    return replay_drive([log], vehicle, create(path, overwrite=True), EVERYTHING)


def test_straight_drive_ends_straight_ahead_of_start(tmp_path: Path) -> None:
    vehicle = Vehicle(version=1, start=Start(x_m=5.0, y_m=-3.0, heading_rad=math.pi / 3))

    outcome = _replay(tmp_path / "run", _drive(0.0), vehicle)

    table = outcome.run.table("pose")
    last = {name: table[name][-1].as_py() for name in table.column_names}
    assert last["x_m"] == pytest.approx(5.0 + 199.0 * math.cos(math.pi / 3), abs=1e-6)
    assert last["y_m"] == pytest.approx(-3.0 + 199.0 * math.sin(math.pi / 3), abs=1e-6)
    assert outcome.travelled_m == pytest.approx(199.0)
    assert outcome.exit_status == 0


def test_full_circle_ends_at_start(tmp_path: Path) -> None:
    yaw_rate = 2.0 * math.pi / 19.9

    table = _replay(tmp_path / "run", _drive(yaw_rate)).run.table("pose")

    end = np.array([table["x_m"][-1].as_py(), table["y_m"][-1].as_py()])
    assert np.linalg.norm(end) < 1e-6


def test_speed_starts_at_first_measured_wheel_speed(tmp_path: Path) -> None:
    blocks = _drive(0.0, speed_mps=17.0)

    speeds = _replay(tmp_path / "run", blocks).run.table("pose")["speed_mps"].to_numpy()

    np.testing.assert_allclose(speeds, 17.0, atol=1e-9)


def test_pose_starts_with_first_finite_wheel_speed(tmp_path: Path) -> None:
    unknown = wheel_block([-SECOND, -SECOND // 2], [math.nan, math.nan])

    outcome = _replay(tmp_path / "run", [unknown, *_drive(0.0, speed_mps=17.0)])

    table = outcome.run.table("pose")
    assert min(table["t_ns"].to_pylist()) > 0
    np.testing.assert_allclose(table["speed_mps"].to_numpy(), 17.0, atol=1e-9)
    assert estimate_manifest(outcome.run).counts.odometry["not_finite"] == 2


@pytest.mark.parametrize("speed_mps", [0.0, 3.0, 17.0])
def test_all_tables_hold_only_driven_speed(tmp_path: Path, speed_mps: float) -> None:
    unknown = wheel_block([-SECOND, -SECOND // 2], [math.nan, math.nan])
    drive = _drive(0.05, speed_mps=speed_mps)
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
        _replay(tmp_path / f"{sign}", _drive(sign * 0.1)).run.table("pose") for sign in (1, -1)
    )

    np.testing.assert_allclose(left["x_m"], right["x_m"], rtol=0, atol=1e-9)
    np.testing.assert_allclose(left["y_m"].to_numpy(), -right["y_m"].to_numpy(), atol=1e-9)


def test_repeated_replay_writes_same_bytes(tmp_path: Path) -> None:
    for name in ("a", "b"):
        _replay(tmp_path / name, _drive(0.05))

    for table in ("pose.parquet", "skipped.parquet"):
        assert (tmp_path / "a" / table).read_bytes() == (tmp_path / "b" / table).read_bytes()


def test_wheel_rows_that_are_not_finite_are_counted_and_skipped(tmp_path: Path) -> None:
    blocks = _drive(0.0)
    blocks[5] = wheel_block([2 * SECOND + 1], [math.nan])

    vehicle = Vehicle(version=1, start=Start(heading_rad=0.0), time=Time(max_silence_s=1.5))

    outcome = _replay(tmp_path / "run", blocks, vehicle)

    counts = estimate_manifest(outcome.run).counts.odometry
    assert counts["not_finite"] == 1
    assert counts["gaps"] == 1
    assert np.isfinite(outcome.run.table("pose")["x_m"].to_numpy()).all()


def test_manifest_records_rows_settings_and_sources(tmp_path: Path) -> None:
    manifest = estimate_manifest(_replay(tmp_path / "run", _drive(0.0)).run)

    wheels = manifest.account.reading[0].topics["wheels"]
    assert wheels.used == wheels.entered == 200
    assert manifest.settings.odometry.track_width_m == 1.55
    assert str(manifest.sources["yaw_rate"]).endswith("gyro")
    assert manifest.versions["crosscue"]


def test_log_without_wheels_and_camera_is_refused(tmp_path: Path) -> None:
    log = MemoryLog((GYRO,), [gyro_block([1, 2], [0.0, 0.0])], path=Path(__file__))
    run = create(tmp_path / "run", overwrite=False)

    with pytest.raises(EmptyResultError, match=r"no wheel speeds: name the bus.*gyro \(2 rows\)"):
        replay_drive([log], Vehicle(version=1), run, EVERYTHING)
    assert not list(run.path.iterdir())


def test_can_signals_without_dbc_are_refused(tmp_path: Path) -> None:
    vehicle = parse(
        'version = 1\n[can.wheel_speeds]\nrear_left = "A.L"\nrear_right = "A.R"', "car.toml"
    )

    with pytest.raises(VehicleError, match=r"can\.dbc: missing"):
        _replay(tmp_path / "run", _drive(0.0), vehicle)


def test_existing_run_is_not_overwritten_by_default(tmp_path: Path) -> None:
    _replay(tmp_path / "run", _drive(0.0))

    with pytest.raises(RunError, match="--overwrite"):
        create(tmp_path / "run", overwrite=False)


def test_real_comma2k19_segment_replays_from_command_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    segment, dbc = shared(*SEGMENT), shared("comma2k19", "toyota_2017.dbc")
    car, run = tmp_path / "car.toml", tmp_path / "run"

    # One array of this recording is truncated, which readers report: exit status 3.
    assert cli.run(["vehicle", "init", str(segment), "--dbc", str(dbc), "-o", str(car)]) == 3
    assert cli.run(["fit", "compass", str(segment), "--vehicle", str(car), "-o", str(car)]) == 3
    assert "hard iron: headings cover" in capsys.readouterr().out
    status = cli.run(["replay", str(segment), "--vehicle", str(car), "-o", str(run)])

    assert status == 3
    assert "dropped 64 of reading imu/magnetometer_uncalibrated" in capsys.readouterr().out
    assert cli.run(["replay", str(segment), "--vehicle", str(car), "-o", str(run)]) == 1
    assert "--overwrite" in capsys.readouterr().err
