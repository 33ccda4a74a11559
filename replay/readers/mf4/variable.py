"""Variable-length values, which MDF 4 stores separately from the records that refer to them."""

from collections.abc import Iterator
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.columns import Bytes, Int64s

from .records import UnsortedData
from .stream import LinkedData

_SPAN: Final = 4 << 20
# Maximum number of windows of ``_SPAN`` bytes with the values of one block of records.
_WINDOWS_MAX: Final = 64


class VariableValues(Protocol):
    """Values of one channel, found by the references in its records."""

    def fetch(self, key: Int64s, first: int, width: int) -> tuple[Bytes, Int64s]:
        """Read the values of N records.

        Args:
            key: Shape (N,): references in the records, negative for impossible ones.
            first: Index of the first record in its group.
            width: Number of bytes to read of each value, 8 or 64.

        Returns:
            Shape (N, width): first bytes of the values, undefined after their ends. Shape (N,):
            lengths of the values, -1 for missing or unreadable ones.
        """


class StoredValues:
    """Values in a separate data block, each after its length, found by their offsets."""

    def __init__(self, stream: LinkedData) -> None:
        self._stream = stream

    def fetch(self, key: Int64s, first: int, width: int) -> tuple[Bytes, Int64s]:
        """Read the values of N records; see ``VariableValues``."""
        payload, length = _nothing(len(key), width)
        for begin, end, rows in _windows(key):
            near = key if len(rows) == len(key) else key[rows]
            for base, content in self._readable(begin, end + 4 + width):
                _take(content, near - base, rows, payload, length)
        return payload, length

    def _readable(self, begin: int, end: int) -> Iterator[tuple[int, bytes]]:
        while begin < end:
            content = self._stream.read(begin, end - begin)
            if content:
                yield begin, content
            hole = self._stream.hole(begin + len(content), end)
            if hole is None:
                return
            begin = hole[0]


class GroupValues:
    """Values that are records of a separate group in the same unsorted data."""

    def __init__(self, data: UnsortedData, group: int, by_order: bool) -> None:
        """Prepare reading the values of a group.

        Args:
            data: The unsorted data.
            group: Index of the values' group.
            by_order: True if the records' offsets were not written, so that the n-th value belongs
                to the n-th record.
        """
        self._data, self.group, self._by_order = data, group, by_order
        self.first_missed: int | None = None
        """Offset or index of the first requested value after the last existing one, if any."""

    def fetch(self, key: Int64s, first: int, width: int) -> tuple[Bytes, Int64s]:
        """Read the values of N records; see ``VariableValues``."""
        payload, length = _nothing(len(key), width)
        if self._by_order:
            key = np.arange(first, first + len(key))
        left = np.flatnonzero(key >= 0)
        while len(left):
            k = self._data.piece_of(self.group, int(key[left].min()), self._by_order)
            values = self._data.values(k, self.group)
            known, end = values.offset, values.end
            if self._by_order:
                end = values.first + len(known)
                known = np.arange(values.first, end)
            mine = key[left]
            at = np.minimum(np.searchsorted(known, mine), max(len(known) - 1, 0))
            is_here = known[at] == mine if len(known) else np.zeros(len(mine), np.bool_)
            rows, at = left[is_here], at[is_here]
            start, found = values.start[at], values.length[at]
            payload[rows] = windowed(values.content, width, start)
            length[rows] = found
            # A value that is missing in its piece does not exist.
            left = left[~is_here & (mine >= end)]
            if len(left) and self._data.piece(k + 1) is None:
                missed = int(key[left].min())
                before = self.first_missed
                self.first_missed = missed if before is None else min(before, missed)
                break
        return payload, length


def _nothing(count: int, width: int) -> tuple[Bytes, Int64s]:
    return np.zeros((count, width), np.uint8), np.full(count, -1, np.int64)


def _windows(key: Int64s) -> Iterator[tuple[int, int, NDArray[np.intp]]]:
    """Yield groups of rows with nearby values: first offset, last offset, and the rows."""
    rows = np.flatnonzero(key >= 0)
    if not len(rows):
        return
    some = key if len(rows) == len(key) else key[rows]
    low, high = int(some.min()), int(some.max())
    if high - low <= _SPAN:
        yield low, high, rows
        return
    window = some // _SPAN
    found, count = np.unique(window, return_counts=True)
    for one in np.sort(found[np.argsort(-count, kind="stable")][:_WINDOWS_MAX]):
        there = rows[window == one]
        yield int(key[there].min()), int(key[there].max()), there


def _take(
    content: bytes, place: Int64s, rows: NDArray[np.intp], payload: Bytes, length: Int64s
) -> None:
    """Copy the values that are completely in ``content``, at ``place``."""
    size, width = len(content), payload.shape[1]
    if len(place) and (place.min() < 0 or place.max() + 4 > size):
        inside = (place >= 0) & (place + 4 <= size)
        place, rows = place[inside], rows[inside]
    # Length and value are read together, because unaligned reads are slow.
    kind = np.dtype([("length", "<u4"), ("value", "<u8", (width // 8,))])
    padded = content + bytes(kind.itemsize)
    near: NDArray[np.void] = np.ndarray((size,), f"V{kind.itemsize}", padded, strides=(1,))
    found = near[place].view(kind)
    stored = found["length"].astype(np.int64)
    is_whole = place + stored <= size - 4
    if not bool(is_whole.all()):
        rows, found, stored = rows[is_whole], found[is_whole], stored[is_whole]
    values = payload.view("<u8")
    if len(rows) == len(length):
        np.copyto(values, found["value"])
        np.copyto(length, stored)
        return
    values[rows] = found["value"]
    length[rows] = stored


def windowed(buffer: Bytes, width: int, place: Int64s) -> Bytes:
    """Return ``width`` (8 or 64) bytes from each place on, shape (N, width)."""
    if width == 8:
        shape = (len(buffer) - 7,)
        words: NDArray[np.uint64] = np.ndarray(shape, np.dtype("<u8"), buffer.data, strides=(1,))
        return words[place].view(np.uint8).reshape(-1, 8)
    return np.lib.stride_tricks.sliding_window_view(buffer, width)[place]
