"""Segments of comma.ai: openpilot's messages and comma2k19's arrays, and their damage."""

import bz2
import math
import shutil
from pathlib import Path

import numpy as np
import pytest
import zstandard
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from crosscue.datasets.adapters.capnp import MessageError, Struct, messages
from crosscue.datasets.adapters.comma2k19 import STREAMS, read_column
from crosscue.datasets.adapters.comma2k19_truth import write_comma_truth
from crosscue.datasets.adapters.openpilot import OTHER
from crosscue.eval import cli
from crosscue.replay.base import Selection
from crosscue.replay.columns import CanFrames, Table
from crosscue.replay.errors import LogFormatError
from crosscue.replay.limits import Limits
from crosscue.replay.logs.opening import open_log
from crosscue.replay.signals.kinds import Signal
from crosscue.replay.signals.plan import plan
from crosscue.replay.vehicle.vehicle import load
from support.accounted import column, read, read_topics
from support.data import shared
from support.openpilot_drive import (
    START_NS,
    at_ns,
    drive_messages,
    event,
    event_type,
    openpilot_drive,
)
from support.videos import numbers_at_times

FRAMES = 24


def test_rows_have_the_written_values_in_our_axes_and_units(tmp_path: Path) -> None:
    found, ledger = read_topics(openpilot_drive(tmp_path / "segment", FRAMES))

    def row(topic: str) -> list[float]:
        table = found[topic][0].rows
        assert isinstance(table, Table)
        return [float(column[0]) for column in table.columns.values()]

    assert row("car/wheel_speed") == [9.5, 10.5, 9.75, 10.25]
    assert row("car/speed") == [10.0, 0.5]
    assert row("car/steering_angle") == [-3.5]
    # The device's axes are up, left, back: a left turn has a positive rate about z.
    assert row("imu/gyro") == pytest.approx([0.03, 0.02, 0.1])
    assert row("gnss/external") == pytest.approx(
        [37.5, -122.25, 12.0, 2.5, 10.0, math.radians(30.0), 1.6e12]
    )
    assert row("camera/calibration") == pytest.approx([0.0, -0.02, 0.01, 1.25, 1.0])
    (frames,) = found["can/0"]
    assert isinstance(frames.rows, CanFrames)
    assert frames.log_ns.tolist() == [START_NS + 50_000_000 * i for i in range(FRAMES)]
    assert frames.rows.arbitration_id.tolist() == [0xAA] * FRAMES
    assert frames.rows.length.tolist() == [4] * FRAMES
    assert frames.rows.data[:, 0].tolist() == list(range(FRAMES))
    (sent,) = found["can/128"]
    assert isinstance(sent.rows, CanFrames)
    assert sent.rows.is_extended.all()
    assert sent.rows.is_tx is not None
    assert sent.rows.is_tx.all()
    # The time of a picture is that of the end of its exposure.
    assert numbers_at_times(found["qcamera"], "h264") == {at_ns(i): i for i in range(FRAMES)}
    other = ledger.topic(OTHER)
    assert (other.found, other.skipped.total()) == (FRAMES, FRAMES)
    assert ledger.is_whole


@pytest.mark.parametrize("name", ["rlog", "rlog.bz2", "rlog.zst", "qlog"])
def test_every_file_name_gives_the_same_rows(name: str, tmp_path: Path) -> None:
    segment = openpilot_drive(tmp_path / "a", FRAMES, name)
    if name == "rlog.zst":
        plain = b"".join(drive_messages(FRAMES))
        (segment / name).write_bytes(zstandard.compress(plain))

    found, ledger = read_topics(segment)

    assert len(found["can/0"][0]) == FRAMES
    assert any("qlog: the device kept few" in one for one in ledger.notices) == (name == "qlog")


@pytest.mark.parametrize("name", ["rlog", "rlog.bz2"])
def test_cut_log_keeps_its_messages_and_reports_the_rest(name: str, tmp_path: Path) -> None:
    segment = openpilot_drive(tmp_path / "segment", FRAMES, name)
    raw = (segment / name).read_bytes()
    if name == "rlog.bz2":
        # A compressed block is read whole or not at all.
        plain = drive_messages(FRAMES)
        raw = b"".join(bz2.compress(b"".join(plain[i : i + 30])) for i in range(0, 120, 30))
    (segment / name).write_bytes(raw[: len(raw) * 3 // 4])

    found, ledger = read_topics(segment)

    assert 0 < len(found["can/0"][0]) < FRAMES
    assert [(one.reason, one.count) for one in ledger.drops() if not one.topic] == [
        ("file is cut or damaged", None)
    ]


def test_log_larger_than_a_container_may_be_is_cut_there(tmp_path: Path) -> None:
    segment = openpilot_drive(tmp_path / "segment", FRAMES)
    bomb = b"".join(drive_messages(FRAMES)) + bytes(1 << 24)
    (segment / "rlog.bz2").write_bytes(bz2.compress(bomb))

    blocks, ledger = read(segment, limits=Limits(chunk_bytes=1 << 20))

    assert sum(map(len, blocks)) > FRAMES
    assert "raise --max-chunk" in next(one.detail for one in ledger.drops())


def test_message_in_several_segments_isread_topics(tmp_path: Path) -> None:
    """The library begins a new segment when the first is full, and points there."""
    large = [{"address": i, "dat": bytes([i % 256] * 8), "src": 1} for i in range(5000)]
    built = event_type().new_message(logMonoTime=START_NS)
    frames = built.init("can", 5000)
    for one, wanted in zip(frames, large, strict=True):
        one.address, one.dat, one.src = wanted["address"], wanted["dat"], wanted["src"]
    coded = built.to_bytes()
    assert int.from_bytes(coded[:4], "little") > 0
    segment = tmp_path / "segment"
    segment.mkdir()
    (segment / "rlog").write_bytes(coded)

    found, _ = read_topics(segment)

    rows = found["can/1"][0].rows
    assert isinstance(rows, CanFrames)
    assert np.array_equal(rows.arbitration_id, np.arange(5000))
    assert np.array_equal(rows.data[:, 3], np.arange(5000) % 256)


MESSAGE = event(START_NS, can=[{"address": 5, "dat": b"abc", "src": 0}])


@given(st.integers(8, len(MESSAGE) - 1), st.integers(0, 255))
def test_damaged_message_is_refused_or_read_within_its_bytes(at: int, value: int) -> None:
    coded = bytearray(MESSAGE)
    coded[at] = value
    stream = iter([bytes(coded[:4]), bytes(coded[4:8]), bytes(coded[8:]), b""])
    try:
        for body, edges in messages(lambda size: next(stream)[:size], 1 << 20):
            root = Struct.root(body, edges)
            assert all(len(one.blob(0)) <= len(MESSAGE) for one in root.structs(0))
    except MessageError:
        pass


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
