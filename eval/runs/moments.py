"""Moments of a run as users write them, and views of a run limited to a time span."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from crosscue.replay.errors import UnreadableRunError, UsageError

from .folder import RunFolder
from .tables.parquet import TableFolder

if TYPE_CHECKING:
    import pyarrow as pa

# Tables that define a run's time span; the first that has rows is used.
TABLES: Final = ("frames", "pose")


def span_ns(run: TableFolder) -> tuple[int, int]:
    """Return the first and last time of the run's frames, or of its poses without a camera.

    Raises:
        RunError: The run has neither.
    """
    import pyarrow.compute as pc

    for name in TABLES:
        table = run.filled(name, ["t_ns"])
        if table is not None:
            ends = pc.min_max(table["t_ns"]).as_py()
            return int(ends["min"]), int(ends["max"])
    raise UnreadableRunError(f"{run.path}: neither a frame nor a pose in it; replay again")


def frame_times(run: TableFolder) -> dict[int, int]:
    """Return the time of each frame in the run's tables by its log time, which scores use.

    Raises:
        RunError: The table of frames is damaged.
    """
    is_there = run.file("frames.parquet").exists()
    if not is_there or "log_t_ns" not in run.schema("frames").names:
        return {}
    table = run.table("frames", ["t_ns", "log_t_ns"])
    return dict(zip(table["log_t_ns"].to_pylist(), table["t_ns"].to_pylist(), strict=True))


def moment_ns(run: TableFolder, text: str) -> int:
    """Parse a moment: ``12.3`` (seconds from the first frame) or ``17...ns``.

    Raises:
        UsageError: The text has neither form, or the moment is outside the run.
    """
    first, last = span_ns(run)
    if re.fullmatch(r"[0-9]{1,19}ns", text):
        t_ns = int(text[:-2])
    else:
        try:
            seconds = float(text)
        except ValueError:
            seconds = math.nan
        if not abs(seconds) < 1e9:
            raise UsageError(
                f"--at {text}: expected seconds from the first frame (12.3) or time (17...ns)"
            )
        t_ns = first + round(seconds * 1e9)
    if not first <= t_ns <= last:
        raise UsageError(
            f"--at {text}: outside {run.path}, which lasts from 0 to {(last - first) * 1e-9:.3f} s "
            f"({first}ns to {last}ns)"
        )
    return t_ns


def approach_spans(run: TableFolder) -> dict[int, tuple[int, int]]:
    """Return the first and last time of each approach of a run, by its number.

    Raises:
        RunError: The table is damaged.
    """
    import pyarrow.compute as pc

    table = run.filled("belief", ["t_ns", "approach"])
    if table is None:
        return {}
    known = table.filter(pc.is_valid(table["approach"])).group_by("approach")
    rows = known.aggregate([("t_ns", "min"), ("t_ns", "max")]).sort_by("approach").to_pylist()
    return {row["approach"]: (row["t_ns_min"], row["t_ns_max"]) for row in rows}


def seconds_into(first_ns: int, t_ns: int) -> float:
    """Return a moment in the seconds of ``--at``: whole milliseconds, never beyond the moment."""
    return (t_ns - first_ns) // 1_000_000 / 1000


@dataclass(frozen=True, slots=True)
class PartOfRun(RunFolder):
    """A run whose tables contain only the rows of a time span.

    Attributes:
        start_ns: First moment.
        end_ns: Last moment.
    """

    start_ns: int = 0
    end_ns: int = 2**63 - 1

    def table(self, name: str, columns: list[str] | None = None) -> pa.Table:
        """Return the rows of ``NAME.parquet`` in the time span."""
        whole = RunFolder.table(self, name, _with_time(columns))
        inside = whole.filter(self._is_inside(whole)) if "t_ns" in whole.column_names else whole
        return inside if columns is None else inside.select(columns)

    def batches(
        self, name: str, columns: list[str] | None = None, rows: int = 16_384
    ) -> Iterator[pa.RecordBatch]:
        """Yield the rows of ``NAME.parquet`` in the time span, a batch at a time."""
        for batch in RunFolder.batches(self, name, _with_time(columns), rows):
            inside = batch.filter(self._is_inside(batch)) if "t_ns" in batch.schema.names else batch
            yield inside if columns is None else inside.select(columns)

    def _is_inside(self, rows: pa.Table | pa.RecordBatch) -> pa.Array:
        import pyarrow.compute as pc

        times = rows["t_ns"]
        return pc.and_(pc.greater_equal(times, self.start_ns), pc.less_equal(times, self.end_ns))


def _with_time(columns: list[str] | None) -> list[str] | None:
    """Return the columns with ``t_ns``, which is needed to select the rows."""
    return columns if columns is None else list(dict.fromkeys([*columns, "t_ns"]))


def run_between(run: RunFolder, start_ns: int, end_ns: int) -> RunFolder:
    """Return a view of the run from one moment to another, both included."""
    return PartOfRun(run.path, run.logs, run.without_images, run.limits, run.home, start_ns, end_ns)
