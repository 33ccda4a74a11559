"""Convert readings of simulated sensors to rows of a log, with the delays of a recorder."""

from __future__ import annotations

from typing import Final

import numpy as np

from crosscue.replay.can.database import CanDatabase
from crosscue.replay.can.encode import encode
from crosscue.replay.columns import DATA, Block, CanFrames, Floats, Int64s, Table, Topic

from .drive import Sensed, dbc_path

BUS: Final = Topic("/can", "crosscue/CanFrames", "columns")
GYRO: Final = Topic("/imu", "sensor_msgs/msg/Imu", "columns")
MAGNETOMETER: Final = Topic("/compass", "sensor_msgs/msg/MagneticField", "columns")
BATCH_ROWS: Final = 1000


def sensor_blocks(sensed: Sensed, seed: int) -> list[Block]:
    """Return readings as rows of a log, in batches, in order of the batches' first rows."""
    rng = np.random.default_rng([seed, 3])
    blocks = [
        *_batches(_can_block(sensed, rng)),
        *_batches(_stamped(GYRO.name, sensed.gyro_t_ns, "gyro_{}_radps", sensed.gyro_radps, rng)),
        *_batches(_stamped(MAGNETOMETER.name, sensed.mag_t_ns, "mag_{}_t", sensed.mag_t, rng)),
    ]
    return sorted(blocks, key=lambda block: int(block.log_ns[0]))


def _batches(block: Block) -> list[Block]:
    return [
        block.take(slice(start, start + BATCH_ROWS)) for start in range(0, len(block), BATCH_ROWS)
    ]


def _late(t_ns: Int64s, rng: np.random.Generator, min_ms: float, mean_ms: float) -> Int64s:
    """Return the times at which the recorder stores measurements of ``t_ns``; order is kept."""
    delay = min_ms + rng.exponential(mean_ms, len(t_ns))
    late: Int64s = np.maximum.accumulate(t_ns + np.rint(delay * 1e6).astype(np.int64))
    return late


def _stamped(topic: str, t_ns: Int64s, column: str, xyz: Floats, rng: np.random.Generator) -> Block:
    columns = {column.format(axis): xyz[:, i] for i, axis in enumerate("xyz")}
    return Block(topic, _late(t_ns, rng, 2.0, 0.7), Table(columns), header_ns=t_ns)


def _can_block(sensed: Sensed, rng: np.random.Generator) -> Block:
    database = CanDatabase.load([dbc_path()])
    n = len(sensed.wheel_t_ns)
    kmh = np.round(sensed.wheels_mps * 3.6, 2)
    names = ("FRONT_LEFT", "FRONT_RIGHT", "REAR_LEFT", "REAR_RIGHT")
    wheels = encode(database.named("WHEEL_SPEEDS"), dict(zip(names, kmh.T, strict=True)))
    steering = encode(
        database.named("STEERING"),
        {
            "WHEEL_ANGLE": np.round(np.rad2deg(sensed.steering_rad), 1),
            "COUNTER": np.arange(n) % 16,
        },
    )
    payload = np.zeros((2 * n, 8), np.uint8)
    payload[0::2, : wheels.shape[1]] = wheels
    payload[1::2, : steering.shape[1]] = steering
    frames = CanFrames(
        np.tile(np.array([176, 192], np.uint32), n),
        np.zeros(2 * n, np.bool_),
        np.full(2 * n, DATA, np.uint8),
        np.tile(np.array([wheels.shape[1], steering.shape[1]], np.uint8), n),
        payload,
        np.zeros(2 * n, np.bool_),
    )
    sent = np.repeat(sensed.wheel_t_ns, 2) + np.tile(np.array([0, 250_000]), n)
    return Block(BUS.name, _late(sent, rng, 0.3, 0.1), frames)
