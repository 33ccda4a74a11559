"""Write a study's results to a page that needs no network and runs no script."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from crosscue.eval.report.html import write_page
from crosscue.replay.files import door


@dataclass(frozen=True, slots=True)
class PageTable:
    """A table of text.

    Attributes:
        heading: Heading above the table.
        head: Column names.
        rows: Rows with one entry per column.
    """

    heading: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]

    def as_text(self) -> str:
        """Return the table as text with aligned columns."""
        widths = [max(map(len, column)) for column in zip(self.head, *self.rows, strict=True)]
        lines = [self._line(self.head, widths), *(self._line(row, widths) for row in self.rows)]
        return "\n".join([self.heading, *lines])

    @staticmethod
    def _line(entries: Sequence[str], widths: Sequence[int]) -> str:
        first, *others = zip(entries, widths, strict=True)
        return "  ".join(
            [f"{first[0]:<{first[1]}}", *(f"{entry:>{width}}" for entry, width in others)]
        ).rstrip()


def write_study_page(
    path: Path,
    title: str,
    notes: Sequence[str],
    tables: Sequence[PageTable],
    pictures: Sequence[Path],
) -> None:
    """Write the page.

    Raises:
        OutputError: The page cannot be written.
    """
    drawn = [(one.stem, base64.b64encode(door.read(one)).decode()) for one in pictures]
    content = {"title": title, "notes": notes, "tables": tables, "pictures": drawn}
    write_page(path, "study.html.j2", content)
