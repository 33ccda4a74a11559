"""The rows of every run, read from the runs or from the index of an earlier time.

The index is one file below the folder of the catalog, or in the cache where that cannot be written.
Each run has a stamp in it; only runs of another stamp are read, and rows of runs that are gone go.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Protocol

from crosscue.replay.base import OutputError, UnreadableRunError, is_remote

from .columns import INDEXED, arrow_schema
from .local import CUT_SHORT, Found
from .records import RunRows, rows_of
from .stored import Stored, write

if TYPE_CHECKING:
    import pyarrow as pa
    import pyarrow.fs

NAME: Final = ".catalog"
"""Of the index below the folder."""
MAX_BYTES: Final = 256 << 20
"""Of a manifest."""
ENTRIES: Final = "entries"
HALF: Final = "no manifest.json: cut short, or still being made; replay again"
KEPT: Final = ("runs", "approaches", "dropped")
_MARK: Final = hashlib.sha256(repr((1, INDEXED)).encode()).hexdigest()
"""Another list of columns makes another index."""


class Runs(Protocol):
    """Where runs lie; see ``local.LocalRuns``."""

    @property
    def name(self) -> str:
        """For messages."""
        ...

    @property
    def home(self) -> Path | None:
        """The folder that an index may be written to."""
        ...

    @property
    def filesystem(self) -> pyarrow.fs.FileSystem:
        """For Arrow."""
        ...

    def find(self) -> Iterator[Found]:
        """Every run folder."""
        ...

    def files(self, run: str) -> list[str]:
        """Names of a run's tables, those of its score after them, and of its tags."""
        ...

    def read(self, run: str, file: str) -> bytes:
        """The content of one of its files."""
        ...

    def place(self, run: str, file: str) -> str:
        """Where a file is in ``filesystem``."""
        ...

    def path(self, run: str) -> Path:
        """The folder of a run."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Index:
    """What a catalog holds.

    Attributes:
        tables: By name, as ``columns.INDEXED`` lists them: Arrow tables or data sets.
        left_out: By run, why it is not in the tables.
        notice: Why the index could not be saved; empty if it was.
    """

    tables: Mapping[str, Any]
    left_out: Mapping[str, str]
    notice: str = ""


@dataclass(slots=True)
class _Earlier:
    """What an index of an earlier time knows."""

    stamps: dict[str, tuple[int, ...]]
    left_out: dict[str, str]
    tables: dict[str, Any]


def open_index(runs: Runs, on_run: Callable[[int, int], None] = lambda done, of: None) -> Index:
    """The rows of all runs as they are now; the index is brought up to date.

    Args:
        runs: Where they are.
        on_run: Called with how many changed runs are read, and how many have to be.

    Raises:
        UnreadableRunError: A folder cannot be listed, or holds no run.
    """
    found = {one.run: one for one in runs.find()}
    if not found:
        raise UnreadableRunError(
            f"{runs.name}: neither a run folder nor a folder of some; replay first"
        )
    # A run alone is read as fast as its index.
    path = None if "." in found else _path_of(runs)
    earlier = _read_index(path)
    half = {run: HALF for run, one in found.items() if one.stamp == CUT_SHORT}
    whole = {run: one for run, one in found.items() if run not in half}
    changed = [one for run, one in whole.items() if earlier.stamps.get(run) != one.stamp]
    gone = earlier.stamps.keys() - whole.keys()
    if earlier.tables and not changed and not gone:
        return _index(earlier.tables, {**earlier.left_out, **half}, "")
    rows: list[RunRows] = []
    unreadable = {run: why for run, why in earlier.left_out.items() if run in whole}
    for done, one in enumerate(changed):
        on_run(done, len(changed))
        unreadable.pop(one.run, None)
        try:
            read = _read_run(runs, one)
        except (OSError, ValueError) as error:
            unreadable[one.run] = _why(error)
        else:
            rows += [] if read is None else [read]
    stale = gone | {one.run for one in changed}
    tables = {name: _brought_up(earlier.tables.get(name), name, stale, rows) for name in KEPT}
    entries = _entries(whole, unreadable)
    return _index(tables, {**unreadable, **half}, _save(path, {ENTRIES: entries, **tables}))


def _path_of(runs: Runs) -> Path:
    if runs.home is not None:
        return runs.home / NAME
    base = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    whole = runs.name if is_remote(runs.name) else str(Path(runs.name).resolve())
    key = hashlib.sha256(os.fsencode(whole)).hexdigest()[:32]
    return Path(base, "crosscue", "catalogs", key)


def _read_index(path: Path | None) -> _Earlier:
    """What is in the index; nothing where it is missing, damaged or of another version."""
    if path is None:
        return _Earlier({}, {}, {})
    try:
        stored = Stored(path.read_bytes(), _MARK)
        entries = stored.table(ENTRIES).to_table()
        columns = [entries[name].to_pylist() for name in ("run", *_STAMP, "reason")]
        tables = {name: stored.table(name) for name in KEPT}
    except (OSError, ValueError, KeyError):
        return _Earlier({}, {}, {})
    named, *stamps, reasons = columns
    left_out = {run: why for run, why in zip(named, reasons, strict=True) if why is not None}
    return _Earlier(dict(zip(named, zip(*stamps, strict=True), strict=True)), left_out, tables)


_STAMP: Final = ("stamp_0", "stamp_1", "stamp_2", "stamp_3")


def _entries(whole: Mapping[str, Found], unreadable: Mapping[str, str]) -> pa.Table:
    import pyarrow as pa

    stamps = zip(*(one.stamp for one in whole.values()), strict=True) if whole else [()] * 4
    columns: dict[str, Any] = {"run": pa.array(whole.keys(), pa.string())}
    for name, values in zip(_STAMP, stamps, strict=True):
        columns[name] = pa.array(values, pa.int64())
    columns["reason"] = pa.array([unreadable.get(run) for run in whole], pa.string())
    return pa.table(columns)


def _read_run(runs: Runs, found: Found) -> RunRows | None:
    head = runs.read(found.run, found.file)
    if len(head) > MAX_BYTES:
        raise ValueError(f"{found.file}: over {MAX_BYTES >> 20} MiB; replay again")
    files = runs.files(found.run)
    name = found.run.rpartition("/")[2] if found.run != "." else Path(runs.name).resolve().name
    return rows_of(found, name, head, files, lambda file: runs.read(found.run, file))


def _why(error: Exception) -> str:
    if isinstance(error, FileNotFoundError):
        return "gone while it was read; open the catalog again"
    return str(error.strerror or error) if isinstance(error, OSError) else str(error)


def _brought_up(earlier: Any, name: str, stale: set[str], rows: list[RunRows]) -> pa.Table:
    """A table without the rows of stale runs, and with new ones."""
    import pyarrow as pa
    import pyarrow.compute as pc

    schema = arrow_schema(INDEXED[name])
    new = pa.Table.from_pylist([row for one in rows for row in one.table(name)], schema)
    if earlier is None:
        return new
    kept = ~pc.field("run").isin(pa.array(stale, pa.string()))
    return pa.concat_tables([earlier.to_table(filter=kept).cast(schema), new]).unify_dictionaries()


def _save(path: Path | None, tables: Mapping[str, pa.Table]) -> str:
    """Empty, or why the index was not saved."""
    try:
        if path is not None:
            write(path, _MARK, tables)
    except OutputError as error:
        return f"the index was not saved, so the runs are read again next time: {error}"
    return ""


def _index(tables: Mapping[str, Any], left_out: Mapping[str, str], notice: str) -> Index:
    import pyarrow as pa

    schema = arrow_schema(INDEXED["left_out"])
    listed = pa.table([[*left_out.keys()], [*left_out.values()]], schema=schema)
    return Index({**tables, "left_out": listed}, left_out, notice)
