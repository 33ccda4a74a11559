"""One thing that went wrong in a run, and the table of such things."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

from crosscue.replay.base import AnnotationError, json_tree, strict_json, write_text, write_whole

if TYPE_CHECKING:
    import pyarrow as pa

Kind = Literal["missed", "late", "false", "range", "flipped"]
Level = Literal["approach", "frames"]
KINDS: Final[tuple[Kind, ...]] = ("missed", "late", "false", "range", "flipped")
FORMAT: Final = 1
DISTANCES_M: Final = (0, 10, 20, 40, 80)
"""Borders of the distances that failures are filtered by."""


@dataclass(frozen=True, slots=True)
class Failure:
    """One thing that went wrong.

    Attributes:
        run: Folder of the run.
        kind: What went wrong.
        level: Of a whole approach, or of consecutive frames of one cue or range.
        what: The feature, cue or range that it is about: ``left``, ``stop_sign``, ``range to end``.
        cause: In a few words, the same for all failures of one cause.
        reported: The cause with its numbers.
        t_ns: The moment to look at, in the time of the run's tables.
        at_s: The same in seconds from the run's first frame.
        start_ns: First moment of the failure.
        end_ns: Last moment.
        frames: Frames or steps that show it.
        approach: Id in the truth, or the run's number in a run without truth; None outside.
        intersection: Its name; empty without.
        conditions: Tags of the approach.
        distance_m: True distance to the intersection at that moment; None unknown.
        severity: In bits; see ``docs/howto/failures.md``.
    """

    run: str
    kind: Kind
    level: Level
    what: str
    cause: str
    reported: str
    t_ns: int
    at_s: float
    start_ns: int
    end_ns: int
    frames: int
    approach: int | None
    intersection: str
    conditions: tuple[str, ...]
    distance_m: float | None
    severity: float

    @property
    def group(self) -> tuple[str, str, str]:
        """Failures of one kind, about one thing, with one cause belong together."""
        return self.kind, self.what, self.cause


@dataclass(frozen=True, slots=True)
class About:
    """What all failures of one approach share.

    Attributes:
        run: Folder of the run.
        approach: Its id.
        intersection: Its name.
        conditions: Its tags.
        start_ns: When it begins.
        end_ns: When the car enters.
    """

    run: str
    approach: int
    intersection: str
    conditions: tuple[str, ...]
    start_ns: int
    end_ns: int


def distance_bin(distance_m: float | None) -> str:
    """The bin that a distance is filtered by."""
    if distance_m is None:
        return "unknown"
    for near, far in pairwise(DISTANCES_M):
        if distance_m < far:
            return f"{near}-{far} m"
    return f"{DISTANCES_M[-1]} m and more"


def failure_schema() -> pa.Schema:
    """Columns of a table of failures."""
    import pyarrow as pa

    return pa.schema(
        [
            pa.field("run", pa.string(), nullable=False),
            pa.field("kind", pa.string(), nullable=False),
            pa.field("level", pa.string(), nullable=False),
            pa.field("what", pa.string(), nullable=False),
            pa.field("cause", pa.string(), nullable=False),
            pa.field("reported", pa.string(), nullable=False),
            pa.field("t_ns", pa.int64(), nullable=False),
            pa.field("at_s", pa.float64(), nullable=False),
            pa.field("start_ns", pa.int64(), nullable=False),
            pa.field("end_ns", pa.int64(), nullable=False),
            pa.field("frames", pa.int64(), nullable=False),
            pa.field("approach", pa.int64()),
            pa.field("intersection", pa.string(), nullable=False),
            pa.field("conditions", pa.list_(pa.string()), nullable=False),
            pa.field("distance_m", pa.float64()),
            pa.field("severity", pa.float64(), nullable=False),
        ]
    )


def failure_table(failures: Sequence[Failure]) -> pa.Table:
    """Failures as a table, in their order."""
    import pyarrow as pa

    return pa.Table.from_pylist([asdict(one) for one in failures], schema=failure_schema())


def write_failures(failures: Sequence[Failure], path: Path) -> None:
    """Write a table of failures: Parquet, or JSON where the name ends in ``.json``.

    Run folders are written relative to the table's folder, so that both can be moved together.

    Raises:
        OutputError: It cannot be written.
    """
    import pyarrow.parquet as pq

    folder = path.resolve().parent
    failures = [replace(one, run=os.path.relpath(one.run, folder)) for one in failures]
    if path.suffix == ".json":
        rows = {"format": FORMAT, "failures": [asdict(one) for one in failures]}
        write_text(path, strict_json(rows) + "\n")
        return
    table = failure_table(failures)
    write_whole(
        path,
        lambda partial: pq.write_table(
            table, partial, compression="zstd", write_page_checksum=True
        ),
    )


def read_failures(path: Path) -> tuple[Failure, ...]:
    """Read such a table.

    Raises:
        AnnotationError: It is missing, damaged, or has other columns.
    """
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
        values["run"] = os.path.normpath(path.parent / values["run"])
        found.append(Failure(**values))
    return tuple(found)


def _parquet_rows(path: Path) -> list[Any]:
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        return list(pq.read_table(path, page_checksum_verification=True).to_pylist())
    except (OSError, pa.ArrowException) as error:
        raise _unreadable(path, str(error).partition("\n")[0]) from None


def _json_rows(path: Path) -> list[Any]:
    try:
        tree = json_tree(path.read_bytes())
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
