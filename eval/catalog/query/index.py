"""The rows of every run below a folder, read from the runs or from the index of an earlier time."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

from .columns import INDEXED, arrow_schema
from .find import CUT_SHORT, Found, Stamp, find_runs
from .records import RunRows, rows_of

if TYPE_CHECKING:
    import pyarrow as pa

MAX_BYTES: Final = 256 << 20


@dataclass(frozen=True, slots=True, eq=False)
class Index:
    """What the catalog of a folder holds.

    Attributes:
        tables: By name, as ``columns.INDEXED`` lists them.
        left_out: By run, why it is not in the tables.
        files: By run, its Parquet files, from its folder.
    """

    tables: Mapping[str, pa.Table]
    left_out: Mapping[str, str]
    files: Mapping[str, tuple[str, ...]]


def open_index(folder: str) -> Index:
    """Look at every run below a folder.

    Raises:
        UnreadableRunError: A folder cannot be listed.
    """
    rows: list[RunRows] = []
    left_out: dict[str, str] = {}
    for found in find_runs(folder):
        if found.stamp == CUT_SHORT:
            left_out[found.run] = "no manifest.json: cut short, or still being made; replay again"
            continue
        try:
            one = _read(folder, found)
        except (OSError, ValueError) as error:
            left_out[found.run] = _why(error)
        else:
            rows += [] if one is None else [one]
    return _indexed(rows, left_out)


def _read(folder: str, found: Found) -> RunRows | None:
    path = Path(folder, found.run)
    manifest = path / "manifest.json"
    if found.stamp[1] > MAX_BYTES:
        raise ValueError(f"manifest.json: over {MAX_BYTES >> 20} MiB; replay again")
    files = [
        *(entry.name for entry in os.scandir(path) if entry.name.endswith(".parquet")),
        *(f"score/{entry.name}" for entry in _listed(path / "score")),
    ]
    name = path.name or path.resolve().name
    return rows_of(
        found.run, name, manifest.read_bytes(), found.stamp[0], sorted(files), {}, lambda: []
    )


def _listed(folder: Path) -> list[Path]:
    return sorted(folder.glob("*.parquet"))


def _why(error: Exception) -> str:
    if isinstance(error, FileNotFoundError):
        return "gone while it was read; open the catalog again"
    return str(error.strerror or error) if isinstance(error, OSError) else str(error)


def _indexed(rows: list[RunRows], left_out: Mapping[str, str]) -> Index:
    import pyarrow as pa

    content = {
        "runs": [one.run for one in rows],
        "approaches": [row for one in rows for row in one.approaches],
        "dropped": [row for one in rows for row in one.dropped],
        "left_out": [{"run": run, "reason": why} for run, why in left_out.items()],
    }
    tables = {
        name: pa.Table.from_pylist(content[name], arrow_schema(columns))
        for name, columns in INDEXED.items()
    }
    files = {one.run["run"]: tuple(one.run["tables"]) for one in rows}
    return Index(tables, left_out, files)


__all__ = ["Index", "Stamp", "open_index"]
