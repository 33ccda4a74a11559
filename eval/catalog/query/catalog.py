"""Every run below a folder, as tables and SQL."""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from crosscue.replay.base import UnreadableRunError, UsageError

from . import database, parts
from .columns import INDEXED, OWN, VIEWS
from .index import Index, Runs, open_index
from .local import LocalRuns

if TYPE_CHECKING:
    import pyarrow as pa

_WORD: Final = re.compile(r"\w+")
_OF_CONDITION: Final = "select run from runs where (\n{}\n) order by run"


class Catalog:
    """The runs below a folder; ``crosscue.catalog`` opens one.

    It knows the runs that were there then; their own tables are read when a query names them.
    """

    def __init__(self, places: Runs, index: Index) -> None:
        """Use ``catalog`` instead."""
        self._places: Final = places
        self._index: Final = index
        self._unreadable: Final[dict[str, str]] = {}

    @property
    def left_out(self) -> Mapping[str, str]:
        """By run, why it, or a table of it that a query needed, could not be read."""
        return {**self._index.left_out, **self._unreadable}

    @property
    def notice(self) -> str:
        """Why the index could not be saved; empty if it was."""
        return self._index.notice

    @property
    def runs(self) -> tuple[Path, ...]:
        """Folders of all runs, sorted."""
        return tuple(Path(self._places.place(run, "")) for run in sorted(self._listed("run")))

    def query(self, sql: str) -> pa.Table:
        """The rows that a query selects; ``schema`` lists what can be asked for.

        Nothing is written and no other file is read, whatever the query says. A run of which a
        table cannot be read is left out of that table, and added to ``left_out``.

        Args:
            sql: A single SELECT, in the SQL of DuckDB.

        Raises:
            UsageError: It is not one, or names a table or column that does not exist.
        """
        words = {word.lower() for word in _WORD.findall(sql)}
        tables: dict[str, Any] = {}
        for name in self._names:
            if name in words:
                tables |= self._content(name)
        return database.select(sql, tables, self._names)

    def select(self, query: str) -> tuple[Path, ...]:
        """Folders of the runs that a query selects.

        Args:
            query: A condition on the table ``runs``, such as ``vehicle = 'car'``; or a whole SELECT
                whose column ``run`` names them, in whose order they come, each once.

        Raises:
            UsageError: As ``query``; the result has no column ``run``.
        """
        sql = query
        if not database.is_statement(query):
            sql = _OF_CONDITION.format(query or "true")
        found = self.query(sql)
        if "run" not in found.column_names:
            raise UsageError(
                f"query: no column run in the result ({', '.join(found.column_names)}); "
                "select run, or give a condition on runs"
            )
        named = dict.fromkeys(found["run"].to_pylist())
        there = {*self._listed("run")}
        strange = [run for run in named if run not in there]
        if strange:
            raise UsageError(
                f"query: column run holds {strange[0]!r}, which is no run of {self._places.name}; "
                "select the column run of a table"
            )
        return tuple(Path(self._places.place(run, "")) for run in named)

    def schema(self) -> pa.Table:
        """Every table and column: table, column, type and meaning."""
        import pyarrow as pa

        listed = [
            (table, name, column.kind, column.meaning)
            for table, columns in {**INDEXED, **OWN}.items()
            for name, column in columns.items()
        ]
        further = sorted(self._names - {*INDEXED, *OWN})
        listed += [(table, "run, ...", "", f"{table}.parquet of the runs") for table in further]
        head = ("table", "column", "type", "meaning")
        columns = zip(*listed, strict=True)
        return pa.table({name: list(column) for name, column in zip(head, columns, strict=True)})

    def _listed(self, column: str) -> list[Any]:
        """A column of the table ``runs``."""
        import pyarrow.dataset as ds

        runs = self._index.tables["runs"]
        table = runs.to_table(columns=[column]) if isinstance(runs, ds.Dataset) else runs
        return list(table[column].to_pylist())

    @cached_property
    def _names(self) -> set[str]:
        files = {name for names in self._listed("tables") for name in names}
        return {*INDEXED, *OWN, *parts.tables_of(files)}

    def _content(self, table: str) -> dict[str, Any]:
        """A table by its name, and what a view of that name is made of."""
        if table in INDEXED:
            return {table: self._index.tables[table]}
        file = parts.file_of(table)
        places = {
            run: self._places.place(run, file)
            for run, files in zip(self._listed("run"), self._listed("tables"), strict=True)
            if file in files
        }
        found = parts.Parts(table, places, self._places.filesystem)
        self._unreadable.update(found.left_out)
        if table not in VIEWS:
            return {table: found.dataset}
        base = f"{table}_of_runs"
        return {base: found.dataset, table: VIEWS[table].format(table=base)}

    def __repr__(self) -> str:
        counts = f"{len(self._listed('run'))} runs, {len(self.left_out)} left out"
        return f"{self._places.name}: {counts}; tables: {', '.join(sorted(self._names))}"


def catalog(folder: Path | str) -> Catalog:
    """Open the catalog of all runs below a folder.

    Args:
        folder: A folder of runs, at any depth down to six, or a single run.

    Raises:
        UnreadableRunError: It is no folder, holds no run, or cannot be listed.
    """
    path = Path(folder)
    if not path.is_dir():
        raise UnreadableRunError(f"{path}: no folder; give a folder of runs")
    places = LocalRuns(path)
    return Catalog(places, open_index(places))


def select_runs(folder: Path | str, query: str) -> tuple[Path, ...]:
    """Folders of the runs that a query selects; see ``Catalog.select``.

    Args:
        folder: As for ``catalog``.
        query: As for ``Catalog.select``.
    """
    return catalog(folder).select(query)
