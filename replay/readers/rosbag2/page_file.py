"""B-tree pages of a SQLite file, read directly; sections 1.3, 1.5, 1.6 and 2.1 of its format."""

import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from typing import BinaryIO, Final

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.columns import BLOCK_BYTES, Bytes, Int64s
from crosscue.replay.limits import MIB, Limits

TABLE_LEAF: Final = 13
INDEX_LEAF: Final = 10
# The kind of interior pages is that of their leaves less this.
INTERIOR: Final = 8
LOT_BYTES: Final = BLOCK_BYTES // 2
_DEEPEST: Final = 20
_FILE_HEAD: Final = 100
# Number of zeros after the last page, so that a cell that exceeds its page can be examined.
_PADDING: Final = 256
_VARINT_BYTES: Final = 9
# Size of an integer in bytes by its serial type; -1 if the type is not an integer.
INTEGER_BYTES: Final = np.array([-1, 1, 2, 3, 4, 6, 8, -1, 0, 0] + [-1] * 246, np.int64)
# Serial type of the integer 1, which is stored in zero bytes.
_ONE: Final = 9


class UnusualError(Exception):
    """An unusual structure, which must be left to SQLite."""


@dataclass(frozen=True, slots=True, eq=False)
class Lot:
    """A batch of P pages of one kind with N cells, without those after the first of another kind.

    Attributes:
        buffer: Bytes of the pages.
        base: Shape (P,), int64: position of each page in the buffer.
        head: Shape (P,), int64: position of each page's header.
        count: Shape (P,), int64: number of cells.
        page: Shape (N,), int64: index of the page, ascending.
        at: Shape (N,), int64: position of the cell.
        ids: Shape (N,), int64: row id; 0 in an index.
        start: Shape (N,), int64: position of the record.
        total: Shape (N,), int64: size of the record in bytes.
        local: Shape (N,), int64: number of these bytes in this page. The number of the page with
            the others follows.
        stop: Shape (N,), int64: end of the cell.
        is_plain: Shape (N,), bool: whether the cell lies in its page and has an accepted size.
        is_whole: Whether no page is left out.
    """

    buffer: Bytes
    base: Int64s
    head: Int64s
    count: Int64s
    page: Int64s
    at: Int64s
    ids: Int64s
    start: Int64s
    total: Int64s
    local: Int64s
    stop: Int64s
    is_plain: NDArray[np.bool_]
    is_whole: bool

    def require_plain(self) -> None:
        """Raise ``UnusualError`` if the batch is not as expected."""
        if not (self.is_whole and self.is_plain.all()):
            raise UnusualError


@dataclass(slots=True)
class Soundness:
    """Result of the check, to be completed by those who follow the chains of pages of long rows.

    Attributes:
        uses: Shape (P + 2,), int64: changes of the number of uses from page to page.
        rows: Number of messages.
        lots: Leaf pages of the messages table; empty if they are many.
        is_read: Whether all rows were read, with their chains.
    """

    uses: Int64s
    rows: int = 0
    lots: list[Lot] = field(default_factory=list)
    is_read: bool = False

    def use(self, pages: Int64s) -> None:
        """Count a use of each page."""
        np.add.at(self.uses, pages, 1)
        np.add.at(self.uses, pages + 1, -1)

    @property
    def is_complete(self) -> bool:
        """True if all rows were read and every page is used once."""
        return self.is_read and bool((np.cumsum(self.uses)[1:-1] == 1).all())


class PageFile:
    """The pages of an open file.

    Attributes:
        head: The first 100 bytes.
        size: Bytes of a page.
        usable: Bytes of a page without the reserved ones at its end.
        count: Number of pages.
    """

    def __init__(self, file: BinaryIO, limits: Limits) -> None:
        """Read the file's header.

        Raises:
            UnusualError: A page has an unusual size.
        """
        self._file = file.fileno()
        self.head: Final = os.pread(self._file, _FILE_HEAD, 0)
        if len(self.head) < _FILE_HEAD:
            raise UnusualError
        size = int.from_bytes(self.head[16:18], "big")
        self.size: Final = 65536 if size == 1 else size
        self.usable: Final = self.size - self.head[20]
        if self.size < 512 or self.usable < 480:
            raise UnusualError
        self.count: Final = os.fstat(self._file).st_size // self.size
        self._longest = limits.message_bytes + MIB

    def levels(self, root: int, leaf: int) -> Iterator[tuple[Int64s, int]]:
        """Yield the page numbers of each level of a tree, and their kind.

        Raises:
            UnusualError: The tree has an unusual structure.
            OSError: The file cannot be read.
        """
        pages = np.array([root])
        for _ in range(_DEEPEST):
            page = self.page(int(pages[0]))
            kind = int(page[_FILE_HEAD if pages[0] == 1 else 0])
            yield pages, kind
            if kind == leaf:
                return
            lots = self.lots(pages, leaf - INTERIOR)
            pages = np.concatenate([_children(lot) for lot in lots])
            if len(pages) > self.count:
                break
        raise UnusualError

    def lots(self, pages: Int64s, kind: int) -> Iterator[Lot]:
        """Yield pages of one kind in batches of limited size."""
        many = max(1, LOT_BYTES // self.size)
        for first in range(0, len(pages), many):
            yield self._lot(pages[first : first + many], kind)

    def page(self, number: int) -> Bytes:
        """Return the bytes of a page."""
        return self._read(np.array([number]))[: self.size]

    def fill(self, parts: list[memoryview], at: int, size: int) -> None:
        """Read ``size`` bytes from ``at`` on into the parts."""
        if os.preadv(self._file, parts, at) < size:
            raise UnusualError

    def _read(self, pages: Int64s) -> Bytes:
        """Read the pages into one buffer, followed by the padding."""
        if pages.min() < 1 or pages.max() > self.count:
            raise UnusualError
        buffer = np.empty(len(pages) * self.size + _PADDING, np.uint8)
        buffer[-_PADDING:] = 0
        edges = [0, *(np.flatnonzero(np.diff(pages) != 1) + 1).tolist(), len(pages)]
        for first, stop in pairwise(edges):
            target = buffer[first * self.size : stop * self.size]
            self.fill([target.data], (int(pages[first]) - 1) * self.size, len(target))
        return buffer

    def _lot(self, pages: Int64s, kind: int) -> Lot:
        buffer, usable = self._read(pages), self.usable
        shorts = shifted(buffer, ">u2")
        is_leaf, is_table = kind >= INDEX_LEAF, kind in (TABLE_LEAF, TABLE_LEAF - INTERIOR)
        base = np.arange(len(pages)) * self.size
        head = base + _FILE_HEAD * (pages == 1)
        listed = head + (8 if is_leaf else 12)
        count = shorts[head + 3].astype(np.int64)
        least = listed + 2 * count - base
        good = first_true((buffer[head] != kind) | (least > usable))
        base, head, count = base[:good], head[:good], count[:good]
        page = np.repeat(np.arange(good), count)
        within = np.arange(len(page)) - (np.cumsum(count) - count)[page]
        place = shorts[listed[page] + 2 * within].astype(np.int64)
        plain = (place >= least[page]) & (place < usable)
        place[~plain] = 0
        at = base[page] + place
        start = at if is_leaf else at + 4
        total = ids = local = np.zeros(len(at), np.int64)
        if is_leaf or not is_table:
            total, start = varint(buffer, start)
            # SQLite reads a size of nine bytes differently.
            plain &= (total >= 0) & (total <= self._longest) & (start - at < _VARINT_BYTES)
            total[~plain] = 0
            local = self._local(total, is_table)
        if is_table:
            ids, start = varint(buffer, start)
        stop = np.maximum(start + local + 4 * (local < total), at + 4)
        plain &= place + (stop - at) <= usable
        columns = (base, head, count, page, at, ids, start, total, local, stop, plain)
        return Lot(buffer, *columns, good == len(pages))

    def _local(self, total: Int64s, is_table: bool) -> Int64s:
        """Return the number of bytes of each record in its own page."""
        usable = self.usable
        max_local = usable - 35 if is_table else (usable - 12) * 64 // 255 - 23
        min_local = (usable - 12) * 32 // 255 - 23
        part = min_local + (total - min_local) % (usable - 4)
        part[part > max_local] = min_local
        return np.where(total <= max_local, total, part)


def _children(lot: Lot) -> Int64s:
    """Return the numbers of the pages below interior pages, in order."""
    lot.require_plain()
    words = shifted(lot.buffer, ">u4")
    last = words[lot.head + 8].astype(np.int64)
    return np.insert(words[lot.at].astype(np.int64), np.cumsum(lot.count), last)


def shifted(buffer: Bytes, kind: str) -> NDArray[np.integer]:
    """Return a view of the numbers that start at each byte."""
    width = np.dtype(kind).itemsize
    return np.ndarray((len(buffer) - width + 1,), kind, buffer, 0, (1,))


def first_true(marked: NDArray[np.bool_]) -> int:
    """Return the index of the first True, or the length if all are False."""
    return int(marked.argmax()) if np.count_nonzero(marked) else len(marked)


def varint(buffer: Bytes, at: Int64s) -> tuple[Int64s, Int64s]:
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


def integers(
    words: NDArray[np.integer], end: Int64s, size: Int64s, serial: NDArray[np.uint8]
) -> Int64s:
    """Parse signed integers of up to eight bytes that end at ``end``."""
    if np.minimum.reduce(size, initial=8) == 8:
        return words[end - 8].astype(np.int64)
    shift = 8 * (8 - np.clip(size, 1, 8))
    value = words[np.maximum(end - 8, 0)].astype(np.int64)
    value = (value << shift) >> shift
    return np.where(size > 0, value, serial == _ONE)
