"""What the objects of the interface print in a notebook: tables of plain text."""

from __future__ import annotations

from collections.abc import Sequence

from crosscue.replay.safe_text import table, terminal_width


def listing(head: Sequence[str], rows: Sequence[Sequence[object]], text_columns: int = 1) -> str:
    """Lines of a table; a dash stands for what is not known.

    Args:
        head: Column names.
        rows: Cells; None for what is not known.
        text_columns: How many of the first columns hold text and not numbers.
    """
    cells = [["-" if cell is None else _cell(cell) for cell in row] for row in rows]
    return "\n".join(table(head, cells, terminal_width(), range(text_columns)))


def _cell(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    return f"{value:,}" if isinstance(value, int) else str(value)
