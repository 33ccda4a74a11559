"""comma2k19 segments: the real one, and the treatment of damaged arrays."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from crosscue.datasets.adapters.comma2k19 import STREAMS, read_column
from crosscue.datasets.adapters.comma2k19_truth import write_comma_truth
from crosscue.eval import cli
from crosscue.replay.base import Selection
from crosscue.replay.errors import LogFormatError
from crosscue.replay.logs.opening import open_log
from crosscue.replay.signals.kinds import Signal
from crosscue.replay.signals.plan import plan
from crosscue.replay.vehicle.vehicle import load
from support.accounted import column, read
from support.data import shared

SEGMENT = ("comma2k19", "Example_1", "b0c9d2329ad1606b_2018-08-02--08-34-47", "40")


def _save(path: Path, rows: NDArray[np.generic]) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("wb") as file:
        np.save(file, rows)
    return path


def test_every_row_of_the_real_segment_is_accounted_for() -> None:
    blocks, ledger = read(shared(*SEGMENT))

    accounts = ledger.accounts
    assert sum(accounts[f"can/{bus}"].used for bus in (0, 1, 128, 129)) == 135_468
    assert sum(map(len, blocks)) == sum(account.found for account in accounts.values())
    # One array of the published example is truncated; the rest is complete.
    damaged = {name: a.dropped.total() for name, a in accounts.items() if not a.is_whole}
    assert damaged == {"imu/magnetometer_uncalibrated": 64}


def test_gyro_axes_are_converted_to_forward_left_up() -> None:
    path = shared(*SEGMENT)
    raw = np.load(path / "processed_log/IMU/gyro/value", allow_pickle=False)
    blocks, _ = read(path, Selection(frozenset({"imu/gyro"})))

    np.testing.assert_array_equal(column(blocks, "gyro_z_radps"), -raw[:, 2])


@pytest.mark.parametrize("order", ["C", "F"])
@pytest.mark.parametrize("cut_bytes", [0, 1, 8, 100, 700, 10_000])
def test_truncated_array_yields_exactly_its_complete_rows(
    tmp_path: Path, order: str, cut_bytes: int
) -> None:
    rows = np.arange(90.0).reshape(30, 3)
    path = _save(tmp_path / "value", np.asarray(rows, order="F" if order == "F" else "C"))
    header = path.stat().st_size - rows.nbytes
    keep = max(header, path.stat().st_size - cut_bytes)
    path.write_bytes(path.read_bytes()[:keep])

    column = read_column(path)

    assert column.declared == 30
    np.testing.assert_array_equal(column.rows, rows[: len(column.rows)])
    cells = (keep - header) // 8
    whole = cells // 3 if order == "C" else max(0, cells - 60)
    assert len(column.rows) == whole


# Arrays of unexpected type or shape that a file might contain.
UNEXPECTED_ARRAYS: dict[str, NDArray[np.generic]] = {
    "no columns": np.zeros(40),
    "two columns": np.zeros((40, 2)),
    "a third dimension": np.zeros((40, 3, 2)),
    "text": np.full(40, b"abc"),
    "complex": np.zeros((40, 3), np.complex128),
    "no row": np.zeros((0, 3)),
}


def _segment(folder: Path) -> Path:
    """Write every array that a segment may have, with 40 rows each."""
    for stream in STREAMS.values():
        place = folder / "processed_log" / stream.folder
        _save(place / "t", np.arange(40) * 0.1)
        _save(place / "value", np.ones((40, stream.width)))
    can = folder / "processed_log" / "CAN" / "raw_can"
    for name in ("src", "address"):
        _save(can / name, np.ones(40, np.int64))
    _save(can / "t", np.arange(40) * 0.1)
    _save(can / "data", np.full(40, b"12345678"))
    pose = folder / "global_pose"
    _save(pose / "frame_times", np.arange(40) * 0.1)
    _save(pose / "frame_positions", np.full((40, 3), 4e6))
    _save(pose / "frame_orientations", np.tile([1.0, 0.0, 0.0, 0.0], (40, 1)))
    return folder


@pytest.mark.parametrize("kind", UNEXPECTED_ARRAYS)
def test_array_of_unexpected_type_is_reported(kind: str, tmp_path: Path) -> None:
    log = _segment(tmp_path / "segment")
    rows, _ = read(log)
    for file in [one for one in sorted(log.rglob("*")) if one.is_file()]:
        whole = file.read_bytes()
        _save(file, UNEXPECTED_ARRAYS[kind])

        blocks, ledger = read(log)

        if "processed_log" in file.parts and sum(map(len, blocks)) < sum(map(len, rows)):
            assert not ledger.is_whole, file
        assert all(block.log_ns.ndim == 1 for block in blocks)
        if "global_pose" in file.parts:
            with pytest.raises(LogFormatError, match="global_pose"):
                write_comma_truth(log, tmp_path / "truth")
        file.write_bytes(whole)


def test_drafted_vehicle_reads_the_speed_of_a_car_without_wheel_speeds(tmp_path: Path) -> None:
    """Some of the published cars have none. The magnetometer is cut, as published: exit 3."""
    segment, car = tmp_path / "segment", tmp_path / "car.toml"
    shutil.copytree(shared(*SEGMENT), segment, ignore=shutil.ignore_patterns("wheel_speed"))

    assert cli.run(["vehicle", "init", str(segment), "-o", str(car)]) == 3

    with open_log(segment) as log:
        planned = plan([(0, topic) for topic in log.topics], load(car))
    assert [one.topic.name for one in planned.sources if Signal.WHEEL_SPEEDS in one.signals] == [
        "car/speed"
    ]
