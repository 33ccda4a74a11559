"""Logs in memory, and streams of rows with clocks."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Self

import numpy as np

from crosscue.replay.base import EVERYTHING, Selection
from crosscue.replay.clocks.reports import ClockReport, ClockWatch
from crosscue.replay.columns import Block, Floats, Int64s, Table, Topic
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


SECOND_NS = 1_000_000_000
START_NS = 1_763_000_000 * SECOND_NS


@dataclass(frozen=True, slots=True)
class Stream:
    """A simulated topic; row ``i`` is measured at ``START_NS + i * period_ns``.

    Attributes:
        rows: Number of rows.
        period_ns: Time between rows.
        offset_ns: Header clock minus log clock at the first row.
        drift_ppm: Drift of the header clock relative to the log clock.
        wait_ns: Mean of the exponential delay between stamp and storage.
        jumps: Jumps of the header clock, by row.
        seed: Seed of the delays.
    """

    rows: int = 1200
    period_ns: int = 50_000_000
    offset_ns: int = 0
    drift_ppm: float = 0.0
    wait_ns: int = 0
    jumps: dict[int, int] = field(default_factory=dict)
    seed: int = 7

    def measured_ns(self) -> Int64s:
        """True times on the log clock."""
        return START_NS + self.period_ns * np.arange(self.rows, dtype=np.int64)

    def log_ns(self) -> Int64s:
        """Log times: measured times plus delays, in the order of a queue."""
        wait = np.random.default_rng(self.seed).exponential(1.0, self.rows) * self.wait_ns
        return np.maximum.accumulate(self.measured_ns() + wait.astype(np.int64))

    def header_ns(self) -> Int64s:
        """Header stamps: the measured times on the sensor's clock."""
        since = self.measured_ns() - START_NS
        ahead = np.rint(since * (self.drift_ppm * 1e-6)).astype(np.int64)
        for row, by_ns in self.jumps.items():
            ahead[row:] += by_ns
        stamps: Int64s = self.measured_ns() + self.offset_ns + ahead
        return stamps


def table_of(
    topic: str, log_ns: Int64s, header_ns: Int64s | None = None, publish_ns: Int64s | None = None
) -> Block:
    """A block with times and one column of zeros."""
    return Block(topic, log_ns, Table({"zero": np.zeros(len(log_ns))}), publish_ns, header_ns)


def watch(block: Block, rows_per_block: int = 700) -> ClockReport:
    """Return the clock report on one topic, read in several blocks."""
    seen = ClockWatch()
    for start in range(0, max(len(block), 1), rows_per_block):
        seen.see(block.take(slice(start, start + rows_per_block)))
    return seen.reports()[block.topic]


def watch_stream(stream: Stream, rows_per_block: int = 700) -> ClockReport:
    return watch(table_of("/s", stream.log_ns(), stream.header_ns()), rows_per_block)
