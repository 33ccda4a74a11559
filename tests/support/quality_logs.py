"""Logs of one drive in memory, good ones and awkward ones, for the checks of logs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from crosscue.eval.quality.drive import QualityDrive, examine_drive
from crosscue.replay.base import EVERYTHING
from crosscue.replay.columns import Block, Bytes, Floats, Images, Int64s, Messages, Table, Topic
from crosscue.replay.vehicle.vehicle import Vehicle, parse
from support.memory_log import MemoryLog

WHEELS: Final = ("front_left_mps", "front_right_mps", "rear_left_mps", "rear_right_mps")
TRACK_M: Final = 1.55
SIZE_PX: Final = (48, 36)
CAR: Final = parse("version = 1\n[camera]\nfocal_px = 40.0\n[start]\nx_m = 0.0\n", "test")
TYPES: Final = {
    "wheels": "crosscue/WheelSpeeds",
    "gyro": "sensor_msgs/msg/Imu",
    "gnss": "sensor_msgs/msg/NavSatFix",
    "camera": "crosscue/Images",
}


@dataclass(frozen=True, slots=True, eq=False)
class Stream:
    """One topic: times, columns, and stamps of the sensor if it has any."""

    t_s: Floats
    columns: Mapping[str, Floats] = field(default_factory=dict)
    pictures: Bytes | None = None
    header_s: Floats | None = None

    def take(self, keep: Floats | Int64s) -> Stream:
        """Some of the rows, by index or mask."""
        return Stream(
            self.t_s[keep],
            {name: column[keep] for name, column in self.columns.items()},
            None if self.pictures is None else self.pictures[keep],
            None if self.header_s is None else self.header_s[keep],
        )

    def with_column(self, name: str, values: Floats) -> Stream:
        """The stream with one changed column."""
        return replace(self, columns={**self.columns, name: values})


Streams = dict[str, Stream]


@dataclass(frozen=True, slots=True)
class Drive:
    """How the car drives, and how it is logged."""

    seconds: float = 24.0
    seed: int = 0
    wheels_hz: float = 20.0
    gyro_hz: float = 50.0
    gnss_hz: float = 2.0
    camera_hz: float = 6.0
    speed_mps: float = 10.0
    turn_rad: float = 1.2
    stops: bool = True
    noise: float = 1.0
    begins_s: float = 1000.0

    def speed(self, t_s: Floats) -> Floats:
        """True speed."""
        wave = self.speed_mps * (1.0 + 0.1 * np.sin(0.7 * t_s))
        if not self.stops:
            return np.asarray(wave, np.float64)
        brake = np.maximum(2.5 * np.abs(t_s - 0.8 * self.seconds) - 3.0, 0.0)
        return np.minimum(wave, brake)

    def yaw_rate(self, t_s: Floats) -> Floats:
        """True yaw rate: one turn, and then wavering."""
        turn = self.turn_rad / 2.0 / np.cosh((t_s - 0.3 * self.seconds) / 1.0) ** 2
        waver = 0.01 * np.sin(0.9 * t_s)
        moves = np.minimum(self.speed(t_s) / 3.0, 1.0)
        return np.asarray((turn + waver) * moves, np.float64)


def streams_of(drive: Drive) -> Streams:
    """What the sensors log, without faults."""
    rng = np.random.default_rng(drive.seed)
    streams: Streams = {}
    t_s = np.arange(0.0, drive.seconds, 1.0 / drive.wheels_hz)
    v, w = drive.speed(t_s), drive.yaw_rate(t_s)
    sides = {"left": v - 0.5 * TRACK_M * w, "right": v + 0.5 * TRACK_M * w}
    streams["wheels"] = Stream(
        t_s,
        {
            name: np.maximum(
                sides[name.split("_")[1]] + drive.noise * 0.02 * rng.normal(size=len(t_s)), 0.0
            )
            for name in WHEELS
        },
    )
    t_s = np.arange(0.003, drive.seconds, 1.0 / drive.gyro_hz)
    noise = drive.noise * 0.002 * rng.normal(size=len(t_s))
    rate = drive.yaw_rate(t_s) + 0.001 + noise
    streams["gyro"] = Stream(t_s, {"gyro_z_radps": rate}, header_s=t_s - 0.004)
    fine_s = np.arange(0.0, drive.seconds, 0.01)
    heading = np.cumsum(drive.yaw_rate(fine_s)) * 0.01
    north = np.cumsum(drive.speed(fine_s) * np.sin(heading)) * 0.01
    east = np.cumsum(drive.speed(fine_s) * np.cos(heading)) * 0.01
    t_s = np.arange(0.0, drive.seconds - 0.01, 1.0 / drive.gnss_hz)
    at_north, at_east, at_heading = (np.interp(t_s, fine_s, one) for one in (north, east, heading))
    streams["gnss"] = Stream(
        t_s,
        {
            "latitude_deg": 49.0 + at_north / 111_195.0 + 1e-7 * rng.normal(size=len(t_s)),
            "longitude_deg": 8.0 + at_east / 72_950.0 + 1e-7 * rng.normal(size=len(t_s)),
            "altitude_m": np.full(len(t_s), 110.0),
            "course_rad": at_heading + 0.01 * rng.normal(size=len(t_s)),
            "speed_mps": drive.speed(t_s) + 0.05 * rng.normal(size=len(t_s)),
        },
    )
    t_s = np.arange(0.02, drive.seconds, 1.0 / drive.camera_hz)
    pictures = rng.integers(60, 190, (len(t_s), SIZE_PX[1], SIZE_PX[0])).astype(np.uint8)
    streams["camera"] = Stream(t_s, pictures=pictures)
    return streams


def log_of(streams: Streams, begins_s: float = 1000.0) -> MemoryLog:
    """The streams as a log: rows in order of time, in blocks of a second."""
    topics = tuple(Topic(name, TYPES[name.split("_")[0]], "columns") for name in streams)
    blocks = []
    for name, stream in streams.items():
        for number in np.unique(stream.t_s // 1.0):
            rows = stream.take(np.flatnonzero(stream.t_s // 1.0 == number))
            blocks.append((number, _block(name, rows, begins_s)))
    ordered = [block for _, block in sorted(blocks, key=lambda one: one[0])]
    return MemoryLog(topics, ordered)


def _block(name: str, stream: Stream, begins_s: float) -> Block:
    def ns(seconds: Floats) -> Int64s:
        return np.round((seconds + begins_s) * 1e9).astype(np.int64)

    header_ns = None if stream.header_s is None else ns(stream.header_s)
    if stream.pictures is None:
        rows: Table | Images = Table(dict(stream.columns))
    else:
        count, high, wide = stream.pictures.shape
        at = np.arange(count, dtype=np.int64) * high * wide
        rows = Images(
            Messages(stream.pictures.reshape(-1), at, at + high * wide),
            ("raw",) * count,
            np.full(count, wide, np.int32),
            np.full(count, high, np.int32),
            np.full(count, wide, np.int32),
            ("mono8",) * count,
        )
    return Block(name, ns(stream.t_s), rows, header_ns=header_ns)


def examined(streams: Streams, vehicle: Vehicle = CAR) -> QualityDrive:
    return examine_drive([log_of(streams)], vehicle, EVERYTHING)
