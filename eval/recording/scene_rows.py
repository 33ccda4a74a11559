"""Cues, ranges and beliefs of a run for a recording; missing tables are None."""

from dataclasses import dataclass

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from crosscue.eval.runs.tables.parquet import TableFolder


@dataclass(frozen=True, slots=True, eq=False)
class SceneRows:
    """The run's tables, sorted by time; None where the run has none.

    Attributes:
        frames_ns: Unique times of frames; empty for a run without camera.
        gaps_ns: Times just after the last frame before each gap of the drive.
        cues: Rows of ``cues.parquet``.
        ranges: Rows of ``range.parquet``.
        belief: Rows of ``belief.parquet``.
    """

    frames_ns: NDArray[np.int64]
    gaps_ns: NDArray[np.int64]
    cues: pa.Table | None
    ranges: pa.Table | None
    belief: pa.Table | None


def scene_rows(run: TableFolder) -> SceneRows:
    """Read a run's cues, ranges and beliefs.

    Raises:
        RunError: A table is damaged.
    """
    frames = _table(run, "frames")
    times, gaps_ns = np.empty(0, np.int64), np.empty(0, np.int64)
    if frames is not None:
        times, first = np.unique(frames["t_ns"].to_numpy(), return_index=True)
        segment = frames["segment"].to_numpy()[first]
        gaps_ns = times[:-1][segment[1:] != segment[:-1]] + 1
    return SceneRows(
        times, gaps_ns, _table(run, "cues"), _table(run, "range"), _table(run, "belief")
    )


def longest_m(scene: SceneRows) -> float:
    """Return the largest range with its 2-sigma band, in multiples of 10 m; 100 m without any."""
    if scene.ranges is None:
        return 100.0
    range_m = scene.ranges["range_m"].to_numpy()
    highest = range_m + 2.0 * np.sqrt(scene.ranges["var_m2"].to_numpy())
    return 10.0 * float(np.ceil(0.1 * np.nanmax(highest)))


def _table(run: TableFolder, name: str) -> pa.Table | None:
    table = run.filled(name)
    return None if table is None else table.sort_by("t_ns")
