"""Query runs with SQL, and print or write the rows as text, CSV, JSON or Parquet."""

import base64
import csv
import io
import json
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import date, datetime
from decimal import Decimal
from pathlib import Path
from typing import Annotated, Any, ClassVar, Final

import pyarrow as pa

from crosscue.eval.catalog.query.catalog import catalog
from crosscue.replay.errors import CrosscueError, OutputError, UsageError
from crosscue.replay.files.tree_text import strict_json
from crosscue.replay.files.whole_file import write_bytes, write_table, write_text
from crosscue.replay.progress import Notice, emit
from crosscue.replay.safe_text import counted, table, terminal_width
from crosscue.results import Result
from crosscue.verb import Option

UNBOUNDED: Final = 1 << 30


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class QueryResult(Result):
    """Rows of a query.

    Attributes:
        rows: The rows.
        output: The file they were written to, if any.
        is_schema: True for a list of tables and columns.
        is_whole: True if every run could be read.
    """

    rows: pa.Table
    output: Path | None
    is_schema: bool
    is_whole: bool

    formats: ClassVar = {"csv": "print the result as CSV"}

    def as_dict(self) -> Any:
        """Return the rows, or where they were written."""
        if self.output is not None:
            return {"output": str(self.output), "rows": self.rows.num_rows}
        return _records(self.rows)

    def csv(self) -> str:
        """Return the rows as CSV, with lists and maps as JSON and null as an empty cell."""
        return _csv(self.rows).removesuffix("\n")

    def lines(self) -> Iterator[str]:
        """Yield the rows as a table, or where they were written."""
        if self.output is not None:
            yield f"{self.output}: {counted(self.rows.num_rows, 'row')}"
            return
        # Cells are cut to fit a terminal, but not in a pipe and not in a schema.
        is_cut = sys.stdout.isatty() and not self.is_schema
        yield from _lines(self.rows, terminal_width() if is_cut else UNBOUNDED)


def query(
    runs: Annotated[str, Option(metavar="RUNS")],
    sql: Annotated[str | None, Option(metavar="SQL", is_positional=True)] = None,
    *,
    schema: bool = False,
    output: Annotated[Path | None, Option(metavar="FILE")] = None,
    overwrite: bool = False,
) -> QueryResult:
    """Query all runs below a folder with SQL.

    The tables are runs, approaches, cues, scores, belief, range, pose, dropped and every other
    table that runs contain; --schema lists their columns. The query is one SELECT in DuckDB's SQL.
    It is read-only: it can neither write anything nor read any other file. Runs that cannot be read
    are named on stderr, and the exit status is 3.

    Examples:
        crosscue query runs "select vehicle, count(*) from runs group by vehicle"
        crosscue query runs "select run from approaches where 'dusk' in conditions" --csv
        crosscue query runs "from scores where metric = 'range.start.rmse_m'" -o ranges.parquet
        crosscue query runs --schema

    Args:
        runs: Folder or URL of runs, or one run.
        sql: One SELECT, in quotes.
        schema: Print tables and columns instead.
        output: File to write: .parquet, .csv or .json.
        overwrite: Replace the output.
    """
    if (sql is None) != schema:
        raise UsageError("query: expected either SQL or --schema; see crosscue query --help")
    if output is not None and output.exists() and not overwrite:
        raise OutputError(f"{output}: exists; give another name or --overwrite")
    found = catalog(runs)
    rows = found.schema() if sql is None else found.query(sql)
    if output is not None:
        write = WRITERS.get(output.suffix.lower())
        if write is None:
            raise UsageError(
                f"{output}: expected a name that ends in {', '.join(WRITERS)}; rename it"
            )
        write(output, rows)
    for notice in found.notices:
        emit(Notice(notice))
    for name, why in sorted(found.left_out.items()):
        emit(CrosscueError(f"left out: {name}: {why}"))
    return QueryResult(rows, output, schema, not found.left_out)


def _lines(found: pa.Table, width: int) -> Iterator[str]:
    rows = [[_cell(value) for value in row.values()] for row in _records(found)]
    numbers = (pa.types.is_integer, pa.types.is_floating, pa.types.is_decimal)
    texts = [i for i, one in enumerate(found.schema) if not any(is_a(one.type) for is_a in numbers)]
    yield from table(found.column_names, rows, width, texts)
    yield counted(len(rows), "row")


def _records(found: pa.Table) -> list[dict[str, Any]]:
    maps = {one.name for one in found.schema if pa.types.is_map(one.type)}
    return [
        {
            name: _plain(dict(value) if name in maps and value is not None else value)
            for name, value in zip(found.column_names, row, strict=True)
        }
        for row in zip(*(column.to_pylist() for column in found.columns), strict=True)
    ]


def _plain(value: Any) -> Any:
    if isinstance(value, Decimal):
        return int(value) if value == value.to_integral_value() else float(value)
    if isinstance(value, datetime | date):
        return value.isoformat()
    if isinstance(value, bytes):
        return base64.b64encode(value).decode("ascii")
    if isinstance(value, dict):
        return {name: _plain(one) for name, one in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(one) for one in value]
    return value if isinstance(value, str | int | float | None) else str(value)


def _cell(value: Any) -> str:
    if value is None:
        return "-"
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, dict):
        return ", ".join(f"{name}={_cell(one)}" for name, one in value.items())
    if isinstance(value, list):
        return ", ".join(map(_cell, value))
    return str(value).lower() if isinstance(value, bool) else str(value)


def _csv(found: pa.Table) -> str:
    """Return the rows as CSV, with lists and maps as JSON and null as an empty cell."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(found.column_names)
    for row in _records(found):
        writer.writerow(
            json.dumps(one) if isinstance(one, dict | list) else one for one in row.values()
        )
    return stream.getvalue()


# Function that writes a table, by suffix of the file.
WRITERS: Final[dict[str, Callable[[Path, Any], None]]] = {
    ".parquet": write_table,
    ".csv": lambda path, found: write_bytes(path, _csv(found).encode()),
    ".json": lambda path, found: write_text(path, strict_json(_records(found)) + "\n"),
}
