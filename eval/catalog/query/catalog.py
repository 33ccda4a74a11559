"""Catalog of all runs below a folder or URL, queried by SQL.

Arrow reads only the needed columns and row groups and verifies page checksums. The run is a
partition column with one value per file, so the files of other runs are not opened.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import pyarrow as pa

from crosscue.eval.runs.tables.columns import INDEXED, QUERIED, RUN, arrow_schema
from crosscue.replay.errors import UnreadableRunError, UsageError
from crosscue.replay.files import door
from crosscue.replay.remote.address import is_remote
from crosscue.replay.safe_text import counted

from . import database
from .index import Index, Runs, open_index
from .local import LocalRuns
from .remote import RemoteRuns

if TYPE_CHECKING:
    import pyarrow.dataset as ds
    import pyarrow.fs

_WORD: Final = re.compile(r"\w+")
_SEVERAL: Final = """
select list(run) as examples from (
  select identity, settings_sha256, min(run) as run from runs
  where identity is not null group by identity, settings_sha256
)
group by identity having count(*) > 1 order by min(run)
"""
_OF_CONDITION: Final = "select run from runs where (\n{}\n) order by run"

WORKERS: Final = 8
SCORE: Final = "score/"
# Path of a table in a run, if it is not stored under its own name.
FILES: Final[Mapping[str, str]] = {
    "scores": "score/by_drive.parquet",
    "cue_frames": "score/cue_frames.parquet",
    "curves": "score/curves.parquet",
}
# SQL of the tables that are computed from a file.
VIEWS: Final[Mapping[str, str]] = {
    "scores": "select run, log, metric, kind, total, rows, places, case kind when 'sum' then total "
    "when 'rms' then sqrt(total / nullif(rows, 0)) else total / nullif(rows, 0) end as value "
    "from {table}",
}


class Catalog:
    """The runs below a folder; ``crosscue.catalog`` opens one.

    It contains the runs that existed when it was opened. Their tables are read when a query names
    them.
    """

    def __init__(self, places: Runs, index: Index) -> None:
        """Initialize the catalog; call ``catalog`` to open one."""
        self._places: Final = places
        self._index: Final = index
        self._unreadable: Final[dict[str, str]] = {}

    @property
    def left_out(self) -> Mapping[str, str]:
        """Reason why a run, or a table of it that a query needed, could not be read, by run."""
        return {**self._index.left_out, **self._unreadable}

    @property
    def notices(self) -> tuple[str, ...]:
        """Notices: the index could not be saved, or drives have runs with different settings."""
        return tuple(text for text in (self._index.notice, self._several_settings()) if text)

    @property
    def runs(self) -> tuple[Path, ...]:
        """Folders of all runs that did not fail, sorted."""
        named = zip(self._listed("run"), self._listed("outcome"), strict=True)
        done = sorted(run for run, outcome in named if outcome != "failed")
        return tuple(self._places.path(run) for run in done)

    def query(self, sql: str) -> pa.Table:
        """Return the rows that a query selects; ``schema`` lists the tables and columns.

        No query can write anything or read another file. If a run's table cannot be read, the run
        is left out of that table and added to ``left_out``.

        Args:
            sql: A single SELECT, in the SQL of DuckDB.

        Raises:
            UsageError: The text is not a single SELECT, or names a table or column that does not
                exist.
        """
        words = {word.lower() for word in _WORD.findall(sql)}
        named = [name for name in self._names if name in words]
        files = {name: self._parts(name) for name in named if name not in INDEXED}
        while True:
            tables = {name: self._index.tables[name] for name in named if name in INDEXED}
            for name, one in files.items():
                tables |= _views(name, one)
                self._unreadable.update(one.left_out)
            try:
                return database.select(sql, tables, self._names)
            except database.FailedError:
                # A file whose header is intact may be damaged further on or deleted.
                if not sum(one.drop_damaged() for one in files.values()):
                    raise

    def select(self, query: str) -> tuple[Path, ...]:
        """Return the folders of the runs that a query selects.

        Args:
            query: As for ``named``.

        Raises:
            UsageError: As for ``named``, or the runs are on a store and have no local folder.
        """
        return tuple(self._places.path(run) for run in self.named(query))

    def named(self, query: str) -> tuple[str, ...]:
        """Return the names of the runs that a query selects: values of the column ``run``.

        Args:
            query: A condition on the table ``runs``, such as ``vehicle = 'car'``; or a complete
                SELECT with a column ``run``, whose order is kept and whose repeats are dropped.

        Raises:
            UsageError: As for ``query``, or the result has no column ``run``.
        """
        sql = query
        if not database.is_statement(query):
            sql = _OF_CONDITION.format(query or "true")
        found = self.query(sql)
        if "run" not in found.column_names:
            raise UsageError(
                f"query: no column run in the result ({', '.join(found.column_names)}); "
                "select run, or write a condition on runs"
            )
        named = dict.fromkeys(found["run"].to_pylist())
        there = {*self._listed("run")}
        strange = [run for run in named if run not in there]
        if strange:
            raise UsageError(
                f"query: column run holds {strange[0]!r}, which is not a run of "
                f"{self._places.name}; select the column run of a table"
            )
        return tuple(named)

    def schema(self) -> pa.Table:
        """Return the table, name, type and meaning of every column."""
        listed = [
            (table, name, column.kind, column.meaning)
            for table, columns in {**INDEXED, **QUERIED}.items()
            for name, column in columns.items()
        ]
        further = sorted(self._names - {*INDEXED, *QUERIED})
        listed += [(table, "run, ...", "", f"{table}.parquet of the runs") for table in further]
        head = ("table", "column", "type", "meaning")
        columns = zip(*listed, strict=True)
        return pa.table({name: list(column) for name, column in zip(head, columns, strict=True)})

    def _listed(self, column: str) -> list[Any]:
        import pyarrow.dataset as ds

        runs = self._index.tables["runs"]
        table = runs.to_table(columns=[column]) if isinstance(runs, ds.Dataset) else runs
        return list(table[column].to_pylist())

    def _several_settings(self) -> str:
        """Return a notice about drives that were run with several settings; empty without any."""
        found = database.select(_SEVERAL, {"runs": self._index.tables["runs"]}, ["runs"])
        if not found.num_rows:
            return ""
        first, other = sorted(found["examples"][0].as_py())[:2]
        return (
            f"{counted(found.num_rows, 'drive')} with runs of different settings, as {first} "
            f"and {other}: settings_sha256 tells them apart"
        )

    @cached_property
    def _names(self) -> set[str]:
        files = {name for names in self._listed("tables") for name in names}
        return {*INDEXED, *QUERIED, *table_names(files)}

    def _parts(self, table: str) -> RunsTable:
        file = FILES.get(table, f"{table}.parquet")
        places = {
            run: self._places.place(run, file)
            for run, files in zip(self._listed("run"), self._listed("tables"), strict=True)
            if file in files
        }
        return RunsTable(table, places, self._places.filesystem)

    def __repr__(self) -> str:
        counts = f"{counted(len(self._listed('run')), 'run')}, {len(self.left_out)} left out"
        return f"{self._places.name}: {counts}; tables: {', '.join(sorted(self._names))}"


def _views(table: str, found: RunsTable) -> dict[str, Any]:
    """Return the data set and, if the table is computed, the SQL of its view, by name."""
    if table not in VIEWS:
        return {table: found.dataset}
    base = f"{table}_of_runs"
    return {base: found.dataset, table: VIEWS[table].format(table=base)}


def catalog(place: Path | str) -> Catalog:
    """Open the catalog of all runs below a folder or URL.

    Args:
        place: A folder of runs, nested up to six deep; a single run; or a URL that fsspec supports,
            such as ``s3://bucket/runs``, from which only the needed data are fetched.

    Raises:
        RunError: The place is not a folder, holds no run, or cannot be listed.
    """
    if is_remote(place) and not str(place).startswith("file://"):
        places: Runs = RemoteRuns(place)
    else:
        folder = Path(str(place).removeprefix("file://"))
        if not folder.is_dir():
            raise UnreadableRunError(f"{folder}: not a folder; expected a folder of runs")
        places = LocalRuns(folder)
    return Catalog(places, open_index(places))


def table_names(files: Iterable[str]) -> set[str]:
    """Return the names of the tables that these files contain."""
    inside = {name: table for table, name in FILES.items()}
    plain = {name.removesuffix(".parquet") for name in files if not name.startswith(SCORE)}
    return plain | {inside[name] for name in files if name in inside}


class RunsTable:
    """One table over many runs.

    Attributes:
        left_out: Reason why a run's file could not be read, by run.
    """

    def __init__(
        self, table: str, runs: Mapping[str, str], filesystem: pyarrow.fs.FileSystem
    ) -> None:
        """Read the schema of every file.

        Args:
            table: Name of the table.
            runs: Path of each run's file in the file system, by run.
            filesystem: File system of the runs.
        """
        import pyarrow.dataset as ds

        self.left_out: Final[dict[str, str]] = {}
        self._places: Final = runs
        self._filesystem: Final = filesystem
        scan = ds.ParquetFragmentScanOptions(pre_buffer=True, page_checksum_verification=True)
        self._form: Final = ds.ParquetFileFormat(default_fragment_scan_options=scan)
        self._fragments: Final[dict[str, ds.Fragment]] = {}
        schema = arrow_schema(RUN)
        fragments = {run: self._fragment(run, path) for run, path in runs.items()}
        with ThreadPoolExecutor(WORKERS) as pool:
            read = attrgetter("physical_schema")
            schemas = [pool.submit(read, fragment) for fragment in fragments.values()]
        for (run, fragment), found in zip(fragments.items(), schemas, strict=True):
            try:
                plain = found.result().remove_metadata()
                schema = pa.unify_schemas([schema, plain], promote_options="permissive")
            except (OSError, pa.ArrowException) as error:
                self.left_out[run] = _why(runs[run], error)
                continue
            self._fragments[run] = fragment
        self._schema: Final = schema if self._fragments else arrow_schema(QUERIED.get(table, RUN))

    def _fragment(self, run: str, path: str) -> ds.Fragment:
        import pyarrow.dataset as ds

        is_run = ds.field("run") == run
        try:
            return self._form.make_fragment(path, self._filesystem, partition_expression=is_run)
        except UnicodeEncodeError:
            # Arrow's file systems refuse a name that is not UTF-8. This file stays open.
            file = door.arrow_file(Path(path))
            return self._form.make_fragment(file, partition_expression=is_run)

    @property
    def dataset(self) -> ds.Dataset:
        """Rows of all runs whose file can be read."""
        import pyarrow.dataset as ds

        fragments = list(self._fragments.values())
        return ds.FileSystemDataset(fragments, self._schema, self._form, self._filesystem)

    def drop_damaged(self) -> int:
        """Read every file completely, leave out unreadable ones, and return their number."""
        damaged = {}
        for run, fragment in self._fragments.items():
            try:
                for _ in fragment.to_batches():
                    pass
            except (OSError, pa.ArrowException) as error:
                damaged[run] = _why(self._places[run], error)
        for run in damaged:
            del self._fragments[run]
        self.left_out.update(damaged)
        return len(damaged)


def _why(path: str, error: Exception) -> str:
    name = path.rpartition("/")[2]
    if isinstance(error, FileNotFoundError):
        return f"{name}: deleted; open the catalog again"
    return f"{name}: damaged or of other types ({' '.join(str(error).split())[:200]}); replay again"
