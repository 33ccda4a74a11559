"""Reading of the rows of a ROS 2 SQLite bag through SQLite, with damaged pages skipped."""

from __future__ import annotations

from array import array
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from operator import itemgetter
from typing import Any, Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.columns import BLOCK_BYTES, BLOCK_ROWS, Int64s

from .sqlite import FAULTS, Database
from .tables import fetched

FIRST_ROWID: Final = -(2**63)
LAST_ROWID: Final = 2**63 - 1
_FIRST_FETCH: Final = 8
_LARGEST_FETCH: Final = 512
_PART_BYTES: Final = 512 << 10
_ROWID: Final = itemgetter(0)


@dataclass(frozen=True, slots=True, eq=False)
class RowColumns:
    """Columns of N rows with correct types, and the rows with other types.

    Attributes:
        ids: Shape (N,), int64: row ids.
        topics: Shape (N,), int64: topic numbers.
        times: Shape (N,), int64: timestamps.
        length: Shape (N,), int64: size of each payload in bytes.
        payloads: All payloads, concatenated.
        odd: Rows with other types.
    """

    ids: Int64s
    topics: Int64s
    times: Int64s
    length: Int64s
    payloads: bytes
    odd: tuple[Row, ...] = ()

    def __len__(self) -> int:
        return len(self.ids) + len(self.odd)


# Row id, topic id, timestamp and payload; a file may have any type in the last three.
Row: TypeAlias = tuple[int, Any, Any, Any]


@dataclass(slots=True)
class RowScan:
    """One pass over the rows from ``first`` to ``last``, both inclusive.

    Attributes:
        database: The database.
        first: First row id.
        last: Last row id.
        topics: Numbers of the topics whose payloads are read, or None for all; other payloads are
            empty.
        holes: Descriptions of the unreadable rows.
        disordered: Number of rows omitted because their ids do not ascend: a repeated page, or a
            changed id.
    """

    database: Database
    first: int
    last: int
    topics: frozenset[int] | None = None
    holes: list[str] = field(default_factory=list)
    disordered: int = 0
    _highest: int = FIRST_ROWID

    def batches(self) -> Iterator[RowColumns]:
        """Yield rows in the order of their ids; after damage, resume at the next readable row."""
        at, is_careful = self.first, False
        while at <= self.last:
            try:
                for rows in self._blocks(at, is_careful):
                    at = max(at, self._highest + 1)
                    yield rows
                return
            except FAULTS as error:
                if not is_careful:
                    at, is_careful = max(at, self._highest + 1), True
                    continue
                at = max(at, self._highest + 1)
                onward = self._reachable(at)
                where = f"row {at} on" if onward is None else f"row {at} to row {onward - 1}"
                self.holes.append(f"from {where}: {error}")
                if onward is None:
                    return
                at, is_careful = onward, False

    def _blocks(self, at: int, is_careful: bool) -> Iterator[RowColumns]:
        """Yield rows from ``at`` on; rows read before an error are yielded before it is raised."""
        parts: list[RowColumns] = []
        size = count = 0
        try:
            for part in self._fetches(at, is_careful):
                if parts and size + len(part.payloads) > BLOCK_BYTES:
                    yield _joined(parts)
                    parts, size, count = [], 0, 0
                parts.append(part)
                size, count = size + len(part.payloads), count + len(part)
                if size >= BLOCK_BYTES or count >= BLOCK_ROWS:
                    yield _joined(parts)
                    parts, size, count = [], 0, 0
        except FAULTS:
            if parts:
                yield _joined(parts)
            raise
        if parts:
            yield _joined(parts)

    def _fetches(self, at: int, is_careful: bool) -> Iterator[RowColumns]:
        """Yield few rows at a time, so that they are copied from the processor's cache."""
        cursor = self.database.connection.execute(self._query(), (at, self.last))
        largest, room = 1, 1 if is_careful else _FIRST_FETCH
        while rows := cursor.fetchmany(room):
            part = self._columns(rows)
            if len(part):
                yield part
            if not is_careful:
                largest = max(largest, int(part.length.max(initial=0)))
                mean = max(len(part.payloads) // max(len(part), 1), 1)
                # Fewer rows if the previous ones were large.
                room = max(1, min(_LARGEST_FETCH, _PART_BYTES // mean, BLOCK_BYTES // largest))

    def _columns(self, rows: list[Row]) -> RowColumns:
        """Return the columns of the rows with ascending ids."""
        try:
            columns = _columns_of(rows)
        except (TypeError, OverflowError):
            columns = _columns_with_odd(rows)
        number = columns.ids
        if not columns.odd and number[0] > self._highest and bool((number[1:] > number[:-1]).all()):
            self._highest = int(number[-1])
            return columns
        kept = self._ascending(rows)
        return columns if len(kept) == len(rows) else _columns_with_odd(kept)

    def _query(self) -> str:
        payload = "data"
        if self.topics is not None:
            wanted = ", ".join(map(str, sorted(self.topics)))
            payload = f"CASE WHEN topic_id IN ({wanted}) THEN data ELSE x'' END"
        return (
            f"SELECT rowid, topic_id, timestamp, {payload} FROM messages "  # noqa: S608
            "WHERE rowid >= ? AND rowid <= ? ORDER BY rowid"
        )

    def _ascending(self, rows: list[Row]) -> list[Row]:
        """Return the rows with ascending ids."""
        number = np.fromiter(map(_ROWID, rows), dtype=np.int64, count=len(rows))
        if number[0] > self._highest and (np.diff(number) > 0).all():
            self._highest = int(number[-1])
            return rows
        keep = _rising(number, self._highest)
        self._highest = max(self._highest, *number[keep].tolist()) if keep.any() else self._highest
        self.disordered += int((~keep).sum())
        return [row for row, is_kept in zip(rows, keep, strict=True) if is_kept]

    def _reachable(self, after: int) -> int | None:
        """Return the first row id after ``after`` from which SQLite can read again."""
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
        """Return the first row id at or after ``at``; above all ids at the end; None on damage."""
        query = "SELECT rowid, data FROM messages WHERE rowid >= ? ORDER BY rowid LIMIT 1"
        try:
            rows = fetched(self.database, query, (at,))
        except FAULTS:
            return None
        return max(at, int(rows[0][0])) if rows else LAST_ROWID + 1


def _columns_of(rows: Sequence[Row]) -> RowColumns:
    """Convert rows to columns.

    Raises:
        TypeError: A value has a wrong type.
        OverflowError: A number of more than 64 bits.
    """
    ids, topics, times, payloads = zip(*rows, strict=True)
    # Unlike NumPy, ``array`` does not accept a float as an integer.
    return RowColumns(
        np.frombuffer(array("q", ids), np.int64),
        np.frombuffer(array("q", topics), np.int64),
        np.frombuffer(array("q", times), np.int64),
        np.fromiter(map(len, payloads), np.int64, len(rows)),
        b"".join(payloads),
    )


def _columns_with_odd(rows: Sequence[Row]) -> RowColumns:
    """Convert the rows with correct types to columns, and keep the others."""
    sound = [row for row in rows if _is_sound(row)]
    odd = tuple(row for row in rows if not _is_sound(row))
    if not sound:
        none = np.empty(0, np.int64)
        return RowColumns(none, none, none, none, b"", odd)
    return replace(_columns_of(sound), odd=odd)


def _is_sound(row: Row) -> bool:
    _, topic, time, payload = row
    return type(topic) is int and type(time) is int and type(payload) is bytes


def _joined(parts: Sequence[RowColumns]) -> RowColumns:
    if len(parts) == 1:
        return parts[0]
    return RowColumns(
        np.concatenate([part.ids for part in parts]),
        np.concatenate([part.topics for part in parts]),
        np.concatenate([part.times for part in parts]),
        np.concatenate([part.length for part in parts]),
        b"".join([part.payloads for part in parts]),
        tuple(row for part in parts for row in part.odd),
    )


def _rising(number: Int64s, highest: int) -> NDArray[np.bool_]:
    """Return a mask of the ids above all earlier ids, ignoring a single outlier."""
    before = np.concatenate(([highest], number[:-1]))
    after = np.concatenate((number[1:], [LAST_ROWID]))
    keep = ~((number > after) & (before < after))
    reached = np.maximum.accumulate(np.where(keep, number, highest))
    rising: NDArray[np.bool_] = keep & (number > np.concatenate(([highest], reached[:-1])))
    return rising


def index_times(database: Database, index: str) -> tuple[Int64s, Int64s] | None:
    """Return the sorted row ids and timestamps of the time index; None if it is damaged."""
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
