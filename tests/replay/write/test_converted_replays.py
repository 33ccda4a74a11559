"""A converted log has the same roles as its original, and replays to the same tables."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from crosscue.eval import cli
from crosscue.replay.logs.opening import open_log
from crosscue.replay.vehicle.roles import role_of
from support.data import shared
from support.every_format import EVERY_FORMAT

# Formats with their own columns, whose types are chosen by ``convert``.
TABLES = ("comma2k19", "kitti-raw", "images")
# Streams of a comma2k19 segment and their columns.
COLUMNS = {
    "CAN/wheel_speed": 4,
    "CAN/speed": 1,
    "CAN/steering_angle": 1,
    "IMU/gyro": 3,
    "IMU/accelerometer": 3,
    "IMU/gyro_bias": 3,
    "IMU/gyro_uncalibrated": 3,
    "IMU/magnetometer": 3,
}


def circular_segment(folder: Path) -> Path:
    """Write a comma2k19 segment of ten seconds in a circle at 10 m/s."""
    t_s = np.arange(1000) * 0.01
    for name, count in COLUMNS.items():
        place = folder / "segment" / "processed_log" / name
        place.mkdir(parents=True)
        values = np.full((len(t_s), count), 10.0 if name.startswith("CAN") else 0.1)
        for file, rows in (("t", t_s), ("value", values)):
            with (place / file).open("wb") as opened:
                np.save(opened, rows)
    return folder / "segment"


def convert(log: Path, out: Path) -> Path:
    assert cli.run(["convert", str(log), "-o", str(out)]) in (0, 3)
    return out


@pytest.mark.parametrize("name", TABLES)
def test_converted_topics_keep_their_roles(name: str, tmp_path: Path) -> None:
    log = circular_segment(tmp_path) if name == "comma2k19" else EVERY_FORMAT[name](tmp_path)
    converted_twice = convert(convert(log, tmp_path / "once.mcap"), tmp_path / "twice.mcap")

    with open_log(log) as first, open_log(converted_twice) as second:
        roles = {topic.name: role_of(topic) for topic in first.topics}
        found = {topic.name: role_of(topic) for topic in second.topics}

    assert found
    assert found == {name: roles[name] for name in found}


def _tables(log: Path, run: Path) -> dict[str, object]:
    assert cli.run(["replay", str(log), "-o", str(run)]) in (0, 3)
    names = ("pose", "measurements")
    return {name: pq.read_table(run / f"{name}.parquet").to_pydict() for name in names}


def test_converted_segment_replays_like_original(tmp_path: Path) -> None:
    log = circular_segment(tmp_path)
    first = _tables(log, tmp_path / "first")
    pose = first["pose"]
    assert isinstance(pose, dict)
    assert max(pose["travelled_m"]) == pytest.approx(100.0, rel=0.05)

    assert _tables(convert(log, tmp_path / "log.mcap"), tmp_path / "second") == first


@pytest.mark.slow
def test_converted_real_segment_replays_like_original(tmp_path: Path) -> None:
    (log,) = shared("comma2k19/Example_1").glob("*/40")

    assert _tables(convert(log, tmp_path / "log.mcap"), tmp_path / "b") == _tables(
        log, tmp_path / "a"
    )
