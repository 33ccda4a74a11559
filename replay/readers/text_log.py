"""Base reader of text files with one row of numbers per line; a format adds the line parser."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Final, TextIO, TypeAlias

import numpy as np

from crosscue.replay.base import EVERYTHING, Selection
from crosscue.replay.columns import BLOCK_ROWS, Block, Table, Topic
from crosscue.replay.files.closing import Closing
from crosscue.replay.ledger import Ledger

# Maximum length of a line, which bounds memory; a longer line is not a row of numbers.
MAX_LINE: Final = 4096
# Time in nanoseconds on the log's clock, and a number for each column.
Row: TypeAlias = tuple[int, *tuple[float, ...]]


@dataclass(frozen=True, slots=True)
class TextLog(Closing):
    """A log of one topic whose rows are the lines of a text file.

    Attributes:
        path: Path of the file.
        format: Name in the table of formats.
        topic: Name of the topic.
        columns: Names of the columns after the time, each with its unit at the end.
        row_of: Parses a line into a row. A line for which it raises ``ValueError`` is dropped.
            Empty lines are ignored.
    """

    path: Path
    format: str
    topic: str
    columns: Sequence[str]
    row_of: Callable[[str], Row]

    @property
    def topics(self) -> tuple[Topic, ...]:
        """The only topic."""
        return (Topic(self.topic, "crosscue/Table", "columns"),)

    def read(self, ledger: Ledger, selection: Selection = EVERYTHING) -> Iterator[Block]:
        """Yield the rows, one block at a time; see ``Log.read``."""
        ledger.integrity = "not checkable: lines carry no checksum"
        with self.path.open(encoding="utf-8", errors="replace") as file:
            whole = _lines(file)
            while lines := list(islice(whole, BLOCK_ROWS)):
                block = self._block_of(lines, ledger)
                kept = selection.account(self.topic, block.log_ns, ledger)
                if kept is None:
                    yield block
                elif kept.any():
                    yield block.take(kept)

    def _block_of(self, lines: Sequence[str | None], ledger: Ledger) -> Block:
        t_ns: list[np.int64] = []
        values: list[tuple[float, ...]] = []
        for line in lines:
            if line is None:
                ledger.drop(self.topic, "line too long", 1)
                continue
            try:
                time, *row = self.row_of(line)
                if len(row) != len(self.columns):
                    raise ValueError(f"expected {len(self.columns)} numbers, found {len(row)}")
                values.append(tuple(map(float, row)))
                t_ns.append(np.int64(time))
            except (ValueError, OverflowError):
                del values[len(t_ns) :]
                ledger.drop(self.topic, "line not understood", 1, line[:80])
        table = np.array(values, np.float64).reshape(-1, len(self.columns))
        columns = {name: table[:, i].copy() for i, name in enumerate(self.columns)}
        return Block(self.topic, np.array(t_ns, np.int64), Table(columns))


def _lines(file: TextIO) -> Iterator[str | None]:
    """Yield every line that is not empty, with None for lines longer than ``MAX_LINE``."""
    while line := file.readline(MAX_LINE):
        is_cut = len(line) == MAX_LINE and not line.endswith("\n")
        piece = line
        while is_cut and piece and not piece.endswith("\n"):
            piece = file.readline(MAX_LINE)
        if line.strip():
            yield None if is_cut else line
