"""Moments of a run as people write them: seconds from its first frame, or nanoseconds."""

from __future__ import annotations

import math
import re
from typing import Final

from crosscue.replay.base import UnreadableRunError, UsageError

from .tables.parquet import TableFolder

TABLES: Final = ("frames", "pose")
"""The first that has rows begins the run."""


def span_ns(run: TableFolder) -> tuple[int, int]:
    """First and last time of the run's frames; of its poses where it has no camera.

    Raises:
        RunError: It has neither.
    """
    import pyarrow.compute as pc

    for name in TABLES:
        if run.file(f"{name}.parquet").exists():
            times = run.table(name, ["t_ns"])["t_ns"]
            if len(times):
                return int(pc.min(times).as_py()), int(pc.max(times).as_py())
    raise UnreadableRunError(f"{run.path}: neither a frame nor a pose in it; replay again")


def moment_ns(run: TableFolder, text: str) -> int:
    """The moment that ``12.3`` (seconds from the first frame) or ``17...ns`` means.

    Raises:
        UsageError: It is neither, or lies outside the run.
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


def seconds_into(first_ns: int, t_ns: int) -> float:
    """A moment as it is written behind ``--at``, to a millisecond."""
    return round((t_ns - first_ns) * 1e-9, 3)
