"""The summary's index of chunks, in columns, because a log of an hour has thousands of chunks.

Objects for single chunks are created only on demand, so that opening a log and finding a window in
it take the same time for logs of any length.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.readers.mcap.records import CHUNK_FIXED, PREFIX, BrokenRecordError, ChunkIndex

SMALLEST_CHUNK: Final = PREFIX.size + CHUNK_FIXED
# Upper bound for file sizes; entries that point beyond it are ignored.
FARTHEST: Final = 1 << 62
_FIXED: Final = 36
_PAIR: Final = 10
_AFTER_MAP: Final = 12
_SIZES: Final = 16
_LONGEST_NAME: Final = 32
_RUN: Final = 8


@dataclass(frozen=True, eq=False)
class ChunkTable(Mapping[int, ChunkIndex]):
    """Index entries of N chunks, sorted by offset; also a mapping from the offset.

    Attributes:
        at: Shape (N,), int64: offset of each chunk record from the file's start.
        length: Shape (N,), int64: length of the chunk record.
        index_length: Shape (N,), int64: length of the message indexes after it.
        start: Shape (N,), uint64: earliest log time.
        end: Shape (N,), uint64: latest log time.
        sizes: Shape (N, 2), uint64: stored and decompressed sizes of the records in bytes.
        compression: N names.
        edges: Shape (N + 1,), int64: edges of the chunks' ranges in ``channel``.
        channel: Shape (M,), uint16: channels with a message index, chunk by chunk.
    """

    at: NDArray[np.int64]
    length: NDArray[np.int64]
    index_length: NDArray[np.int64]
    start: NDArray[np.uint64]
    end: NDArray[np.uint64]
    sizes: NDArray[np.uint64]
    compression: NDArray[np.bytes_]
    edges: NDArray[np.int64]
    channel: NDArray[np.uint16]

    @property
    def after(self) -> NDArray[np.int64]:
        """Offset after each chunk and its message indexes, shape (N,)."""
        return self.at + self.length + self.index_length

    @property
    def is_tiled(self) -> bool:
        """True if no chunks with their message indexes overlap."""
        return bool((self.after[:-1] <= self.at[1:]).all())

    def naming(self, channels: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return a mask of the chunks with a message index for any of these channels.

        Args:
            channels: Shape (65536,): mask by channel number.
        """
        rows = np.repeat(np.arange(len(self)), np.diff(self.edges))
        named = np.zeros(len(self), dtype=np.bool_)
        named[rows[channels[self.channel]]] = True
        return named

    @property
    def is_unnamed(self) -> NDArray[np.bool_]:
        """Mask of the chunks without message indexes, shape (N,)."""
        return np.equal(self.edges[1:], self.edges[:-1])

    def take(self, rows: NDArray[np.bool_] | NDArray[np.intp] | slice) -> Self:
        """Return the selected chunks."""
        picked = np.arange(len(self))[rows]
        edges = np.concatenate(([0], np.cumsum(np.diff(self.edges)[picked]))).astype(np.int64)
        pairs = np.repeat(self.edges[picked] - edges[:-1], np.diff(edges)) + np.arange(edges[-1])
        return type(self)(
            self.at[rows],
            self.length[rows],
            self.index_length[rows],
            self.start[rows],
            self.end[rows],
            self.sizes[rows],
            self.compression[rows],
            edges,
            self.channel[pairs],
        )

    def __len__(self) -> int:
        return len(self.at)

    def __iter__(self) -> Iterator[int]:
        return iter(self.at.tolist())

    def __contains__(self, at: object) -> bool:
        return at in self._row

    def __getitem__(self, at: int) -> ChunkIndex:
        i = self._row[at]
        first, last, length, index_length, body_size, size = self._numbers[i]
        channels = frozenset(self.channel[self.edges[i] : self.edges[i + 1]].tolist())
        name = self.compression[i].decode("utf-8", "backslashreplace")
        return ChunkIndex(first, last, at, length, channels, index_length, name, body_size, size)

    @cached_property
    def _row(self) -> dict[int, int]:
        return {at: i for i, at in enumerate(self.at.tolist())}

    @cached_property
    def _numbers(self) -> list[tuple[int, ...]]:
        columns = (
            self.start,
            self.end,
            self.length,
            self.index_length,
            self.sizes[:, 0],
            self.sizes[:, 1],
        )
        return list(zip(*(column.tolist() for column in columns), strict=True))


def run_of(records: bytes, at: int, size: int) -> int:
    """Return the number of consecutive records of one kind and size from ``at`` on."""
    prefix, count = records[at : at + PREFIX.size], 1
    ahead = at + (_RUN - 1) * size
    if records[ahead : ahead + PREFIX.size] != prefix:
        return count
    view = np.frombuffer(records, dtype=np.uint8)[at:]
    max_count = (len(records) - at) // size
    first = np.frombuffer(prefix, dtype=np.uint8)
    while count < max_count:
        step = min(_RUN * count, max_count)
        rows = view[: step * size].reshape(step, size)[:, : PREFIX.size]
        same = (rows == first).all(axis=1)
        if not same.all():
            return int(same.argmin())
        count = step
    return count


def parse_chunk_indexes(
    records: bytes, begins: Sequence[int], sizes: Sequence[int], base: int
) -> ChunkTable:
    """Parse the ChunkIndex contents at ``begins``, each of ``sizes`` bytes.

    Args:
        records: The summary.
        begins: N offsets in it.
        sizes: N lengths.
        base: Offset of the recording within a concatenated file.

    Raises:
        BrokenRecordError: A record is shorter than its fields.
    """
    view = np.frombuffer(records, dtype=np.uint8)
    begin, size = np.array(begins, dtype=np.int64), np.array(sizes, dtype=np.int64)
    _need(size, _FIXED)
    fixed = _gathered(view, begin, _FIXED)
    times = fixed[:, :32].copy().view("<u8")
    map_size = fixed[:, 32:].copy().view("<u4")[:, 0].astype(np.int64)
    if (map_size % _PAIR).any():
        raise BrokenRecordError("a map of channels ends inside an entry")
    _need(size, _FIXED + map_size + _AFTER_MAP)
    behind = _gathered(view, begin + _FIXED + map_size, _AFTER_MAP)
    name_size = behind[:, 8:].copy().view("<u4")[:, 0].astype(np.int64)
    name_at = begin + _FIXED + map_size + _AFTER_MAP
    _need(size, name_at - begin + name_size + _SIZES)
    if len(name_size) and name_size.max() > _LONGEST_NAME:
        raise BrokenRecordError(f"a compression name of {name_size.max()} bytes")
    edges = np.concatenate(([0], np.cumsum(map_size // _PAIR))).astype(np.int64)
    pair_at = np.repeat(begin + _FIXED - _PAIR * edges[:-1], map_size // _PAIR)
    pair_at += _PAIR * np.arange(edges[-1])
    index_length = behind[:, :8].copy().view("<u8")[:, 0]
    table = ChunkTable(
        times[:, 2].astype(np.int64) + base,
        times[:, 3].astype(np.int64),
        index_length.astype(np.int64),
        times[:, 0].copy(),
        times[:, 1].copy(),
        _gathered(view, name_at + name_size, _SIZES).view("<u8"),
        _names(view, name_at, name_size),
        edges,
        _gathered(view, pair_at, 2).view("<u2")[:, 0],
    )
    far = np.uint64(FARTHEST)
    sane = (times[:, 2] < far) & (times[:, 3] < far) & (index_length < far)
    return _sorted(table, sane & (times[:, 3] >= SMALLEST_CHUNK))


def _sorted(table: ChunkTable, sane: NDArray[np.bool_]) -> ChunkTable:
    """Sort by offset and keep the last entry of each offset."""
    at = table.at
    if sane.all() and (at[1:] > at[:-1]).all():
        return table
    rows = {int(at[i]): i for i in np.flatnonzero(sane).tolist()}
    return table.take(np.array([rows[place] for place in sorted(rows)], dtype=np.intp))


def _gathered(view: NDArray[np.uint8], at: NDArray[np.int64], size: int) -> NDArray[np.uint8]:
    """Return ``size`` bytes from each offset on, shape (N, size)."""
    return np.take(view, at[:, None] + np.arange(size))


def _names(
    view: NDArray[np.uint8], at: NDArray[np.int64], size: NDArray[np.int64]
) -> NDArray[np.bytes_]:
    """Return the compression names; the dtype ignores the zero padding of shorter names."""
    padded = np.zeros((len(at), _LONGEST_NAME), dtype=np.uint8)
    for width in sorted(set(size.tolist())):
        rows = size == width
        padded[rows, :width] = _gathered(view, at[rows], width)
    return padded.view(f"S{_LONGEST_NAME}")[:, 0]


def _need(size: NDArray[np.int64], wanted: NDArray[np.int64] | int) -> None:
    if (size < wanted).any():
        raise BrokenRecordError("a chunk index is shorter than its fields")
