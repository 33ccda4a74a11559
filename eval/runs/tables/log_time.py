"""Conversion of a run's tables to the time of its logs, which truth uses, for scoring.

A drive whose clock was never set back has a single time, and nothing changes. After a set-back,
some moments of the log's clock occur twice. It is unknown which of the two a truth means, so the
rows of both are left out and counted.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from crosscue.replay.columns import Int64s
from crosscue.replay.time.segments import Cause, Timeline


@dataclass(frozen=True, slots=True)
class ClockGap:
    """A span of the log's clock without measurements, or one that occurs twice.

    Attributes:
        start_ns: Log time of the last wheel speeds before a gap, or the start of a repeated span.
        end_ns: Log time of the first wheel speeds after a gap, or the end of a repeated span.
        text: Description with its length.
    """

    start_ns: int
    end_ns: int
    text: str

    @property
    def middle_ns(self) -> int:
        """Middle of the span."""
        return (self.start_ns + self.end_ns) // 2


def gaps_of(timeline: Timeline) -> tuple[ClockGap, ...]:
    """Return the gaps of a drive on its log's clock, in order, for charts over time."""
    ordered = sorted(timeline.segments, key=lambda one: one.log_start_ns)
    found = []
    for one, other in pairwise(ordered):
        start_ns, end_ns = sorted((one.log_end_ns, other.log_start_ns))
        is_silence = other.cause is Cause.SILENCE and other.number == one.number + 1
        what = f"gap of {(end_ns - start_ns) * 1e-9:.1f} s" if is_silence else Cause.SET_BACK.value
        found.append(ClockGap(start_ns, end_ns, what))
    return tuple(found)


def broken_at(gaps: Sequence[ClockGap], t_ns: Int64s) -> Int64s:
    """Return the sorted indices of the rows before which a line is interrupted, shape (K,)."""
    rows = np.searchsorted(t_ns, [one.middle_ns for one in gaps]).astype(np.int64)
    return np.unique(rows[(rows > 0) & (rows < len(t_ns))])


def ambiguous(timeline: Timeline, log_ns: Int64s, numbers: Int64s) -> NDArray[np.bool_]:
    """Return a mask of the rows whose log time also occurs in another segment, shape (N,)."""
    found = np.zeros(len(log_ns), np.bool_)
    for one in timeline.segments:
        inside = (log_ns >= one.log_start_ns) & (log_ns <= one.log_end_ns)
        found |= inside & (numbers != one.number)
    return found


def table_in_log_time(table: pa.Table, timeline: Timeline) -> pa.Table:
    """Return a run's table with recorded ``t_ns``, sorted, without rows whose time occurs twice."""
    if not timeline.was_set_back or not table.num_rows:
        return table
    log_ns = table["log_t_ns"].to_numpy()
    keep = ~ambiguous(timeline, log_ns, table["segment"].to_numpy().astype(np.int64))
    moved = table.set_column(table.schema.get_field_index("t_ns"), "t_ns", pa.array(log_ns))
    return moved.filter(pa.array(keep)).sort_by("t_ns")


def comes_twice(timeline: Timeline, log_ns: Int64s) -> NDArray[np.bool_]:
    """Return a mask of the log times that are in more than one segment, shape (N,)."""
    inside = np.zeros(len(log_ns), np.int64)
    for one in timeline.segments if timeline.was_set_back else ():
        inside += (log_ns >= one.log_start_ns) & (log_ns <= one.log_end_ns)
    return np.asarray(inside > 1)
