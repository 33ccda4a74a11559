"""A log in memory, for tests of code that uses readers."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np

from crosscue.replay.base import EVERYTHING, Selection
from crosscue.replay.columns import Block, Floats, Table, Topic
from crosscue.replay.ledger import NOT_ASKED_TOPIC, Ledger

WHEELS = Topic("wheels", "crosscue/WheelSpeeds", "columns")
GYRO = Topic("gyro", "sensor_msgs/msg/Imu", "columns")
MAGNETOMETER = Topic("mag", "sensor_msgs/msg/MagneticField", "columns")


@dataclass(frozen=True, slots=True, eq=False)
class MemoryLog:
    """A log that yields given blocks in their order."""

    topics: tuple[Topic, ...]
    blocks: Sequence[Block]
    path: Path = Path("memory")
    format: str = "memory"

    def read(self, ledger: Ledger, selection: Selection = EVERYTHING) -> Iterator[Block]:
        """Yield all blocks of the selected topics."""
        for block in self.blocks:
            ledger.find(block.topic, len(block))
            if selection.wants(block.topic):
                yield block
            else:
                ledger.skip(block.topic, NOT_ASKED_TOPIC, len(block))

    def close(self) -> None:
        """Nothing to release."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


def wheel_block(t_ns: Sequence[int], speed_mps: Sequence[float]) -> Block:
    """Wheel speeds with four equal wheels."""
    speed = np.asarray(speed_mps, np.float64)
    names = ("front_left_mps", "front_right_mps", "rear_left_mps", "rear_right_mps")
    return Block("wheels", np.asarray(t_ns, np.int64), Table(dict.fromkeys(names, speed)))


def driven_blocks(seconds: int, speed_mps: float, yaw_rate_radps: float = 0.0) -> list[Block]:
    """Ten rows of a gyro and ten of wheel speeds for each second."""
    blocks: list[Block] = []
    for second in range(seconds):
        t_ns = [second * 1_000_000_000 + i * 100_000_000 for i in range(10)]
        blocks += [gyro_block(t_ns, [yaw_rate_radps] * 10), wheel_block(t_ns, [speed_mps] * 10)]
    return blocks


def gyro_block(t_ns: Sequence[int], yaw_rate_radps: Sequence[float]) -> Block:
    column: Floats = np.asarray(yaw_rate_radps, np.float64)
    return Block("gyro", np.asarray(t_ns, np.int64), Table({"gyro_z_radps": column}))
