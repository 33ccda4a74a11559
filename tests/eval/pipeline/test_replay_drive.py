"""One pass from logs to a run folder."""

import math
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from crosscue.eval import cli
from crosscue.eval.pipeline.outcome import Outcome
from crosscue.eval.pipeline.whole_run import replay_drive
from crosscue.eval.runs.drive import Drive
from crosscue.eval.runs.folder import create
from crosscue.replay.columns import Block
from crosscue.replay.vehicle.pose import Start
from crosscue.replay.vehicle.vehicle import Vehicle
from support.data import shared
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
    return replay_drive(Drive([log], vehicle), create(path, overwrite=True))


def test_full_circle_ends_at_start(tmp_path: Path) -> None:
    yaw_rate = 2.0 * math.pi / 19.9

    table = _replay(tmp_path / "run", _drive(yaw_rate)).run.table("pose")

    end = np.array([table["x_m"][-1].as_py(), table["y_m"][-1].as_py()])
    assert np.linalg.norm(end) < 1e-6


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
