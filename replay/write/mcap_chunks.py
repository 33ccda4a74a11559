"""Message records of MCAP, whole blocks at a time: columns in, bytes out.

Messages of several channels are merged by log time, without ever changing the order of two
messages of one channel, and cut into chunks.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.columns import Bytes, Int64s, Messages

OPCODE_MESSAGE: Final = 0x05
HEAD: Final = np.dtype(
    [
        ("opcode", "u1"),
        ("length", "<u8"),
        ("channel", "<u2"),
        ("sequence", "<u4"),
        ("log", "<u8"),
        ("publish", "<u8"),
    ]
)
"""A message record up to its payload."""
FEW_LENGTHS: Final = 32
"""Copies of as many different lengths are made length by length; of more, one by one."""
LARGE: Final = 4096
"""Mean bytes from which copying one by one is as fast."""


@dataclass(frozen=True, slots=True, eq=False)
class Stretch:
    """N messages of one channel, in the order in which they are to be stored.

    Attributes:
        channel: Number of the channel.
        log_ns: Shape (N,), int64.
        publish_ns: Shape (N,), int64.
        sequence: Shape (N,), uint32.
        messages: N payloads.
    """

    channel: int
    log_ns: Int64s
    publish_ns: Int64s
    sequence: NDArray[np.uint32]
    messages: Messages

    @property
    def stored_bytes(self) -> int:
        """Bytes of its message records."""
        payload = int((self.messages.stop - self.messages.start).sum())
        return payload + HEAD.itemsize * len(self.messages)


@dataclass(frozen=True, slots=True, eq=False)
class ChunkRows:
    """Message records of one chunk, without the definitions before them.

    Attributes:
        records: Shape (B,), uint8.
        channel: Shape (N,), uint16.
        log_ns: Shape (N,), int64.
        offset: Shape (N,), int64: where in ``records`` each begins.
    """

    records: Bytes
    channel: NDArray[np.uint16]
    log_ns: Int64s
    offset: Int64s


def merged(stretches: Sequence[Stretch], chunk_bytes: int) -> Iterator[ChunkRows]:
    """All messages as records, merged by log time and cut into chunks of about ``chunk_bytes``.

    A channel whose clock goes back keeps its order: each of its messages counts as no earlier than
    those before it.
    """
    counts = [len(stretch.messages) for stretch in stretches]
    if not sum(counts):
        return
    log = np.concatenate([stretch.log_ns for stretch in stretches])
    order = np.argsort(np.concatenate(_keys(stretches)), kind="stable")
    sizes = np.concatenate([s.messages.stop - s.messages.start for s in stretches])
    ends = np.cumsum(sizes[order] + HEAD.itemsize)
    begins = np.empty_like(ends)
    begins[order] = ends - sizes[order] - HEAD.itemsize
    channel = np.repeat(np.array([s.channel for s in stretches], np.uint16), counts)
    records = np.empty(int(ends[-1]), np.uint8)
    _put_heads(records, begins, _heads(stretches, channel, log, sizes))
    at = 0
    for stretch, count in zip(stretches, counts, strict=True):
        place = begins[at : at + count] + HEAD.itemsize
        copy_ranges(
            records, place, stretch.messages.buffer, stretch.messages.start, sizes[at : at + count]
        )
        at += count
    yield from _cut(records, channel[order], log[order], begins[order], ends, chunk_bytes)


def _keys(stretches: Sequence[Stretch]) -> list[Int64s]:
    """Times to sort by, which never go back within a channel."""
    latest: dict[int, int] = {}
    keys = []
    for stretch in stretches:
        key = np.maximum.accumulate(stretch.log_ns)
        if stretch.channel in latest:
            key = np.maximum(key, latest[stretch.channel])
        if len(key):
            latest[stretch.channel] = int(key[-1])
        keys.append(key)
    return keys


def _heads(
    stretches: Sequence[Stretch], channel: NDArray[np.uint16], log: Int64s, sizes: Int64s
) -> NDArray[np.void]:
    heads = np.empty(len(log), HEAD)
    heads["opcode"] = OPCODE_MESSAGE
    heads["length"] = sizes + (HEAD.itemsize - 9)
    heads["channel"] = channel
    heads["sequence"] = np.concatenate([stretch.sequence for stretch in stretches])
    heads["log"] = log
    heads["publish"] = np.concatenate([stretch.publish_ns for stretch in stretches])
    return heads


def _put_heads(records: Bytes, begins: Int64s, heads: NDArray[np.void]) -> None:
    width = HEAD.itemsize
    every: NDArray[np.void] = np.ndarray(
        (len(records) - width + 1,), f"V{width}", records.data, strides=(1,)
    )
    every[begins] = heads.view(f"V{width}")


def _cut(
    records: Bytes,
    channel: NDArray[np.uint16],
    log_ns: Int64s,
    begins: Int64s,
    ends: Int64s,
    chunk_bytes: int,
) -> Iterator[ChunkRows]:
    number = begins // chunk_bytes
    edges = [0, *(np.flatnonzero(np.diff(number)) + 1).tolist(), len(begins)]
    for i in range(len(edges) - 1):
        rows = slice(edges[i], edges[i + 1])
        first, last = int(begins[edges[i]]), int(ends[edges[i + 1] - 1])
        yield ChunkRows(records[first:last], channel[rows], log_ns[rows], begins[rows] - first)


def copy_ranges(
    target: Bytes, target_start: Int64s, source: Bytes, source_start: Int64s, length: Int64s
) -> None:
    """Copy N ranges of bytes; ranges of one length together, where there are few lengths."""
    if not len(length):
        return
    mean = int(length.sum()) // len(length)
    are_equal = bool((length == length[0]).all())
    lengths = length[:1] if are_equal or mean >= LARGE else np.unique(length)
    if mean >= LARGE or len(lengths) > FEW_LENGTHS:
        to, of = target.data, source.data
        rows = zip(target_start.tolist(), source_start.tolist(), length.tolist(), strict=True)
        for put, take, size in rows:
            to[put : put + size] = of[take : take + size]
        return
    for size in lengths.tolist():
        if size == 0:
            continue
        rows_ = slice(None) if len(lengths) == 1 else length == size
        to_view, of_view = _windows(target, size), _windows(source, size)
        to_view[target_start[rows_]] = of_view[source_start[rows_]]


def _windows(buffer: Bytes, width: int) -> NDArray[np.void]:
    """Every stretch of ``width`` bytes of a buffer, as one view of it."""
    view: NDArray[np.void] = np.ndarray(
        (len(buffer) - width + 1,), f"V{width}", buffer.data, strides=(1,)
    )
    return view
