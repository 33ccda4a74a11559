"""Index of a catalog: the rows of every run, read from the runs or from an earlier index.

The index is one file below the folder of the catalog, or in the cache if that folder is read-only.
It records a stamp for each run. Only runs whose stamp changed are read again, and rows of deleted
runs are removed.

The index is only a cache: if it is damaged, the runs are read again. Its members are stored without
further compression, and the checksums of zip reveal damage.
"""

from __future__ import annotations

import hashlib
import io
import os
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeAlias

import pyarrow as pa

from crosscue.eval.runs.tables.columns import INDEXED, arrow_schema
from crosscue.replay.errors import OutputError, UnreadableRunError
from crosscue.replay.files import door
from crosscue.replay.files.tree_text import spelled
from crosscue.replay.files.whole_file import write_bytes
from crosscue.replay.remote.address import is_remote

from .local import CUT_SHORT, FoundRun, LocalRuns
from .records import RunRows, run_rows
from .remote import RemoteRuns

if TYPE_CHECKING:
    import pyarrow.dataset as ds

# Name of the folder of the index.
NAME: Final = ".catalog"
# Max size of a manifest, and of the index.
MAX_BYTES: Final = 256 << 20
ENTRIES: Final = "entries"
HALF: Final = "no manifest.json: cut short, or still being made; replay again"
KEPT: Final = ("runs", "approaches", "dropped")
# Version of the index; it changes with the list of columns.
_MARK: Final = hashlib.sha256(repr((1, INDEXED)).encode()).hexdigest()

_STAMP: Final = ("stamp_0", "stamp_1", "stamp_2", "stamp_3")
FORMAT: Final = "format"
# Storage of runs.
Runs: TypeAlias = LocalRuns | RemoteRuns


@dataclass(frozen=True, slots=True, eq=False)
class Index:
    """Content of a catalog.

    Attributes:
        tables: Arrow tables or data sets, by name as in ``columns.INDEXED``.
        left_out: Reason why a run is not in the tables, by run.
        notice: Reason why the index could not be saved; empty if it was.
    """

    tables: Mapping[str, Any]
    left_out: Mapping[str, str]
    notice: str = ""


@dataclass(slots=True)
class _Earlier:
    stamps: dict[str, tuple[int, ...]]
    left_out: dict[str, str]
    tables: dict[str, Any]


def open_index(runs: Runs) -> Index:
    """Return the current rows of all runs and update the index.

    Raises:
        UnreadableRunError: A folder cannot be listed, or holds no run.
    """
    found = {one.run: one for one in runs.find()}
    if not found:
        raise UnreadableRunError(
            f"{runs.name}: neither a run folder nor a folder of runs; replay first"
        )
    # Reading a single run is as fast as reading an index.
    path = None if "." in found else _path_of(runs)
    earlier = _read_index(path)
    half = {run: HALF for run, one in found.items() if one.stamp == CUT_SHORT}
    complete = {run: one for run, one in found.items() if run not in half}
    changed = [one for run, one in complete.items() if earlier.stamps.get(run) != one.stamp]
    gone = earlier.stamps.keys() - complete.keys()
    if earlier.tables and not changed and not gone:
        return _index(earlier.tables, {**earlier.left_out, **half}, "")
    rows: list[RunRows] = []
    unreadable = {run: why for run, why in earlier.left_out.items() if run in complete}
    for one in changed:
        unreadable.pop(one.run, None)
        try:
            read = _read_run(runs, one)
        except (OSError, ValueError) as error:
            unreadable[one.run] = _why(error)
        else:
            rows += [] if read is None else [read]
    stale = gone | {one.run for one in changed}
    tables = {name: _updated(earlier.tables.get(name), name, stale, rows) for name in KEPT}
    entries = _entries(complete, unreadable)
    return _index(tables, {**unreadable, **half}, _save(path, {ENTRIES: entries, **tables}))


def _path_of(runs: Runs) -> Path:
    if runs.home is not None:
        return runs.home / NAME
    address = runs.name if is_remote(runs.name) else str(Path(runs.name).resolve())
    key = hashlib.sha256(os.fsencode(address)).hexdigest()[:32]
    return door.user_cache("XDG_CACHE_HOME") / "catalogs" / key


def _read_index(path: Path | None) -> _Earlier:
    """Return the content of the index; empty if it is missing, damaged or of another version."""
    nothing = _Earlier({}, {}, {})
    if path is None:
        return nothing
    try:
        archive = zipfile.ZipFile(io.BytesIO(door.read(path, MAX_BYTES)))
        if archive.read(FORMAT) != _MARK.encode():
            return nothing
        entries = _opened(archive, ENTRIES).to_table()
        named, *stamps, reasons = (entries[name].to_pylist() for name in ("run", *_STAMP, "reason"))
        tables = {name: _opened(archive, name) for name in KEPT}
    except (zipfile.BadZipFile, OSError, ValueError, KeyError, pa.ArrowException):
        return nothing
    left_out = {run: why for run, why in zip(named, reasons, strict=True) if why is not None}
    return _Earlier(dict(zip(named, zip(*stamps, strict=True), strict=True)), left_out, tables)


def _opened(archive: zipfile.ZipFile, name: str) -> ds.Dataset:
    """Return a table of an index as a data set, which decodes only the columns that are used."""
    import pyarrow.dataset as ds

    form = ds.ParquetFileFormat()
    fragment = form.make_fragment(pa.py_buffer(archive.read(name)))
    return ds.FileSystemDataset([fragment], fragment.physical_schema, form)


def _entries(complete: Mapping[str, FoundRun], unreadable: Mapping[str, str]) -> pa.Table:
    stamps = zip(*(one.stamp for one in complete.values()), strict=True) if complete else [()] * 4
    columns: dict[str, Any] = {"run": pa.array(complete.keys(), pa.string())}
    for name, values in zip(_STAMP, stamps, strict=True):
        columns[name] = pa.array(values, pa.int64())
    columns["reason"] = pa.array([unreadable.get(run) for run in complete], pa.string())
    return pa.table(columns)


def _read_run(runs: Runs, found: FoundRun) -> RunRows | None:
    head = runs.read(found.run, found.file)
    if len(head) > MAX_BYTES:
        raise ValueError(f"{found.file}: over {MAX_BYTES >> 20} MiB; replay again")
    files = runs.files(found.run)
    run = spelled(str(Path(runs.name).resolve())) if found.run == "." else found.run
    name = run.rpartition("/")[2]
    return run_rows(found, name, head, files, lambda file: runs.read(found.run, file))


def _why(error: Exception) -> str:
    if isinstance(error, FileNotFoundError):
        return "deleted while it was read; open the catalog again"
    return str(error.strerror or error) if isinstance(error, OSError) else str(error)


def _updated(earlier: Any, name: str, stale: set[str], rows: list[RunRows]) -> pa.Table:
    """Return a table without the rows of stale runs and with the new rows."""
    import pyarrow.compute as pc

    schema = arrow_schema(INDEXED[name])
    new = pa.Table.from_pylist([row for one in rows for row in one.table(name)], schema)
    if earlier is None:
        return new
    kept = ~pc.field("run").isin(pa.array(stale, pa.string()))
    return pa.concat_tables([earlier.to_table(filter=kept).cast(schema), new]).unify_dictionaries()


def _index(tables: Mapping[str, Any], left_out: Mapping[str, str], notice: str) -> Index:
    schema = arrow_schema(INDEXED["left_out"])
    listed = pa.table([[*left_out.keys()], [*left_out.values()]], schema=schema)
    return Index({**tables, "left_out": listed}, left_out, notice)


def _save(path: Path | None, tables: Mapping[str, pa.Table]) -> str:
    """Save the index; return the reason if it could not be saved, else an empty text."""
    import pyarrow.parquet as pq

    if path is None:
        return ""
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        archive.writestr(FORMAT, _MARK)
        for name, table in tables.items():
            member = io.BytesIO()
            pq.write_table(table, member, compression="zstd")
            archive.writestr(name, member.getvalue())
    try:
        write_bytes(path, content.getvalue())
    except OutputError as error:
        return f"the index was not saved, so the runs are read again next time: {error}"
    return ""
