"""Direct reading of rows from the pages of an undamaged ROS 2 SQLite bag.

The standard library creates four Python objects per row. But a recorder's file has a simple
structure: one table of four columns, rows in the order of their ids, and large payloads that
continue in chains of pages. This module reads only files of this structure, several hundred pages
at a time, after no damage was found. At the first exception (a value of another type, an unexpected
page) it stops, and the remaining rows are read through SQLite.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, fields
from typing import Final

import numpy as np

from crosscue.replay.columns import Bytes, Int64s, Messages
from crosscue.replay.limits import Limits

from .page_file import (
    INTEGER_BYTES,
    LOT_BYTES,
    TABLE_LEAF,
    Lot,
    PageFile,
    Soundness,
    UnusualError,
    first_true,
    integers,
    shifted,
    varint,
)
from .sqlite import FAULTS, Database
from .tables import fetched

# Name, type, position in the primary key and kind of each column of the messages table.
_COLUMNS: Final = (
    ("id", "INTEGER", 1, 0),
    ("topic_id", "INTEGER", 0, 0),
    ("timestamp", "INTEGER", 0, 0),
    ("data", "BLOB", 0, 0),
)
_CHAIN_BYTES: Final = 1 << 20
# Half of the parts that a system call accepts.
_CHAIN_PAGES: Final = 512
_FIRST_BLOB: Final = 12


@dataclass(frozen=True, slots=True, eq=False)
class PageRows:
    """N rows with ascending ids.

    Attributes:
        ids: Shape (N,), int64: row ids.
        topics: Shape (N,), int64: topic numbers.
        times: Shape (N,), int64: timestamps.
        messages: N payloads; empty for unselected topics.
    """

    ids: Int64s
    topics: Int64s
    times: Int64s
    messages: Messages

    def __len__(self) -> int:
        return len(self.ids)


@dataclass(frozen=True, slots=True, eq=False)
class LeafRows:
    """Rows of a batch of leaf pages, as positions in its buffer.

    Attributes:
        page: Shape (N,), int64: index of the page in the batch, ascending.
        ids: Shape (N,), int64: row ids.
        topics: Shape (N,), int64: topic numbers.
        times: Shape (N,), int64: timestamps.
        start: Shape (N,), int64: offset of the payload.
        length: Shape (N,), int64: size of the payload in bytes; 0 for unselected topics.
        local: Shape (N,), int64: number of payload bytes in this page; the others are in a chain
            of pages.
    """

    page: Int64s
    ids: Int64s
    topics: Int64s
    times: Int64s
    start: Int64s
    length: Int64s
    local: Int64s

    def span(self, first: int, stop: int) -> LeafRows:
        """Return the rows ``first`` to ``stop``."""
        columns = (getattr(self, column.name) for column in fields(self))
        return LeafRows(*(column[first:stop] for column in columns))


def page_rows(
    database: Database,
    topics: frozenset[int] | None,
    limits: Limits,
    sound: Soundness | None = None,
) -> Iterator[PageRows]:
    """Yield rows in the order of their ids, up to the first unusual structure.

    A statement must be open meanwhile, because its lock prevents a recorder from writing.

    Args:
        database: A database in which no damage was found.
        topics: Numbers of the topics whose payloads are read, or None for all.
        limits: Longer rows are left to SQLite.
        sound: Result of the check, which is completed meanwhile.
    """
    if database.plain is None:
        return
    try:
        root = _root(database)
        with database.plain.open("rb", buffering=0) as file:
            wanted = None if topics is None else np.array(sorted(topics), np.int64)
            yield from _Pages(PageFile(file, limits), wanted, sound).rows(root)
    except (UnusualError, OSError):
        return


def _root(database: Database) -> int:
    """Return the number of the first page of the messages table.

    Raises:
        UnusualError: The table does not have the columns that recorders create.
    """
    try:
        columns = fetched(database, "PRAGMA table_xinfo(messages)")
        found = fetched(database, "SELECT rootpage FROM sqlite_master WHERE name = 'messages'")
    except FAULTS:
        raise UnusualError from None
    if tuple((name, kind, key, hidden) for _, name, kind, _, _, key, hidden in columns) != _COLUMNS:
        raise UnusualError
    return int(found[0][0])


class _Pages:
    """Reading of the rows of an open file."""

    def __init__(self, file: PageFile, topics: Int64s | None, sound: Soundness | None) -> None:
        self._file = file
        self._topics = topics
        self._sound = sound or Soundness(np.zeros(file.count + 2, np.int64))
        self._reserved, self._room = file.size - file.usable, file.usable - 4
        self._run = min(_CHAIN_PAGES, max(1, _CHAIN_BYTES // file.size))
        aside = np.empty((self._run, self._reserved + 4), np.uint8)
        self._asides = [row.data for row in aside for _ in range(2)]
        self._after = aside[:, -4:].view(">u4")[:, 0]
        self._highest = -(2**63)

    def rows(self, root: int) -> Iterator[PageRows]:
        """Yield all rows.

        Raises:
            UnusualError: The following rows must be read through SQLite.
            OSError: The file cannot be read.
        """
        lots: Iterable[Lot] = self._sound.lots
        if not lots:
            *_, (leaves, _) = self._file.levels(root, TABLE_LEAF)
            lots = self._file.lots(leaves, TABLE_LEAF)
        for lot in lots:
            rows, is_plain = lot_rows(lot, self._topics)
            kept = self._ascending(rows)
            is_plain &= kept == len(rows.ids)
            rows = rows.span(0, kept)
            if kept:
                self._highest = int(rows.ids[-1])
                yield from self._whole(lot.buffer, rows)
            if not is_plain:
                raise UnusualError
        self._sound.is_read = True

    def _ascending(self, cells: LeafRows) -> int:
        """Return the number of leading rows with ascending ids, relative to earlier rows too."""
        before = np.concatenate(([self._highest], cells.ids[:-1]))
        return first_true(~(cells.ids > before)) if len(cells.ids) else 0

    def _whole(self, buffer: Bytes, cells: LeafRows) -> Iterator[PageRows]:
        """Yield rows with their complete payloads, in parts of limited size."""
        far = np.where(cells.local < cells.length, cells.length, 0)
        sums = np.cumsum(far)
        first = done = 0
        while first < len(far):
            stop = max(first + 1, int(np.searchsorted(sums, done + LOT_BYTES, side="right")))
            yield self._part(buffer, cells.span(first, stop), far[first:stop])
            first, done = stop, int(sums[stop - 1])

    def _part(self, buffer: Bytes, cells: LeafRows, far: Int64s) -> PageRows:
        start = cells.start
        if far.any():
            size = self._file.size
            begin, end = int(cells.page[0]) * size, (int(cells.page[-1]) + 1) * size
            near = buffer[begin:end]
            buffer = np.empty(len(near) + int(far.sum()), np.uint8)
            buffer[: len(near)] = near
            start, target = start - begin, len(near)
            source, whole = near.data, buffer.data
            rows = np.flatnonzero(far)
            columns = (rows, start[rows], cells.local[rows], far[rows])
            for i, at, held, length in np.stack(columns, axis=1).tolist():
                whole[target : target + held] = source[at : at + held]
                chain = int.from_bytes(source[at + held : at + held + 4], "big")
                self._follow(chain, buffer[target + held : target + length])
                start[i] = target
                target += length
        messages = Messages(buffer, start, start + cells.length)
        return PageRows(cells.ids, cells.topics, cells.times, messages)

    def _follow(self, page: int, target: Bytes) -> None:
        """Fill ``target`` from a chain of pages, which are mostly consecutive in the file."""
        done, room, data = 0, self._room, target.data
        while done < len(target):
            left = -(-(len(target) - done) // self._room)
            count = min(left, self._run, self._file.count + 1 - page)
            if page <= 1 or count < 1:
                raise UnusualError
            # Without a copy: each page's payload goes to its place, the next page's number aside.
            stop = min(done + count * self._room, len(target))
            parts = self._asides[: 2 * count]
            parts[1::2] = [data[at : at + room] for at in range(done, stop, room)]
            size = stop - done + count * (self._file.size - self._room)
            self._file.fill(parts, (page - 1) * self._file.size - self._reserved, size)
            after = self._after[:count]
            good = min(count, first_true(after != np.arange(page + 1, page + count + 1)) + 1)
            done = min(done + good * self._room, stop)
            self._sound.uses[page] += 1
            self._sound.uses[page + good] -= 1
            page = int(after[good - 1])
            self._run = min(len(self._after), 2 * self._run) if good == count else good
        if page:
            raise UnusualError


def lot_rows(lot: Lot, topics: Int64s | None) -> tuple[LeafRows, bool]:
    """Return the rows of leaf pages up to the first unusual one, and whether these are all."""
    buffer = lot.buffer
    words, head = shifted(buffer, ">i8"), lot.start
    serial, body = varint(buffer, head + 4)
    topic_bytes, time_bytes = INTEGER_BYTES[buffer[head + 2]], INTEGER_BYTES[buffer[head + 3]]
    plain = lot.is_plain & (buffer[head] == body - head) & (buffer[head + 1] == 0)
    plain &= (topic_bytes >= 0) & (time_bytes >= 0)
    numbers = integers(words, body + topic_bytes, topic_bytes, buffer[head + 2])
    start = body + topic_bytes + time_bytes
    times = integers(words, start, time_bytes, buffer[head + 3])
    length = (serial - _FIRST_BLOB) >> 1
    own = lot.local - (start - head)
    is_blob = (serial >= _FIRST_BLOB) & (serial & 1 == 0) & (start - head + length == lot.total)
    plain &= own >= 0
    if topics is not None:
        wanted = np.isin(numbers, topics)
        is_blob |= ~wanted
        length, own = length * wanted, own * wanted
    plain &= is_blob
    upto = first_true(~plain)
    rows = LeafRows(lot.page, lot.ids, numbers, times, start, length, own)
    return rows.span(0, upto), upto == len(plain) and lot.is_whole
