"""The record of one failure of a run, and tables of failures."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Final, Literal, get_args

import pyarrow as pa

from crosscue.eval.runs.tables.columns import INT, REAL, TEXT, TEXTS, Column, arrow_schema
from crosscue.replay.errors import AnnotationError
from crosscue.replay.files import door
from crosscue.replay.files.tree_text import json_tree, spelled, strict_json, unspelled
from crosscue.replay.files.whole_file import write_table, write_text

Kind = Literal["missed", "late", "false", "range", "flipped", "suspect"]
Level = Literal["approach", "frames"]
KINDS: Final[tuple[Kind, ...]] = get_args(Kind)
FORMAT: Final = 1
# Frames of one subject that are closer in time than this are one failure.
APART_NS: Final = 2_000_000_000
# Max size of a table in JSON.
MAX_BYTES: Final = 256 << 20
# Bin edges of the distances by which failures are filtered.
DISTANCES_M: Final = (0, 10, 20, 40, 80)


@dataclass(frozen=True, slots=True, kw_only=True)
class Failure:
    """One failure.

    Attributes:
        run: Folder of the run.
        kind: Kind of failure.
        level: Level: a complete approach, or consecutive frames of one cue or range.
        what: The feature, cue or range concerned: ``left``, ``stop_sign``, ``range to end``.
        cause: Cause in a few words, the same for all failures with this cause.
        reported: The cause with its numbers.
        t_ns: The moment to inspect, in the time of the run's tables.
        at_s: The same moment in seconds from the run's first frame.
        start_ns: First moment of the failure.
        end_ns: Last moment of the failure.
        frames: Number of frames or steps that show the failure.
        approach: Id of the approach in the truth, or its number in a run without truth; None
            outside approaches.
        intersection: Name of the intersection; empty if it has none.
        conditions: Tags of the approach.
        distance_m: True distance to the intersection at ``t_ns``; None if unknown.
        severity: Severity in bits; see ``docs/howto/failures.md``.
    """

    run: str
    kind: Kind
    level: Level
    what: str
    cause: str
    reported: str
    t_ns: int
    at_s: float = 0.0
    start_ns: int
    end_ns: int
    frames: int
    approach: int | None = None
    intersection: str = ""
    conditions: tuple[str, ...] = ()
    distance_m: float | None = None
    severity: float

    @property
    def group(self) -> tuple[str, str, str]:
        """Kind, subject and cause, by which failures are grouped."""
        return self.kind, self.what, self.cause


@dataclass(frozen=True, slots=True)
class About:
    """Attributes that all failures of one approach share.

    Attributes:
        run: Folder of the run.
        approach: Id of the approach.
        intersection: Name of the intersection.
        conditions: Tags of the approach.
        start_ns: Start of the approach.
        end_ns: Time at which the vehicle enters the intersection.
    """

    run: str
    approach: int
    intersection: str
    conditions: tuple[str, ...]
    start_ns: int
    end_ns: int

    @property
    def shared(self) -> dict[str, Any]:
        """The attributes of every failure of the approach."""
        return {
            "approach": self.approach,
            "intersection": self.intersection,
            "conditions": self.conditions,
        }


def distance_bin(distance_m: float | None) -> str:
    """Return the name of the bin of a distance."""
    if distance_m is None:
        return "unknown"
    for near, far in pairwise(DISTANCES_M):
        if distance_m < far:
            return f"{near}-{far} m"
    return f"{DISTANCES_M[-1]} m and more"


def failure_schema() -> pa.Schema:
    """Return the schema of a table of failures."""
    kinds = {"int": INT, "float": REAL, "tuple[str, ...]": TEXTS}
    columns = {}
    for one in fields(Failure):
        kind, _, is_optional = str(one.type).partition(" | ")
        kind = kinds.get(kind, TEXT)
        columns[one.name] = Column(kind if is_optional else f"{kind} NOT NULL", "")
    return arrow_schema(columns)


def failure_table(failures: Sequence[Failure]) -> pa.Table:
    """Return failures as a table, in the same order."""
    return pa.Table.from_pylist([asdict(one) for one in failures], schema=failure_schema())


def write_failures(failures: Sequence[Failure], path: Path) -> None:
    """Write a table of failures as Parquet, or as JSON if the name ends in ``.json``.

    Run folders are written relative to the table's folder, so that both can be moved together.

    Raises:
        OutputError: The file cannot be written.
    """
    folder = path.resolve().parent
    failures = [replace(one, run=spelled(os.path.relpath(one.run, folder))) for one in failures]
    if path.suffix == ".json":
        rows = {"format": FORMAT, "failures": [asdict(one) for one in failures]}
        write_text(path, strict_json(rows) + "\n")
        return
    write_table(path, failure_table(failures))


def read_failures(table: Path | str) -> tuple[Failure, ...]:
    """Read the table that ``failures`` wrote.

    Args:
        table: ``.parquet`` or ``.json`` file; paths of runs are relative to its folder.

    Raises:
        AnnotationError: The table is missing, damaged, or lacks columns.
    """
    path = Path(table)
    if path.is_dir():
        raise _unreadable(path, "a folder")
    rows = _json_rows(path) if path.suffix == ".json" else _parquet_rows(path)
    names = {field.name for field in fields(Failure)}
    found = []
    for number, row in enumerate(rows):
        if not isinstance(row, dict) or names - row.keys():
            lacks = sorted(names - row.keys()) if isinstance(row, dict) else ["everything"]
            raise _unreadable(path, f"row {number} lacks {', '.join(lacks)}")
        values = {name: row[name] for name in names}
        if values["kind"] not in KINDS or not isinstance(values["t_ns"], int):
            raise _unreadable(path, f"row {number}: kind {values['kind']!r}, t_ns {row['t_ns']!r}")
        values["conditions"] = tuple(values["conditions"])
        values["run"] = os.path.normpath(path.parent / unspelled(values["run"]))
        found.append(Failure(**values))
    return tuple(found)


def _parquet_rows(path: Path) -> list[Any]:
    import pyarrow.parquet as pq

    try:
        with door.arrow_file(path.resolve()) as file:
            return list(pq.read_table(file, page_checksum_verification=True).to_pylist())
    except (OSError, pa.ArrowException) as error:
        raise _unreadable(path, str(error).partition("\n")[0]) from None


def _json_rows(path: Path) -> list[Any]:
    try:
        tree = json_tree(door.read(path.resolve(), MAX_BYTES))
    except (OSError, ValueError) as error:
        raise _unreadable(path, str(error)) from None
    rows = tree.get("failures") if isinstance(tree, dict) else None
    if not isinstance(rows, list):
        raise _unreadable(path, "no list of failures")
    return rows


def _unreadable(path: Path, why: str) -> AnnotationError:
    return AnnotationError(
        f"{path}: {why}; expected a table that crosscue failures -o wrote; write it again"
    )
