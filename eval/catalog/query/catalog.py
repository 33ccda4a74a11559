"""Catalog of all runs below a folder or URL, queried by SQL."""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from crosscue.eval.runs.tables.columns import INDEXED, QUERIED
from crosscue.replay.errors import UnreadableRunError, UsageError
from crosscue.replay.remote.address import is_remote

from . import database, parts
from .index import Index, Runs, open_index
from .local import LocalRuns
from .remote import RemoteRuns

if TYPE_CHECKING:
    import pyarrow as pa

_WORD: Final = re.compile(r"\w+")
_SEVERAL: Final = """
select list(run) as examples from (
  select identity, settings_sha256, min(run) as run from runs
  where identity is not null group by identity, settings_sha256
)
group by identity having count(*) > 1 order by min(run)
"""
_OF_CONDITION: Final = "select run from runs where (\n{}\n) order by run"


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
        import pyarrow as pa

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
        """Return a column of the table ``runs`` as a list."""
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
            f"{found.num_rows} drives have runs of different settings, as {first} and {other}: "
            "settings_sha256 tells them apart"
        )

    @cached_property
    def _names(self) -> set[str]:
        files = {name for names in self._listed("tables") for name in names}
        return {*INDEXED, *QUERIED, *parts.table_names(files)}

    def _parts(self, table: str) -> parts.RunsTable:
        file = parts.file_of(table)
        places = {
            run: self._places.place(run, file)
            for run, files in zip(self._listed("run"), self._listed("tables"), strict=True)
            if file in files
        }
        return parts.RunsTable(table, places, self._places.filesystem)

    def __repr__(self) -> str:
        counts = f"{len(self._listed('run'))} runs, {len(self.left_out)} left out"
        return f"{self._places.name}: {counts}; tables: {', '.join(sorted(self._names))}"


def _views(table: str, found: parts.RunsTable) -> dict[str, Any]:
    """Return the data set and, if the table is computed, the SQL of its view, by name."""
    if table not in parts.VIEWS:
        return {table: found.dataset}
    base = f"{table}_of_runs"
    return {base: found.dataset, table: parts.VIEWS[table].format(table=base)}


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
