"""Rows of a ROS 2 SQLite bag, in lists of bounded size, around damaged pages."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from operator import itemgetter
from typing import Any, Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.columns import BLOCK_BYTES, BLOCK_ROWS, Int64s

from .rosbag2_sqlite import FAULTS, Database
from .rosbag2_tables import fetched

FIRST_ROWID: Final = -(2**63)
LAST_ROWID: Final = 2**63 - 1
_FIRST_FETCH: Final = 8
_LARGEST_FETCH: Final = 256
_ROWID: Final = itemgetter(0)

Row: TypeAlias = tuple[int, Any, Any, Any]
"""Row id, topic id, timestamp and payload; a file may hold any type in the last three."""


@dataclass(slots=True)
class RowScan:
    """One pass over the rows from ``first`` to ``last``, both included.

    Attributes:
        database: Where from.
        first: First row id.
        last: Last row id.
        holes: Which rows could not be read, in words.
        disordered: Rows left out because their id does not ascend: a page met twice, or an id
            changed.
    """

    database: Database
    first: int
    last: int
    holes: list[str] = field(default_factory=list)
    disordered: int = 0
    _highest: int = FIRST_ROWID

    def batches(self) -> Iterator[list[Row]]:
        """Rows in the order of their ids; on damage, on from the next row that can be reached."""
        at, is_careful = self.first, False
        while at <= self.last:
            try:
                for rows in self._fetches(at, is_careful):
                    kept = self._ascending(rows)
                    at = max(at, self._highest + 1) if kept else at
                    if kept:
                        yield kept
                return
            except FAULTS as error:
                if not is_careful:
                    is_careful = True
                    continue
                onward = self._reachable(at)
                where = f"row {at} on" if onward is None else f"row {at} to row {onward - 1}"
                self.holes.append(f"from {where}: {error}")
                if onward is None:
                    return
                at, is_careful = onward, False

    def _fetches(self, at: int, is_careful: bool) -> Iterator[list[Row]]:
        """Rows from ``at`` on; what was fetched before an error is given before it is raised."""
        cursor = self.database.connection.execute(
            "SELECT rowid, topic_id, timestamp, data FROM messages "
            "WHERE rowid >= ? AND rowid <= ? ORDER BY rowid",
            (at, self.last),
        )
        rows: list[Row] = []
        size, largest, room = 0, 1, 1 if is_careful else _FIRST_FETCH
        while True:
            try:
                part = cursor.fetchmany(room)
            except FAULTS:
                if rows:
                    yield rows
                raise
            rows += part
            sizes = [len(row[3]) for row in part if row[3].__class__ is bytes]
            size += sum(sizes)
            largest = max(largest, max(sizes, default=0))
            if rows and (not part or size >= BLOCK_BYTES or len(rows) >= BLOCK_ROWS):
                yield rows
                rows, size = [], 0
            if not part:
                return
            if not is_careful:
                room = max(1, min(_LARGEST_FETCH, (BLOCK_BYTES - size) // largest))

    def _ascending(self, rows: list[Row]) -> list[Row]:
        """Rows whose ids go up."""
        number = np.fromiter(map(_ROWID, rows), dtype=np.int64, count=len(rows))
        if number[0] > self._highest and (np.diff(number) > 0).all():
            self._highest = int(number[-1])
            return rows
        keep = _rising(number, self._highest)
        self._highest = max(self._highest, *number[keep].tolist()) if keep.any() else self._highest
        self.disordered += int((~keep).sum())
        return [row for row, is_kept in zip(rows, keep, strict=True) if is_kept]

    def _reachable(self, after: int) -> int | None:
        """The first row id beyond ``after`` from which SQLite can read again."""
        step, failing = 1, after
        while (found := self._probe(min(after + step, self.last))) is None:
            failing = min(after + step, self.last)
            if failing >= self.last:
                return None
            step *= 2
        low, high = failing, min(after + step, self.last)
        while high - low > 1:
            middle = (low + high) // 2
            reached = self._probe(middle)
            if reached is None:
                low = middle
            else:
                high, found = middle, reached
        return found if after < found <= self.last else None

    def _probe(self, at: int) -> int | None:
        """The id of the first row at or after ``at``, past all ids at the end, None on damage."""
        query = "SELECT rowid, data FROM messages WHERE rowid >= ? ORDER BY rowid LIMIT 1"
        try:
            rows = fetched(self.database, query, (at,))
        except FAULTS:
            return None
        return max(at, int(rows[0][0])) if rows else LAST_ROWID + 1


def _rising(number: Int64s, highest: int) -> NDArray[np.bool_]:
    """Which ids rise above all before them, a single outlier left aside."""
    before = np.concatenate(([highest], number[:-1]))
    after = np.concatenate((number[1:], [LAST_ROWID]))
    keep = ~((number > after) & (before < after))
    reached = np.maximum.accumulate(np.where(keep, number, highest))
    rising: NDArray[np.bool_] = keep & (number > np.concatenate(([highest], reached[:-1])))
    return rising


def index_times(database: Database, index: str) -> tuple[Int64s, Int64s] | None:
    """Row ids, sorted, and timestamps as the time index has them; None if it is damaged."""
    query = f"SELECT rowid, timestamp FROM messages INDEXED BY {index} ORDER BY timestamp"  # noqa: S608
    parts: list[NDArray[np.int64]] = []
    try:
        cursor = database.connection.execute(query)
        while rows := cursor.fetchmany(BLOCK_ROWS):
            plain = [row for row in rows if isinstance(row[1], int)]
            parts.append(np.array(plain, dtype=np.int64).reshape(-1, 2))
    except FAULTS:
        return None
    table = np.concatenate(parts) if parts else np.empty((0, 2), dtype=np.int64)
    table = table[np.argsort(table[:, 0], kind="stable")]
    return table[:, 0], table[:, 1]
