"""Print or write the rows of a table as text, CSV or JSON."""

from __future__ import annotations

import argparse
import base64
import csv
import io
import json
import sys
from collections.abc import Callable, Iterator
from datetime import date, datetime
from decimal import Decimal
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from crosscue.replay.base import UsageError, strict_json, write_bytes, write_table, write_text
from crosscue.replay.safe_text import table, terminal_width

from .terminal import print_json

if TYPE_CHECKING:
    import pyarrow as pa

UNBOUNDED: Final = 1 << 30


def print_rows(found: pa.Table, args: argparse.Namespace) -> None:
    """Print the rows as JSON (``--json``), as CSV (``--csv``), or as a text table."""
    if args.json:
        print_json(_records(found))
    elif args.csv:
        print(_csv(found), end="")
    elif not args.quiet:
        # Cells are cut to fit a terminal, but not in a pipe and not in a schema.
        is_cut = sys.stdout.isatty() and not args.schema
        print("\n".join(_lines(found, terminal_width() if is_cut else UNBOUNDED)))


def write_rows(found: pa.Table, args: argparse.Namespace) -> None:
    """Write the rows to the file of ``--output``, in its suffix's format; print their number.

    Raises:
        UsageError: The suffix has no format.
        OutputError: The file cannot be written.
    """
    write = WRITERS.get(args.output.suffix.lower())
    if write is None:
        raise UsageError(
            f"{args.output}: expected a name that ends in {', '.join(WRITERS)}; rename it"
        )
    write(args.output, found)
    if args.json:
        print_json({"output": str(args.output), "rows": found.num_rows})
    elif not args.quiet:
        print(f"{args.output}: {found.num_rows} rows")


def _lines(found: pa.Table, width: int) -> Iterator[str]:
    import pyarrow as pa

    rows = [[_cell(value) for value in row.values()] for row in _records(found)]
    numbers = (pa.types.is_integer, pa.types.is_floating, pa.types.is_decimal)
    texts = [i for i, one in enumerate(found.schema) if not any(is_a(one.type) for is_a in numbers)]
    yield from table(found.column_names, rows, width, texts)
    yield f"{len(rows)} row{'' if len(rows) == 1 else 's'}"


def _records(found: pa.Table) -> list[dict[str, Any]]:
    """Return the rows as values that JSON can hold."""
    import pyarrow as pa

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


WRITERS: Final[dict[str, Callable[[Path, Any], None]]] = {
    ".parquet": write_table,
    ".csv": lambda path, found: write_bytes(path, _csv(found).encode()),
    ".json": lambda path, found: write_text(path, strict_json(_records(found)) + "\n"),
}
"""Function that writes a table, by suffix of the file."""
