"""Simulated streams with known clocks, for comparison with clock reports."""

from dataclasses import dataclass, field

import numpy as np

from crosscue.replay.clocks.reports import ClockReport, ClockWatch
from crosscue.replay.columns import Block, Int64s, Table

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
