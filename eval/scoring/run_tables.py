"""Read the tables of a run that are scored, from a run folder or from tables in memory."""

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TypeVar

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from crosscue.eval.runs.tables.columns import LOG_TIME
from crosscue.eval.runs.tables.log_time import table_in_log_time
from crosscue.replay.columns import Floats, Int64s
from crosscue.replay.errors import UnreadableRunError, UsageError
from crosscue.replay.time.segments import Timeline
from crosscue.replay.vehicle.fusion import NOT_FEATURES

from .columns import NONE, BeliefRows, CueRows, RangeRows, RunTables

T = TypeVar("T")


def in_log_time(where: str, tables: Mapping[str, pa.Table], timeline: Timeline) -> RunTables:
    """Return tables of a run in log time, with counts of the rows that this leaves out.

    Raises:
        RunError: A column is missing, or has impossible values.
    """
    kept = {name: table_in_log_time(table, timeline) for name, table in tables.items()}
    counts = {
        what: rows - _rows_by_kind(kept[name], name).get(what, 0)
        for name, table in tables.items()
        for what, rows in _rows_by_kind(table, name).items()
    }
    return replace(
        run_tables(where, kept), ambiguous={what: gone for what, gone in counts.items() if gone}
    )


def _rows_by_kind(table: pa.Table, name: str) -> Mapping[str, int]:
    """Return numbers of separately judged rows: ranges by reference; cues are judged by frame."""
    if name == "cues":
        return {}
    if name == "range":
        return Counter(table["reference"].to_pylist()) if "reference" in table.column_names else {}
    return {name: table.num_rows}


def run_tables(where: str, tables: Mapping[str, pa.Table]) -> RunTables:
    """Check tables in memory and return their columns.

    Args:
        where: Name of the run in errors.
        tables: Tables ``frames``, ``cues``, ``range`` and ``belief``, as in a run; any may be
            missing.

    Raises:
        UsageError: Another table is given.
        RunError: A column is missing, or has impossible values.
    """
    if others := sorted(tables.keys() - {"frames", "cues", "range", "belief"}):
        raise UsageError(f"tables: {', '.join(others)}; expected frames, cues, range or belief")

    def read(name: str, of: Callable[[pa.Table, str], T]) -> T | None:
        return of(tables[name], f"{where}: {name}") if name in tables else None

    return RunTables(
        read("frames", _frames),
        read("cues", _cues),
        read("range", _ranges),
        read("belief", _belief),
    )


def _frames(table: pa.Table, where: str) -> Int64s:
    return np.unique(_whole(table, "t_ns", where))


def _cues(table: pa.Table, where: str) -> CueRows:
    count = _whole(table, "count", where)
    if len(count) and count.min() < 0:
        raise UnreadableRunError(
            f"{where}: count {count.min()}: expected 0 or more; run crosscue replay again"
        )
    return CueRows(
        _whole(table, "t_ns", where), _approach(table, where), _texts(table, "cue", where), count
    )


def _ranges(table: pa.Table, where: str) -> RangeRows:
    reference = _texts(table, "reference", where)
    strange = sorted(set(reference.tolist()) - {"start", "end"})
    if strange:
        raise UnreadableRunError(
            f"{where}: reference {strange[0]!r}: expected start or end; replay again"
        )
    return RangeRows(
        _whole(table, "t_ns", where),
        _approach(table, where),
        reference,
        _numbers(table, "range_m", where),
        _numbers(table, "var_m2", where),
    )


def _belief(table: pa.Table, where: str) -> BeliefRows:
    features: dict[str, Floats] = {}
    for name in table.column_names:
        if name in (*NOT_FEATURES, *LOG_TIME):
            continue
        values = _numbers(table, name, where)
        # NaN compares false here; it is left out and counted later.
        if ((values < 0.0) | (values > 1.0)).any():
            raise UnreadableRunError(f"{where}: {name}: a probability outside 0 to 1; replay again")
        features[name] = values
    established = np.zeros(table.num_rows, np.bool_)
    if "established" in table.column_names:
        reported = table["established"].fill_null(False)
        established = reported.to_numpy(zero_copy_only=False).astype(np.bool_)
    return BeliefRows(_whole(table, "t_ns", where), _approach(table, where), features, established)


def _column(table: pa.Table, name: str, where: str) -> pa.ChunkedArray:
    if name not in table.column_names:
        there = ", ".join(table.column_names)
        raise UnreadableRunError(
            f"{where}: no column {name}; there are: {there}; another version wrote it"
        )
    return table[name]


def _whole(table: pa.Table, name: str, where: str) -> Int64s:
    column = _column(table, name, where)
    if column.null_count or not pa.types.is_integer(column.type):
        raise UnreadableRunError(f"{where}: {name}: expected integers in every row; replay again")
    return np.asarray(column.cast(pa.int64()).to_numpy(), np.int64)


def _approach(table: pa.Table, where: str) -> Int64s:
    import pyarrow.compute as pc

    column = _column(table, "approach", where)
    if not (pa.types.is_integer(column.type) or pa.types.is_null(column.type)):
        raise UnreadableRunError(f"{where}: approach: expected integers or nulls; replay again")
    filled = pc.fill_null(column.cast(pa.int64()), NONE)
    return np.asarray(filled.to_numpy(), np.int64)


def _numbers(table: pa.Table, name: str, where: str) -> Floats:
    column = _column(table, name, where)
    if not (pa.types.is_floating(column.type) or pa.types.is_integer(column.type)):
        raise UnreadableRunError(
            f"{where}: {name}: expected numbers, got {column.type}; replay again"
        )
    return np.asarray(column.cast(pa.float64()).to_numpy(), np.float64)


def _texts(table: pa.Table, name: str, where: str) -> NDArray[np.str_]:
    column = _column(table, name, where)
    values = column.to_pylist()
    if not all(isinstance(value, str) for value in values):
        raise UnreadableRunError(f"{where}: {name}: expected text in every row; replay again")
    return np.array(values, np.str_)
