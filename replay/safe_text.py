"""Tables and lines for a terminal, safe against control characters in a log's names."""

import shutil
import unicodedata
from collections.abc import Iterator, Sequence
from typing import Final

# Unicode categories that are invisible, reorder text, or drive a terminal.
_HARMFUL: Final = frozenset({"Cc", "Cf", "Cs", "Co", "Cn", "Zl", "Zp"})
_NARROWEST: Final = 8
_CUT: Final = "~"


def visible(text: str) -> str:
    """Escape control characters, reordering marks and undecodable bytes in ``text``."""
    if text.isascii() and text.isprintable():
        return text
    return "".join(
        c.encode("unicode_escape").decode() if unicodedata.category(c) in _HARMFUL else c
        for c in text
    )


def counted(count: int, noun: str, plural: str = "") -> str:
    """Return a number with its noun: ``1 drive``, ``2 drives``."""
    return f"{count:,} {noun if count == 1 else plural or noun + 's'}"


def terminal_cells(text: str) -> int:
    """Return the number of terminal columns that ``text`` occupies."""
    if text.isascii():
        return len(text)
    return sum(
        0 if unicodedata.combining(c) else 2 if unicodedata.east_asian_width(c) in "WF" else 1
        for c in text
    )


def terminal_width() -> int:
    """Return the terminal's width in columns, or that of ``COLUMNS``, else 100; at least 40."""
    return max(shutil.get_terminal_size(fallback=(100, 24)).columns, 40)


def table(
    head: Sequence[str], rows: Sequence[Sequence[str]], width: int, text_columns: Sequence[int]
) -> Iterator[str]:
    """Yield the lines of a table, no wider than ``width`` unless its numbers need more.

    Args:
        head: Column names.
        rows: Cells; harmful characters are escaped here.
        width: Width of the terminal in columns.
        text_columns: Indices of the text columns. They are left-aligned, and shortened in the
            middle if the table is too wide. The other columns are right-aligned and never
            shortened.
    """
    shown = [[visible(cell) for cell in row] for row in [head, *rows]]
    widths = [max(terminal_cells(row[i]) for row in shown) for i in range(len(head))]
    over = sum(widths) + 2 * (len(widths) - 1) - width
    while over > 0:
        widest = max(text_columns, key=lambda i: widths[i])
        if widths[widest] <= _NARROWEST:
            break
        widths[widest] -= 1
        over -= 1
    for row in shown:
        padded = [_fitted(cell, widths[i], left=i in text_columns) for i, cell in enumerate(row)]
        yield "  ".join(padded).rstrip()


def wrapped(sentence: str, width: int, lead: str = "- ") -> str:
    """Wrap a bullet point over several lines; words longer than a line are split."""
    room = width - terminal_cells(lead)
    lines = [""]
    for word in visible(sentence).split():
        joined = f"{lines[-1]} {word}" if lines[-1] else word
        if terminal_cells(joined) <= room:
            lines[-1] = joined
            continue
        rest = word
        while rest:
            part = _first(rest, room)
            lines.append(part)
            rest = rest[len(part) :]
    filled = [line for line in lines if line]
    indents = [lead, *[" " * terminal_cells(lead)] * len(filled)]
    return "\n".join(indent + line for indent, line in zip(indents, filled, strict=False))


def _fitted(cell: str, width: int, *, left: bool) -> str:
    if terminal_cells(cell) > width:
        # Names of topics differ more often at the end, so two thirds of the width go there.
        head = max((width - 1) // 3, 1)
        cell = _first(cell, head) + _CUT + _first(cell[::-1], width - 1 - head)[::-1]
    room = " " * (width - terminal_cells(cell))
    return cell + room if left else room + cell


def _first(text: str, width: int) -> str:
    taken = ""
    for c in text:
        if terminal_cells(taken) + terminal_cells(c) > width:
            break
        taken += c
    return taken
