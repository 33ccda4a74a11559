"""How far the car went between two times, from the odometry a run has stored.

A run keeps the odometry its pose filter was given (``measurements.parquet``); estimators that work
at camera rate take their increments from there, so they never read the log again.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np

from crosscue.eval.runs.folder import RunFolder
from crosscue.replay.columns import Floats, Int64s

from . import measurements

COLUMNS: Final = ("start_ns", "t_ns", "distance_m", "turn_rad", "distance_var_m2")


class Way(NamedTuple):
    """What the odometry says of a stretch of time.

    Attributes:
        distance_m: Signed: forwards is positive.
        var_m2: Its variance.
        turn_rad: Counter-clockwise.
        covered_ns: How much of the stretch odometry covers.
    """

    distance_m: float
    var_m2: float
    turn_rad: float
    covered_ns: int


@dataclass(slots=True)
class Odometer:
    """Reads a run's odometry once, forwards in time; memory holds one batch.

    Attributes:
        parts: Batches of columns in ``COLUMNS``' order, by time.
        at_ns: How far it has been read.
    """

    parts: Iterator[tuple[Int64s, Int64s, Floats, Floats, Floats]]
    at_ns: int | None = None
    _rows: list[tuple[int, int, float, float, float]] = field(default_factory=list)
    _next: int = 0

    def until(self, t_ns: int) -> Way:
        """The way since the last call; the first call's begins with the odometry itself.

        A time before the last call's moves nothing and gives nothing.
        """
        if self.at_ns is not None and t_ns <= self.at_ns:
            return Way(0.0, 0.0, 0.0, 0)
        begin = self.at_ns
        distance = var = turn = 0.0
        covered = 0
        while (row := self._peek()) is not None:
            start, stop, metres, radians, variance = row
            first = start if begin is None else max(start, begin)
            last = min(stop, t_ns)
            if last > first:
                share = (last - first) / (stop - start)
                distance += share * metres
                turn += share * radians
                var += share * variance
                covered += last - first
            if stop > t_ns:
                break
            self._next += 1
        self.at_ns = t_ns
        return Way(distance, var, turn, covered)

    def skip_to(self, t_ns: int) -> None:
        """Leave out all odometry before ``t_ns``."""
        self.until(t_ns)

    def _peek(self) -> tuple[int, int, float, float, float] | None:
        while self._next == len(self._rows):
            part = next(self.parts, None)
            if part is None:
                return None
            self._rows = list(zip(*(column.tolist() for column in part), strict=True))
            self._next = 0
        return self._rows[self._next]


def odometer_of(run: RunFolder) -> Odometer:
    """The odometry of a run.

    Raises:
        RunError: The table is missing or damaged.
    """
    return Odometer(_parts(run))


def _parts(run: RunFolder) -> Iterator[tuple[Int64s, Int64s, Floats, Floats, Floats]]:
    import pyarrow.compute as pc

    for batch in run.batches(measurements.TABLE, ["kind", *COLUMNS]):
        kind = batch["kind"].cast("string")
        part = batch.filter(pc.equal(kind, "odometry"))
        if part.num_rows:
            start, stop, metres, radians, variance = (
                part[name].to_numpy(zero_copy_only=False) for name in COLUMNS
            )
            moves = stop > start
            yield (
                start[moves].astype(np.int64),
                stop[moves].astype(np.int64),
                metres[moves],
                radians[moves],
                variance[moves],
            )
