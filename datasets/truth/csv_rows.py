"""Rows of tables in CSV, each with its place for messages."""

import csv
import io
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from crosscue.replay.errors import AnnotationError
from crosscue.replay.files.bounded import read_text
from crosscue.replay.limits import MIB

MAX_BYTES: Final = 256 * MIB


def csv_rows(
    path: Path, *headers: str, remedy: str = "give a CSV file in UTF-8"
) -> Iterator[tuple[str, dict[str, str]]]:
    """Yield the place of each row of a CSV file, as ``path:line``, and its cells by column.

    Args:
        path: The file.
        headers: Columns, as text; the file must have those of one.
        remedy: End of messages about the file as a whole.

    Raises:
        AnnotationError: The file cannot be read, is not CSV in UTF-8, or lacks a column.
    """
    text = read_text(path, MAX_BYTES, AnnotationError, remedy).removeprefix("\ufeff")
    rows = csv.DictReader(io.StringIO(text, newline=""))
    try:
        known = rows.fieldnames or ()
        if not any(set(known).issuperset(one.split(",")) for one in headers):
            raise AnnotationError(
                f"{path}:1: expected columns {' or '.join(headers)}, got {','.join(known)}; "
                "correct the header"
            )
        for row in rows:
            yield f"{path}:{rows.line_num}", row
    except csv.Error as error:
        raise AnnotationError(f"{path}: {error}; {remedy}") from None
