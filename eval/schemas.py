"""JSON Schemas of the files that other tools read and write."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, TypeAlias

from crosscue.datasets.truth.truth import truth_schema
from crosscue.eval.pipeline.run import run_schema
from crosscue.replay.errors import OutputError
from crosscue.replay.files.tree_text import strict_json
from crosscue.replay.files.whole_file import write_text
from crosscue.verb import Option

SchemaFile: TypeAlias = Annotated[Path | None, Option(metavar="FILE")]


def run(*, output: SchemaFile = None, overwrite: bool = False) -> dict[str, Any] | None:
    """Print the JSON Schema of a run's manifest.json.

    Editors and other tools can use it.

    Examples:
        crosscue run schema -o manifest.schema.json

    Args:
        output: File to write (default: print it).
        overwrite: Replace the output.
    """
    return _written(run_schema(), output, overwrite)


def truth(*, output: SchemaFile = None, overwrite: bool = False) -> dict[str, Any] | None:
    """Print the JSON Schema of truth.json.

    Editors and other tools can use it.

    Examples:
        crosscue truth schema -o truth.schema.json

    Args:
        output: File to write (default: print it).
        overwrite: Replace the output.
    """
    return _written(truth_schema(), output, overwrite)


def _written(schema: dict[str, Any], output: Path | None, overwrite: bool) -> dict[str, Any] | None:
    """Return the schema to print it, or None after writing it."""
    if output is None:
        return schema
    if output.exists() and not overwrite:
        raise OutputError(f"{output}: exists; give another name or --overwrite")
    write_text(output, strict_json(schema) + "\n")
    return None
