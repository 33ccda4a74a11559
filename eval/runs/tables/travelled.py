"""Distance travelled between two times, from the odometry stored in a run.

A run stores the odometry of its pose filter (``measurements.parquet``). Estimators that work at
camera rate read their increments from there, so they never read the log again. Motion across a
short gap is assumed from the last speed, and is reported as assumed.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
import pyarrow as pa

from crosscue.fusion.intersection_range import range_noise_m2

from .parquet import TableFolder, arrow_column, numbers_of

COLUMNS: Final = ("start_ns", "t_ns", "distance_m", "turn_rad", "distance_var_m2")


class Way(NamedTuple):
    """Motion over a span of time.

    Attributes:
        distance_m: Signed distance, positive forward.
        var_m2: Variance of the distance: what a range gains over it (``range_noise_m2``).
        turn_rad: Change of heading, counter-clockwise.
        covered_ns: Time covered by odometry or by assumed motion.
        assumed_ns: Part of that time for which the motion was assumed.
        assumed_m: Assumed part of the distance, unsigned.
    """

    distance_m: float
    var_m2: float
    turn_rad: float
    covered_ns: int
    assumed_ns: int = 0
    assumed_m: float = 0.0


class OdometryRow(NamedTuple):
    """Motion between two times."""

    start_ns: int
    stop_ns: int
    distance_m: float
    turn_rad: float
    var_m2: float
    is_gap: bool


@dataclass(slots=True)
class Odometer:
    """Forward reader of a run's odometry; memory holds one batch.

    Attributes:
        rows: The odometry, sorted by time.
        at_ns: Time up to which the odometry has been read.
    """

    rows: Iterator[OdometryRow]
    at_ns: int | None = None
    _row: OdometryRow | None = None

    def until(self, t_ns: int) -> Way:
        """Return the motion since the last call, or since the start of the odometry.

        A time before that of the last call has no effect and returns no motion.
        """
        if self.at_ns is not None and t_ns <= self.at_ns:
            return Way(0.0, 0.0, 0.0, 0)
        begin = self.at_ns
        distance = var = turn = assumed_m = 0.0
        covered = assumed = 0
        while (row := self._peek()) is not None:
            first = row.start_ns if begin is None else max(row.start_ns, begin)
            last = min(row.stop_ns, t_ns)
            if last > first:
                fraction = (last - first) / (row.stop_ns - row.start_ns)
                distance += fraction * row.distance_m
                turn += fraction * row.turn_rad
                var += fraction * row.var_m2
                covered += last - first
                assumed += (last - first) * row.is_gap
                assumed_m += abs(fraction * row.distance_m) * row.is_gap
            if row.stop_ns > t_ns:
                break
            self._row = None
        self.at_ns = t_ns
        var = range_noise_m2(distance, var, covered * 1e-9)
        return Way(distance, var, turn, covered, assumed, assumed_m)

    def skip_to(self, t_ns: int) -> None:
        """Skip all odometry before ``t_ns``, and the complete gap if ``t_ns`` is in one."""
        self.until(t_ns)
        row = self._peek()
        if row is not None and row.is_gap and row.start_ns < t_ns:
            self._row = None

    def _peek(self) -> OdometryRow | None:
        if self._row is None:
            self._row = next(self.rows, None)
        return self._row


def odometer_of(run: TableFolder) -> Odometer:
    """Open the odometry of a run.

    Raises:
        RunError: The table is missing or damaged.
    """
    return Odometer(_rows(run))


def _rows(run: TableFolder) -> Iterator[OdometryRow]:
    import pyarrow.compute as pc

    kinds, gap = (arrow_column(some, pa.string()) for some in (("odometry", "gap"), ("gap",)))
    for batch in run.batches("measurements", ["kind", *COLUMNS]):
        kind = batch["kind"].cast("string")
        is_way = pc.is_in(kind, kinds)
        part = batch.filter(is_way)
        if part.num_rows:
            start, stop, *numbers = (numbers_of(part[name]) for name in COLUMNS)
            is_gap = numbers_of(pc.is_in(kind.filter(is_way), gap).cast("uint8")).astype(np.bool_)
            columns = (start.astype(np.int64), stop.astype(np.int64), *numbers, is_gap)
            moves = stop > start
            yield from map(
                OdometryRow._make, zip(*(c[moves].tolist() for c in columns), strict=True)
            )
