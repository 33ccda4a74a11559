"""Plain-text tables that the public objects print in a notebook."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import ClassVar, TypeVar, overload

from crosscue.replay.safe_text import table, terminal_width

T = TypeVar("T")


def listing(head: Sequence[str], rows: Sequence[Sequence[object]], text_columns: int = 1) -> str:
    """Return the text of a table, with a dash for unknown values.

    Args:
        head: Column names.
        rows: Cells; None where unknown.
        text_columns: Number of leading columns that contain text instead of numbers.
    """
    cells = [["-" if cell is None else _cell(cell) for cell in row] for row in rows]
    return "\n".join(table(head, cells, terminal_width(), range(text_columns)))


def _cell(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    return f"{value:,}" if isinstance(value, int) else str(value)


class Listing(Sequence[T]):
    """Sequence of records; its repr is a text table."""

    head: ClassVar[tuple[str, ...]]

    def __init__(self, rows: Sequence[T]) -> None:
        """Store the records."""
        self._rows = tuple(rows)

    @abstractmethod
    def cells(self, row: T) -> tuple[object, ...]:
        """Return the cells of a record, in the order of ``head``."""

    @overload
    def __getitem__(self, which: int) -> T: ...
    @overload
    def __getitem__(self, which: slice) -> Sequence[T]: ...
    def __getitem__(self, which: int | slice) -> T | Sequence[T]:
        return self._rows[which]

    def __len__(self) -> int:
        return len(self._rows)

    def __repr__(self) -> str:
        return listing(self.head, [self.cells(row) for row in self], len(self.head))
