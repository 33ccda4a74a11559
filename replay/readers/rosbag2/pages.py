"""Direct reading of rows from the pages of an undamaged ROS 2 SQLite bag.

The standard library creates four Python objects per row. But a recorder's file has a simple
structure: one table of four columns, rows in the order of their ids, and large payloads that
continue in chains of pages. This module reads only files of this structure, several hundred pages
at a time, after SQLite has found no damage. At the first exception (a value of another type, an
unexpected page) it stops, and the remaining rows are read through SQLite. Sections 1.5, 1.6 and 2.1
of SQLite's file format description define the layout.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass, fields
from itertools import pairwise
from typing import BinaryIO, Final

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.columns import BLOCK_BYTES, Bytes, Int64s, Messages
from crosscue.replay.limits import MIB, Limits

from .sqlite import FAULTS, Database
from .tables import fetched

# Name, type, position in the primary key and kind of each column of the messages table.
_COLUMNS: Final = (
    ("id", "INTEGER", 1, 0),
    ("topic_id", "INTEGER", 0, 0),
    ("timestamp", "INTEGER", 0, 0),
    ("data", "BLOB", 0, 0),
)
_INTERIOR: Final = 5
_LEAF: Final = 13
_LEAF_HEAD: Final = 8
_INTERIOR_HEAD: Final = 12
_DEEPEST: Final = 20
_LOT_BYTES: Final = BLOCK_BYTES // 2
_CHAIN_BYTES: Final = 1 << 20
# Half of the parts that a system call accepts.
_CHAIN_PAGES: Final = 512
# Number of zeros after the last page, so that a cell that exceeds its page can be examined.
_PADDING: Final = 256
_VARINT_BYTES: Final = 9
# Size of an integer in bytes by its serial type; -1 if the type is not an integer.
_INTEGER_BYTES: Final = np.array([-1, 1, 2, 3, 4, 6, 8, -1, 0, 0] + [-1] * 246, np.int64)
# Serial type of the integer 1, which is stored in zero bytes.
_ONE: Final = 9
_FIRST_BLOB: Final = 12


class _UnusualError(Exception):
    """An unusual structure, which must be read through SQLite."""


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
class _Cells:
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

    def span(self, first: int, stop: int) -> _Cells:
        """Return the rows ``first`` to ``stop``."""
        columns = (getattr(self, column.name) for column in fields(self))
        return _Cells(*(column[first:stop] for column in columns))


def page_rows(
    database: Database, topics: frozenset[int] | None, limits: Limits
) -> Iterator[PageRows]:
    """Yield rows in the order of their ids, up to the first unusual structure.

    A statement must be open meanwhile, because its lock prevents a recorder from writing.

    Args:
        database: A database in which SQLite found no damage.
        topics: Numbers of the topics whose payloads are read, or None for all.
        limits: Longer rows are left to SQLite.
    """
    if database.plain is None:
        return
    try:
        root = _root(database)
        with database.plain.open("rb", buffering=0) as file:
            yield from _Pages(file, root, topics, limits).rows()
    except (_UnusualError, OSError):
        return


def _root(database: Database) -> int:
    """Return the number of the first page of the messages table.

    Raises:
        _UnusualError: The table does not have the columns that recorders create.
    """
    try:
        columns = fetched(database, "PRAGMA table_xinfo(messages)")
        found = fetched(database, "SELECT rootpage FROM sqlite_master WHERE name = 'messages'")
    except FAULTS:
        raise _UnusualError from None
    if tuple((name, kind, key, hidden) for _, name, kind, _, _, key, hidden in columns) != _COLUMNS:
        raise _UnusualError
    return int(found[0][0])


class _Pages:
    """The pages of an open file."""

    def __init__(
        self, file: BinaryIO, root: int, topics: frozenset[int] | None, limits: Limits
    ) -> None:
        self._file = file.fileno()
        self._root = root
        self._topics = None if topics is None else np.array(sorted(topics), np.int64)
        self._longest = limits.message_bytes + MIB
        head = os.pread(self._file, 100, 0)
        if len(head) < 100:
            raise _UnusualError
        size = int.from_bytes(head[16:18], "big")
        self._size = 65536 if size == 1 else size
        self._usable = self._size - head[20]
        if self._size < 512 or self._usable < 480:
            raise _UnusualError
        self._count = os.fstat(self._file).st_size // self._size
        self._reserved, self._room = head[20], self._usable - 4
        self._run = min(_CHAIN_PAGES, max(1, _CHAIN_BYTES // self._size))
        aside = np.empty((self._run, head[20] + 4), np.uint8)
        self._asides = [row.data for row in aside for _ in range(2)]
        self._after = aside[:, -4:].view(">u4")[:, 0]
        self._left = 3 * self._count
        self._highest = -(2**63)

    def rows(self) -> Iterator[PageRows]:
        """Yield all rows.

        Raises:
            _UnusualError: The following rows must be read through SQLite.
            OSError: The file cannot be read.
        """
        for leaves in self._leaves(self._root, 0):
            many = max(1, _LOT_BYTES // self._size)
            for first in range(0, len(leaves), many):
                yield from self._lot(leaves[first : first + many])

    def _leaves(self, page: int, depth: int) -> Iterator[Int64s]:
        """Yield the numbers of the leaf pages below ``page``, in the order of their rows."""
        content = self._page(page)
        if content[0] == _LEAF:
            yield np.array([page])
            return
        children = self._children(content)
        if self._page(int(children[0]))[0] == _LEAF:
            yield children
            return
        if depth == _DEEPEST:
            raise _UnusualError
        for child in children.tolist():
            yield from self._leaves(child, depth + 1)

    def _page(self, page: int) -> Bytes:
        self._left -= 1
        if not 1 < page <= self._count or self._left < 0:
            raise _UnusualError
        content = os.pread(self._file, self._size, (page - 1) * self._size)
        if len(content) < self._size:
            raise _UnusualError
        return np.frombuffer(content, np.uint8)

    def _children(self, content: Bytes) -> Int64s:
        count = int(content[3]) << 8 | int(content[4])
        if content[0] != _INTERIOR or _INTERIOR_HEAD + 2 * count > self._usable:
            raise _UnusualError
        cells = content[_INTERIOR_HEAD : _INTERIOR_HEAD + 2 * count].view(">u2")
        if count and int(cells.max()) + 4 > self._usable:
            raise _UnusualError
        numbers = _shifted(content, ">u4")[cells].astype(np.int64)
        return np.append(numbers, int.from_bytes(content[8:12].tobytes(), "big"))

    def _lot(self, leaves: Int64s) -> Iterator[PageRows]:
        buffer = self._read(leaves)
        cells, is_plain = self._cells(buffer, len(leaves))
        kept = self._ascending(cells)
        is_plain &= kept == len(cells.ids)
        cells = cells.span(0, kept)
        if kept:
            self._highest = int(cells.ids[-1])
            yield from self._whole(buffer, cells)
        if not is_plain:
            raise _UnusualError

    def _read(self, leaves: Int64s) -> Bytes:
        """Read the pages into one buffer, followed by the padding."""
        if leaves.min() <= 1 or leaves.max() > self._count:
            raise _UnusualError
        buffer = np.empty(len(leaves) * self._size + _PADDING, np.uint8)
        buffer[-_PADDING:] = 0
        edges = [0, *(np.flatnonzero(np.diff(leaves) != 1) + 1).tolist(), len(leaves)]
        for first, stop in pairwise(edges):
            target = buffer[first * self._size : stop * self._size]
            self._fill([target.data], (int(leaves[first]) - 1) * self._size, len(target))
        return buffer

    def _fill(self, parts: list[memoryview], at: int, size: int) -> None:
        if os.preadv(self._file, parts, at) < size:
            raise _UnusualError

    def _cells(self, buffer: Bytes, pages: int) -> tuple[_Cells, bool]:
        """Return the rows up to the first unusual one, and whether these are all."""
        size, usable = self._size, self._usable
        shorts, words = _shifted(buffer, ">u2"), _shifted(buffer, ">i8")
        base = np.arange(pages) * size
        count = shorts[base + 3].astype(np.int64)
        is_leaf = (buffer[base] == _LEAF) & (_LEAF_HEAD + 2 * count <= usable)
        count[~is_leaf] = 0
        whole = int(count[: _first(~is_leaf)].sum())
        page = np.repeat(np.arange(pages), count)[:whole]
        within = np.arange(whole) - (np.cumsum(count) - count)[page]
        place = shorts[base[page] + _LEAF_HEAD + 2 * within].astype(np.int64)
        plain = (place >= _LEAF_HEAD + 2 * count[page]) & (place < usable)
        place[~plain] = 0
        at = base[page] + place
        total, head = _varint(buffer, at)
        ids, head = _varint(buffer, head)
        plain &= (total >= 0) & (total <= self._longest)
        total[~plain] = 0
        local = self._local(total)
        plain &= place + (head - at) + local + 4 * (local < total) <= usable
        serial, body = _varint(buffer, head + 4)
        topic_bytes, time_bytes = _INTEGER_BYTES[buffer[head + 2]], _INTEGER_BYTES[buffer[head + 3]]
        plain &= (buffer[head] == body - head) & (buffer[head + 1] == 0)
        plain &= (topic_bytes >= 0) & (time_bytes >= 0)
        topics = _integers(words, body + topic_bytes, topic_bytes, buffer[head + 2])
        start = body + topic_bytes + time_bytes
        times = _integers(words, start, time_bytes, buffer[head + 3])
        length = (serial - _FIRST_BLOB) >> 1
        own = local - (start - head)
        is_blob = (serial >= _FIRST_BLOB) & (serial & 1 == 0) & (start - head + length == total)
        plain &= own >= 0
        if self._topics is not None:
            wanted = np.isin(topics, self._topics)
            is_blob |= ~wanted
            length, own = length * wanted, own * wanted
        plain &= is_blob
        upto = _first(~plain)
        cells = _Cells(page, ids, topics, times, start, length, own)
        return cells.span(0, upto), upto == whole and bool(is_leaf.all())

    def _local(self, total: Int64s) -> Int64s:
        """Return the number of bytes of each row in its leaf page."""
        usable = self._usable
        min_local = (usable - 12) * 32 // 255 - 23
        part = min_local + (total - min_local) % (usable - 4)
        return np.where(total <= usable - 35, total, np.where(part <= usable - 35, part, min_local))

    def _ascending(self, cells: _Cells) -> int:
        """Return the number of leading rows with ascending ids, relative to earlier rows too."""
        before = np.concatenate(([self._highest], cells.ids[:-1]))
        return _first(~(cells.ids > before)) if len(cells.ids) else 0

    def _whole(self, buffer: Bytes, cells: _Cells) -> Iterator[PageRows]:
        """Yield rows with their complete payloads, in parts of limited size."""
        far = np.where(cells.local < cells.length, cells.length, 0)
        sums = np.cumsum(far)
        first = done = 0
        while first < len(far):
            stop = max(first + 1, int(np.searchsorted(sums, done + _LOT_BYTES, side="right")))
            yield self._part(buffer, cells.span(first, stop), far[first:stop])
            first, done = stop, int(sums[stop - 1])

    def _part(self, buffer: Bytes, cells: _Cells, far: Int64s) -> PageRows:
        start = cells.start
        if far.any():
            begin, end = int(cells.page[0]) * self._size, (int(cells.page[-1]) + 1) * self._size
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
            count = min(left, self._run, self._count + 1 - page)
            if page <= 1 or count < 1:
                raise _UnusualError
            # Without a copy: each page's payload goes to its place, the next page's number aside.
            stop = min(done + count * self._room, len(target))
            parts = self._asides[: 2 * count]
            parts[1::2] = [data[at : at + room] for at in range(done, stop, room)]
            size = stop - done + count * (self._size - self._room)
            self._fill(parts, (page - 1) * self._size - self._reserved, size)
            after = self._after[:count]
            good = min(count, _first(after != np.arange(page + 1, page + count + 1)) + 1)
            done = min(done + good * self._room, stop)
            page = int(after[good - 1])
            self._run = min(len(self._after), 2 * self._run) if good == count else good
        if page:
            raise _UnusualError


def _shifted(buffer: Bytes, kind: str) -> NDArray[np.integer]:
    """Return a view of the numbers that start at each byte."""
    width = np.dtype(kind).itemsize
    return np.ndarray((len(buffer) - width + 1,), kind, buffer, 0, (1,))


def _first(marked: NDArray[np.bool_]) -> int:
    """Return the index of the first True, or the length if all are False."""
    return int(marked.argmax()) if np.count_nonzero(marked) else len(marked)


def _varint(buffer: Bytes, at: Int64s) -> tuple[Int64s, Int64s]:
    """Parse SQLite's variable-length integers, and return them and their ends."""
    byte = buffer[at]
    value, at = (byte & 0x7F).astype(np.int64), at + 1
    more = byte >= 0x80
    for i in range(1, _VARINT_BYTES):
        if not more.any():
            break
        byte = buffer[at]
        bits, mask = (7, 0x7F) if i < _VARINT_BYTES - 1 else (8, 0xFF)
        value = np.where(more, value << bits | byte & mask, value)
        at += more
        more &= byte >= 0x80
    return value, at


def _integers(
    words: NDArray[np.integer], end: Int64s, size: Int64s, serial: NDArray[np.uint8]
) -> Int64s:
    """Parse signed integers of up to eight bytes that end at ``end``."""
    if np.minimum.reduce(size, initial=8) == 8:
        return words[end - 8].astype(np.int64)
    shift = 8 * (8 - np.clip(size, 1, 8))
    value = words[np.maximum(end - 8, 0)].astype(np.int64)
    value = (value << shift) >> shift
    return np.where(size > 0, value, serial == _ONE)
