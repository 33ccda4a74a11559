"""Counts of cues at the frames of a run."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from crosscue.fusion.fit.annotated_approach import NOT_LOOKED
from crosscue.replay.columns import Int64s

if TYPE_CHECKING:
    import pyarrow as pa


def counts_at(table: pa.Table, t_ns: Int64s) -> dict[str, Int64s]:
    """From each cue of a table ``cues`` to how many at sorted times, or ``NOT_LOOKED``."""
    at, count = np.asarray(table["t_ns"], np.int64), np.asarray(table["count"], np.int64)
    cue = np.array(table["cue"].to_pylist(), np.str_)
    out: dict[str, Int64s] = {}
    for name in np.unique(cue).tolist():
        column = np.full(len(t_ns), NOT_LOOKED, np.int64)
        where, found = places_in(t_ns, at[cue == name])
        column[where] = count[cue == name][found]
        out[name] = column
    return out


def places_in(
    t_ns: Int64s, at: Int64s
) -> tuple[np.typing.NDArray[np.intp], np.typing.NDArray[np.bool_]]:
    """Where in the sorted ``t_ns`` the times of ``at`` stand, and which of them do."""
    where = np.searchsorted(t_ns, at)
    found = np.zeros(len(at), np.bool_)
    inside = where < len(t_ns)
    found[inside] = t_ns[where[inside]] == at[inside]
    return where[found], found
