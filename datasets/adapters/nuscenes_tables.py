"""Read the rows of nuScenes' JSON tables one by one, because a table may be a gigabyte array.

Rows are flat objects. After a damaged row, reading continues at the next brace.
"""

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final, TypeAlias

from crosscue.replay.errors import LogFormatError
from crosscue.replay.files.bounded import PIECE_BYTES
from crosscue.replay.safe_text import visible

Row: TypeAlias = Mapping[str, Any]

# Max length of a row in characters, which bounds reading ahead; rows have a few hundred.
MAX_ROW_CHARS: Final = 64 * 1024
_BETWEEN: Final = " \t\r\n,[]\ufeff"


class RowsOf:
    """The rows of one table.

    Attributes:
        path: Path of the file.
        damaged: Number of damaged rows so far.
        first_damage: Description of the first damage.
        is_cut: True if the file ends before its array does; known once all rows are read.
    """

    def __init__(self, path: Path) -> None:
        """Prepare to read ``path`` on iteration."""
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
                self._check_between(between + ahead[at:start], passed + at)
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
        self._check_between(between, passed)

    def _check_between(self, text: str, place: int) -> None:
        """Report unexpected text between rows as the remains of a damaged row."""
        rest = text.strip(_BETWEEN)
        if rest:
            self._damage(rest, place)

    def _damage(self, text: str, place: int) -> None:
        self.damaged += 1
        self.first_damage = self.first_damage or f"at character {place}: {visible(text[:60])}"


def _after_row(text: str, start: int) -> int:
    """Return the end of a damaged row: its brace, unless the next row begins before."""
    closing = text.find("}", start + 1)
    opening = text.find("{", start + 1)
    ends = [place for place in (closing + 1, opening) if place > 0]
    return min(ends) if ends else len(text)


def whole_table(path: Path, *needs: str) -> dict[str, Row]:
    """Read all rows of a small table by their token.

    Args:
        path: Path of the table.
        needs: String fields that every row must have in addition to its token.

    Raises:
        LogFormatError: The table is missing, or a row is damaged or lacks a field.
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
    """Return the path of a table after checking that it exists.

    Raises:
        LogFormatError: It does not exist.
    """
    if not path.is_file():
        raise LogFormatError(f"{path}: missing; expected nuScenes' tables in one folder, v1.0-...")
    return path
