"""Rows of nuScenes' JSON tables one by one: those of a whole set are gigabytes in one array.

Rows are flat objects. One that is damaged costs itself: reading goes on at the next brace.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final, TypeAlias

from crosscue.replay.base import PIECE_BYTES, LogFormatError, visible

Row: TypeAlias = Mapping[str, Any]

MAX_ROW_CHARS: Final = 64 * 1024
"""So far is read ahead; a row has some hundred characters."""
_BETWEEN: Final = " \t\r\n,[]\ufeff"


class RowsOf:
    """The rows of one table.

    Attributes:
        path: The file.
        damaged: How many rows could not be understood so far.
        first_damage: Where, in words.
        is_cut: Whether the file ends before its array does; known once all rows are read.
    """

    def __init__(self, path: Path) -> None:
        """Read ``path`` when iterated."""
        self.path: Final = path
        self.damaged = 0
        self.first_damage = ""
        self.is_cut = False

    def __iter__(self) -> Iterator[Row]:
        decode = json.JSONDecoder().raw_decode
        ahead, at, is_end = "", 0, False
        passed = 0
        between = ""
        with self.path.open(encoding="utf-8", errors="replace") as file:
            while True:
                while not is_end and len(ahead) - at < MAX_ROW_CHARS:
                    more = file.read(PIECE_BYTES)
                    is_end = not more
                    passed += at
                    ahead, at = ahead[at:] + more, 0
                start = ahead.find("{", at)
                if start < 0:
                    between += ahead[at:]
                    break
                self._see_between(between + ahead[at:start], passed + at)
                between = ""
                try:
                    row, at = decode(ahead, start)
                except (ValueError, RecursionError):
                    self._damage(ahead[start:], passed + start)
                    at = _after_row(ahead, start)
                    continue
                if isinstance(row, dict):
                    yield row
        self.is_cut = "]" not in between
        self._see_between(between, passed)

    def _see_between(self, text: str, place: int) -> None:
        """What stands between rows and belongs to none is what is left of one."""
        rest = text.strip(_BETWEEN)
        if rest:
            self._damage(rest, place)

    def _damage(self, text: str, place: int) -> None:
        self.damaged += 1
        self.first_damage = self.first_damage or f"at character {place}: {visible(text[:60])}"


def _after_row(text: str, start: int) -> int:
    """Where a damaged row ends: at its brace, unless the next row begins before."""
    closing = text.find("}", start + 1)
    opening = text.find("{", start + 1)
    ends = [place for place in (closing + 1, opening) if place > 0]
    return min(ends) if ends else len(text)


def whole_table(path: Path, *needs: str) -> dict[str, Row]:
    """All rows of a small table by their token.

    Args:
        path: The table.
        needs: Texts that every row must have, besides its token.

    Raises:
        LogFormatError: It is not there, or a row, on which others lean, is damaged or lacks a text.
    """
    rows = RowsOf(checked(path))
    found: dict[str, Row] = {}
    for row in rows:
        lacks = [key for key in ("token", *needs) if not isinstance(row.get(key), str)]
        if lacks:
            raise LogFormatError(f"{path}: row {len(found)}: no {lacks[0]}; copy it again")
        found[row["token"]] = row
    if rows.damaged or rows.is_cut or not found:
        what = rows.first_damage or ("cut" if rows.is_cut else "no rows")
        raise LogFormatError(f"{path}: {what}; copy it again")
    return found


def checked(path: Path) -> Path:
    """The path of a table that is there.

    Raises:
        LogFormatError: It is not.
    """
    if not path.is_file():
        raise LogFormatError(f"{path}: not there; nuScenes' tables lie in one folder, v1.0-...")
    return path
