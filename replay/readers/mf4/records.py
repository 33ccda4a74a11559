"""Reading of the records of MDF 4 channel groups, from sorted or unsorted data.

Sorted data contain the records of one group, which have equal sizes. Unsorted data contain records
of several groups, each after its group's identifier. Some of them are variable-length values that
belong to a record of another group.
"""

import struct
import sys
from bisect import bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.columns import BLOCK_ROWS, Bytes, Int64s
from crosscue.replay.compiled import kept

from .blocks import VLSD_GROUP, ChannelGroup, DataGroup
from .stream import LinkedData

_WALK_BYTES: Final = 1 << 20
# Number of parsed pieces kept in memory, because values are close to their records.
_KEPT: Final = 3
# Number of records parsed by the plain loop before Numba is imported.
PATIENCE: Final = 3_000_000
# Padding after a piece in bytes, so that every value can be read with this width.
PADDING: Final = 64
LAST_CUT: Final = "last record is cut"
# Minimum number of records in a run.
_FEW: Final = 16
# Number of records in a run after which the next run is searched at once.
_MANY: Final = 500
_LENGTH: Final = struct.Struct("<L")


@dataclass(frozen=True, slots=True, eq=False)
class Records:
    """Consecutive records of one group, or an unreadable stretch.

    Attributes:
        rows: Shape (N, record bytes).
        first: Index of the first record in its group.
        place: Shape (N,): ascending places, comparable among the groups of one data group.
        damage: Reason why the stretch is unreadable, or empty.
        dropped: Number of records known to be dropped.
    """

    rows: Bytes
    first: int
    place: Int64s
    damage: str = ""
    dropped: int = 0


_NO_ROWS: Final = np.zeros((0, 0), np.uint8)
_NO_PLACE: Final = np.zeros(0, np.int64)


def sorted_records(
    stream: LinkedData, group: ChannelGroup, first: int = 0, stop: int | None = None
) -> Iterator[Records]:
    """Yield the records ``first`` to ``stop`` of a group with a separate data stream."""
    size = group.record_bytes
    if not size:
        return
    end = stream.size if stop is None else min(stream.size, stop * size)
    done = first
    while done * size < end:
        at = done * size
        content = stream.read(at, min(BLOCK_ROWS * size, end - at))
        count = len(content) // size
        if count:
            rows = np.frombuffer(content, np.uint8, count * size).reshape(count, size)
            yield Records(rows, done, np.arange(done, done + count))
            done += count
            continue
        hole = stream.hole(at, at + size)
        if hole is None:
            yield _damaged(done, f"{group.name}: {LAST_CUT}", 1)
            break
        # The next record that starts after the stretch is the first complete one.
        following = -(-hole[0] // size)
        yield _damaged(done, hole[1], following - done)
        done = following
    if stream.broken and stop is None:
        yield _damaged(done, stream.broken, 0)


def _damaged(first: int, damage: str, dropped: int) -> Records:
    return Records(_NO_ROWS, first, _NO_PLACE, damage, dropped)


@dataclass(frozen=True, slots=True, eq=False)
class Walked:
    """Consecutive complete records of unsorted data.

    Attributes:
        content: Shape (B,): bytes of the records, and ``PADDING`` more.
        base: Offset of the bytes in the stream.
        group: Shape (N,): index of each record's group.
        start: Shape (N,): start of each record's values in ``content``.
        damage: Reason why the following bytes are unreadable, or empty.
        cut: Index of the group of a truncated last record, -1 for none or unknown.
    """

    content: Bytes
    base: int
    group: Int64s
    start: Int64s
    damage: str
    cut: int


@dataclass(frozen=True, slots=True, eq=False)
class _State:
    """Totals before a piece: its place, and each group's records and value bytes."""

    at: int
    records: Int64s
    value_bytes: Int64s


@dataclass(frozen=True, slots=True, eq=False)
class Values:
    """Variable-length values of one group in one piece.

    Attributes:
        offset: Shape (N,), ascending: offset of each value among all values of its group, as
            referenced by records.
        end: Offset of the next value after these.
        first: Index of the first value in its group.
        start: Shape (N,): start of each value in ``content``.
        length: Shape (N,): length of each value.
        content: Shape (B,): bytes of the piece.
    """

    offset: Int64s
    end: int
    first: int
    start: Int64s
    length: Int64s
    content: Bytes


class UnsortedData:
    """Records of several groups in one stream, parsed piece by piece.

    The start of every known piece is kept. Variable-length values far from the records that refer
    to them can thus be found in bounded memory.
    """

    def __init__(self, stream: LinkedData, data: DataGroup, max_record: int) -> None:
        """Prepare a stream for parsing.

        Args:
            stream: The data.
            data: The groups in the stream.
            max_record: Maximum plausible size of a record in bytes.
        """
        self.stream, self.data, self._max = stream, data, max_record
        self._finder = _Finder(data)
        none = np.zeros(len(data.groups), np.int64)
        self._states = [_State(0, none, none)]
        self._is_complete = False
        self._kept: dict[int, Walked] = {}

    def pieces(self) -> Iterator[tuple[int, Walked]]:
        """Yield all pieces in order, with their numbers."""
        k = 0
        while (piece := self.piece(k)) is not None:
            yield k, piece
            k += 1

    def piece(self, k: int) -> Walked | None:
        """Return piece ``k``, or None after the last one."""
        while k >= len(self._states) and not self._is_complete:
            self.piece(len(self._states) - 1)
        if k >= len(self._states):
            return None
        if k not in self._kept:
            while len(self._kept) >= _KEPT:
                del self._kept[next(iter(self._kept))]
            self._kept[k] = self._walk(k)
        return self._kept[k]

    def rows(self, k: int, group: int) -> Records:
        """Return the records of one group in piece ``k``."""
        piece = self._known(k)
        start = piece.start[piece.group == group]
        rows = _gathered(piece.content, start, self.data.groups[group].record_bytes)
        return Records(rows, int(self._states[k].records[group]), start + piece.base)

    def values(self, k: int, group: int) -> Values:
        """Return the variable-length values of one group in piece ``k``."""
        piece, before = self._known(k), self._states[k]
        start = piece.start[piece.group == group]
        length = _lengths(piece.content, start)
        after = before.value_bytes[group] + np.cumsum(length + 4)
        end = int(after[-1] if len(after) else before.value_bytes[group])
        first = int(before.records[group])
        return Values(after - (length + 4), end, first, start, length, piece.content)

    def piece_of(self, group: int, key: int, by_order: bool) -> int:
        """Return the piece that contains a value, by its offset or index; -1 if none does."""

        def before(state: _State) -> int:
            return int(state.records[group] if by_order else state.value_bytes[group])

        while True:
            k = bisect_right(self._states, key, key=before) - 1
            if k < len(self._states) - 1 or self._is_complete:
                return k
            self.piece(k)
            if self._is_complete:
                return k

    def _known(self, k: int) -> Walked:
        piece = self.piece(k)
        assert piece is not None
        return piece

    def _walk(self, k: int) -> Walked:
        before, size = self._states[k], _WALK_BYTES
        while True:
            content = self.stream.read(before.at, size)
            is_end = len(content) < size
            group, start, stop, unknown = self._finder(content)
            if len(start) or is_end or unknown >= 0:
                break
            if size > self._max:
                unknown = -2
                break
            size *= 2
        damage, cut = "", -1
        if is_end or unknown != -1:
            damage, cut = self._end(before.at + stop, content[stop:], unknown)
        buffer = np.frombuffer(content + bytes(PADDING), np.uint8)
        piece = Walked(buffer, before.at, group, start, damage, cut)
        if k == len(self._states) - 1 and not self._is_complete:
            self._advance(before, piece, stop, is_end or unknown != -1)
        return piece

    def _advance(self, before: _State, piece: Walked, stop: int, is_last: bool) -> None:
        if is_last:
            self._is_complete = True
            return
        count = len(self.data.groups)
        records = before.records + np.bincount(piece.group, minlength=count)
        value_bytes = before.value_bytes.copy()
        for g in np.flatnonzero(self._finder.sizes < 0):
            start = piece.start[piece.group == g]
            value_bytes[g] += int((_lengths(piece.content, start) + 4).sum())
        self._states.append(_State(before.at + stop, records, value_bytes))

    def _end(self, at: int, rest: bytes, unknown: int) -> tuple[str, int]:
        left = self.stream.size - at
        where = f"byte {at} of the data, {left} bytes before its end"
        if unknown == -2:
            return f"a record of more than {self._max} bytes at {where}", -1
        if unknown >= 0:
            return f"unknown record identifier {unknown} at {where}", -1
        hole = self.stream.hole(at, self.stream.size)
        if hole is not None:
            return f"{hole[1]}; unsorted records after it cannot be found", -1
        if not rest:
            return self.stream.broken, -1
        return self.stream.broken or LAST_CUT, self._finder.group_of(rest)


class _Finder:
    """Finds records in a buffer; switches to Numba after many records."""

    def __init__(self, data: DataGroup) -> None:
        self._id_bytes = data.id_bytes
        self._index = {group.record_id: k for k, group in enumerate(data.groups)}
        self.sizes = np.array(
            [-1 if g.flags & VLSD_GROUP else g.record_bytes for g in data.groups], np.int64
        )
        order = sorted(self._index)
        self._ids = np.array(order, np.uint64)
        self._order = np.array([self._index[one] for one in order], np.int64)
        self._done = 0

    def group_of(self, content: bytes) -> int:
        """Return the group of the record that starts here, -1 if unknown."""
        if len(content) < self._id_bytes:
            return -1
        return self._index.get(int.from_bytes(content[: self._id_bytes], "little"), -1)

    def __call__(self, content: bytes) -> tuple[Int64s, Int64s, int, int]:
        """Find the complete records.

        Returns:
            Groups, starts of the values, start of the first incomplete record, and its identifier
            if it belongs to no group, else -1.
        """
        if "numba" in sys.modules or self._done + len(content) // 20 > PATIENCE:
            return self._compiled(content)
        found = self._plainly(content)
        self._done += len(found[0])
        return found

    def _plainly(self, content: bytes) -> tuple[Int64s, Int64s, int, int]:
        id_bytes, index, sizes = self._id_bytes, self._index, self.sizes.tolist()
        groups: list[int] = []
        starts: list[int] = []
        before: list[tuple[Int64s, Int64s]] = []
        at, end, unknown, patience = 0, len(content), -1, _FEW
        while at + id_bytes <= end:
            start = at + id_bytes
            identifier = content[at] if id_bytes == 1 else _number(content, at, start)
            group = index.get(identifier)
            if group is None:
                unknown = identifier
                break
            size = sizes[group]
            if size < 0:
                if start + 4 > end:
                    break
                size = _LENGTH.unpack_from(content, start)[0]
                start += 4
            if start + size > end:
                break
            groups.append(group)
            starts.append(start)
            at = start + size
            if len(groups) > patience:
                run = self._run(content, groups, starts, at)
                # The search for a run takes as long as some hundred records of this loop.
                is_worth_it = run is not None and len(run[0]) > _MANY
                patience = _FEW if is_worth_it else min(2 * patience, PATIENCE)
                if run:
                    before += [(np.array(groups, np.int64), np.array(starts, np.int64)), run[:2]]
                    groups, starts, at = [], [], run[2]
        before.append((np.array(groups, np.int64), np.array(starts, np.int64)))
        found = [np.concatenate(column) for column in zip(*before, strict=True)]
        return found[0], found[1], at, unknown

    def _run(
        self, content: bytes, groups: Sequence[int], starts: Sequence[int], at: int
    ) -> tuple[Int64s, Int64s, int] | None:
        """Find the records from ``at`` on that repeat the pattern of the last one or two.

        Loggers write long runs of frames of one kind, often with payloads of equal length. In such
        runs, all identifiers and lengths are compared at once.
        """
        for period in (1, 2):
            kinds = np.array(groups[-period:], np.int64)
            start = np.array(starts[-period:], np.int64)
            head = start - self._id_bytes - np.where(self.sizes[kinds] < 0, 4, 0)
            first = int(head[0])
            stride = at - first
            columns = np.concatenate([np.arange(*pair) for pair in zip(head, start, strict=True)])
            for max_count in (_FEW, (len(content) - at) // stride):
                count = min((len(content) - at) // stride, max_count)
                bytes_ = np.frombuffer(content, np.uint8, (count + 1) * stride, first)
                table = bytes_.reshape(count + 1, stride)[:, columns - first]
                differs = (table != table[0]).any(axis=1)
                count = int(np.argmax(differs)) - 1 if bool(differs.any()) else count
                if count < _FEW:
                    break
            if count >= _FEW:
                begins = at + stride * np.arange(count)[:, None] + (start - first)
                return np.tile(kinds, count), begins.ravel(), at + count * stride
        return None

    def _compiled(self, content: bytes) -> tuple[Int64s, Int64s, int, int]:
        known = self.sizes[self.sizes >= 0]
        smallest = self._id_bytes + int(min(known.min(initial=4), 4))
        room = len(content) // smallest + 1
        groups, starts = np.empty(room, np.int64), np.empty(room, np.int64)
        buffer = np.frombuffer(content, np.uint8)
        count, at, is_unknown = kept(_walk)(
            buffer, self._id_bytes, self._ids, self._order, self.sizes, groups, starts
        )
        unknown = _number(content, at, at + self._id_bytes) if is_unknown else -1
        return groups[:count].copy(), starts[:count].copy(), at, unknown


def _number(content: bytes, start: int, stop: int) -> int:
    return int.from_bytes(content[start:stop], "little")


def _walk(
    buffer: Bytes,
    id_bytes: int,
    ids: NDArray[np.uint64],
    order: Int64s,
    sizes: Int64s,
    groups: Int64s,
    starts: Int64s,
) -> tuple[int, int, bool]:
    """Find the records of ``buffer``; slow unless compiled, see ``_Finder``.

    Returns:
        Number of records, start of the first incomplete one, and whether its identifier is unknown.
    """
    at = 0
    count = 0
    end = len(buffer)
    while at + id_bytes <= end and count < len(groups):
        identifier = np.uint64(0)
        for i in range(id_bytes - 1, -1, -1):
            identifier = (identifier << np.uint64(8)) | np.uint64(buffer[at + i])
        low = np.searchsorted(ids, identifier)
        if low == len(ids) or ids[low] != identifier:
            return count, at, True
        group = order[low]
        start = at + id_bytes
        size = sizes[group]
        if size < 0:
            if start + 4 > end:
                break
            size = 0
            for i in range(3, -1, -1):
                size = size * 256 + np.int64(buffer[start + i])
            start += 4
        if size > end - start:
            break
        groups[count] = group
        starts[count] = start
        count += 1
        at = start + size
    return count, at, False


def _lengths(content: Bytes, start: Int64s) -> Int64s:
    """Return the lengths stored before variable-length values."""
    if not len(start):
        return np.zeros(0, np.int64)
    shape = (len(content) - 3,)
    numbers = np.ndarray(shape, np.dtype("<u4"), content.data, strides=(1,))
    return numbers[start - 4].astype(np.int64)


def _gathered(content: Bytes, start: Int64s, size: int) -> Bytes:
    if not len(start) or not size:
        return np.zeros((len(start), size), np.uint8)
    return np.lib.stride_tricks.sliding_window_view(content, size)[start]
