"""SQL over tables in memory and data sets, in a DuckDB that cannot access anything else.

The database has no file system, network, extensions, Python variables or temporary files, and its
settings are locked before a query is read. Only a single SELECT is run. (Before version 2, a
locked DuckDB could still be made to write its log to a file.) A query can therefore only access the
tables that were passed in, which Arrow reads.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any, Final

from crosscue.replay.errors import UsageError, one_line
from crosscue.replay.files.tree_text import json_tree

if TYPE_CHECKING:
    import duckdb
    import pyarrow as pa

# Settings, in the order in which they must be set.
LOCKED: Final[Mapping[str, str]] = {
    "temp_directory": "''",
    "autoinstall_known_extensions": "false",
    "autoload_known_extensions": "false",
    "allow_community_extensions": "false",
    "allow_persistent_secrets": "false",
    "python_enable_replacements": "false",
    "enable_progress_bar": "false",
    "errors_as_json": "true",
    "enable_external_access": "false",
    "lock_configuration": "true",
}
# Max characters of DuckDB's messages, which may quote long values.
MAX_LINE: Final = 300
_QUOTED: Final = re.compile(r'"([^"]+)"')
_SCHEMA: Final = "crosscue query --schema lists all"


class FailedError(UsageError):
    """A valid query failed on the rows that it read."""


def select(sql: str, tables: Mapping[str, Any], known: Iterable[str]) -> pa.Table:
    """Return the result of one SELECT.

    Args:
        sql: The query.
        tables: Arrow tables, data sets, or SQL text over the others, by name.
        known: Names of all existing tables, for messages.

    Raises:
        UsageError: The text is not a single SELECT, or uses a name that does not exist (the
            message suggests the nearest name), or its result does not fit in memory.
        FailedError: The query fails on a row, or a file cannot be read.
    """
    import duckdb

    with duckdb.connect(":memory:") as database:
        for name, content in tables.items():
            if not isinstance(content, str):
                database.register(name, content)
        for name, content in tables.items():
            if isinstance(content, str):
                database.execute(f'create view "{name}" as {content}')
        for name, value in LOCKED.items():
            database.execute(f"set {name} = {value}")
        columns = _columns(tables.values())
        try:
            _check(database, sql)
        except duckdb.Error as error:
            raise UsageError(_message(error, sorted(known), columns)) from None
        try:
            return database.sql(sql).to_arrow_table()
        except (MemoryError, duckdb.OutOfMemoryException):
            raise UsageError(
                "query: the result does not fit in memory; select fewer rows or columns, or "
                "count and sum them in SQL"
            ) from None
        except duckdb.Error as error:
            raise FailedError(_message(error, sorted(known), columns)) from None


def _columns(contents: Iterable[Any]) -> list[str]:
    return sorted(
        {name for one in contents if not isinstance(one, str) for name in one.schema.names}
    )


def is_statement(text: str) -> bool:
    """Return whether the text is a complete query and not just a condition."""
    first = text.split(maxsplit=1)
    return bool(first) and first[0].lower() in ("select", "with", "from")


def _check(database: duckdb.DuckDBPyConnection, sql: str) -> None:
    """Refuse everything but a single SELECT over existing names."""
    import duckdb

    statements = database.extract_statements(sql)
    kinds = [one.type for one in statements]
    if kinds != [duckdb.StatementType.SELECT]:
        found = ", ".join(kind.name for kind in kinds) or "nothing"
        raise UsageError(f"query: expected a single SELECT, found {found}; a catalog is read-only")
    # Errors of executed statements are JSON; those of a relation are plain text.
    database.execute(f"explain {statements[0].query}")


def _message(error: duckdb.Error, tables: list[str], columns: list[str]) -> str:
    """Return a message of one line; it suggests the nearest name for a misspelt one."""
    text = str(error)
    try:
        report = json_tree(text[text.index("{") :])
        message = str(report["exception_message"])
    except (ValueError, KeyError, TypeError):
        return f"query: {one_line(error, MAX_LINE)}; {_SCHEMA}"
    named = _QUOTED.findall(message.split("\n")[0])
    name = str(report.get("name") or (named[-1] if named else ""))
    if report.get("type") == "Table":
        return f"query: no table {name}; {_nearest(name, tables)}"
    if report.get("exception_type") == "Binder" and name and name not in columns:
        return f"query: no column {name}; {_nearest(name, columns)}"
    return f"query: {one_line(ValueError(message), MAX_LINE)}; {_SCHEMA}"


def _nearest(name: str, there: list[str]) -> str:
    plain = name.rpartition(".")[2].lower()
    close = difflib.get_close_matches(plain, there, n=1, cutoff=0.5)
    return (f"did you mean {close[0]}? " if close else "") + _SCHEMA
