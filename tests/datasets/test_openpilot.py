"""openpilot segments: values, times and axes as the Cap'n Proto library wrote them; damage."""

import bz2
import math
from pathlib import Path

import numpy as np
import pytest
import zstandard
from hypothesis import given
from hypothesis import strategies as st

from crosscue.datasets.adapters.capnp import MessageError, Struct, messages
from crosscue.datasets.adapters.openpilot import OTHER
from crosscue.replay.columns import CanFrames, Table
from crosscue.replay.limits import Limits
from support.accounted import read, read_topics
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
