"""Write a study's results to a page that needs no network and runs no script."""

from __future__ import annotations

import base64
import html
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from crosscue.replay.files import door
from crosscue.replay.files.whole_file import write_text

HEAD: Final = """\
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy"
 content="default-src 'none'; img-src data:; style-src 'unsafe-inline'">"""
STYLE: Final = """\
:root{color-scheme:light dark;--ink:#222;--soft:#555;--line:#ddd;--paper:#fff}
@media (prefers-color-scheme:dark){
:root{--ink:#e6edf3;--soft:#9198a1;--line:#30363d;--paper:#0d1117}}
body{font:15px/1.5 system-ui,sans-serif;max-width:75rem;margin:2rem auto;padding:0 1rem;
color:var(--ink);background:var(--paper)}
.scroll{overflow-x:auto}
table{border-collapse:collapse;margin:1rem 0;font-variant-numeric:tabular-nums}
th,td{padding:.25rem .7rem;border-bottom:1px solid var(--line);text-align:right}
th:first-child,td:first-child{text-align:left}
img{max-width:100%;background:#fff}
p.note{color:var(--soft)}"""


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
    parts = [f"<h1>{html.escape(title)}</h1>"]
    parts += [f'<p class="note">{html.escape(note)}</p>' for note in notes]
    for picture in pictures:
        coded = base64.b64encode(door.read(picture)).decode()
        parts.append(f'<img alt="{html.escape(picture.stem)}" src="data:image/png;base64,{coded}">')
    parts += [_table(table) for table in tables]
    body = "\n".join(parts)
    write_text(
        path,
        f'<!doctype html>\n<html lang="en">\n{HEAD}\n<title>{html.escape(title)}'
        f"</title>\n<style>{STYLE}</style>\n<body>\n{body}\n</body></html>\n",
    )


def _table(table: PageTable) -> str:
    head = "".join(f"<th>{html.escape(name)}</th>" for name in table.head)
    rows = "".join(
        "<tr>" + "".join(f"<td>{html.escape(entry)}</td>" for entry in row) + "</tr>\n"
        for row in table.rows
    )
    return (
        f"<h2>{html.escape(table.heading)}</h2>\n"
        f'<div class="scroll"><table><tr>{head}</tr>\n{rows}</table></div>'
    )
