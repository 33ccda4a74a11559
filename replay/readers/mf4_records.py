"""Records of one MDF 4 channel group, in chunks, out of sorted or unsorted data."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.columns import BLOCK_ROWS, Bytes

from .mf4_blocks import VLSD_GROUP, Blocks, DataGroup, Group


@dataclass(frozen=True, slots=True, eq=False)
class Records:
    """Consecutive records, or a stretch that cannot be read.

    Attributes:
        rows: Shape (N, record bytes).
        first: Index of the first one in its group.
        damage: What is wrong, where nothing can be read.
        lost: Records that are known to be lost by it.
    """

    rows: Bytes
    first: int
    damage: str = ""
    lost: int = 0


_NONE = np.zeros((0, 0), np.uint8)


def records_of(
    blocks: Blocks, data: DataGroup, group: Group, is_open_ended: bool
) -> Iterator[Records]:
    """The records of ``group`` in stored order, at most ``BLOCK_ROWS`` at a time."""
    if not group.record_bytes and not data.id_bytes:
        return
    if data.id_bytes:
        found = _unsorted(blocks, data, group, is_open_ended)
    else:
        found = _sorted(blocks, data, group, is_open_ended)
    for records in found:
        if records.damage:
            yield records
        for k in range(0, len(records.rows), BLOCK_ROWS):
            yield Records(records.rows[k : k + BLOCK_ROWS], records.first + k)


def _sorted(
    blocks: Blocks, data: DataGroup, group: Group, is_open_ended: bool
) -> Iterator[Records]:
    size = group.record_bytes
    done, position, tail, gap = 0, 0, b"", 0
    for piece in blocks.pieces(data.data, is_open_ended):
        position += piece.byte_count
        if piece.content is None:
            # The next record that begins after the stretch is the first one to be whole again.
            following = -(-position // size)
            lost = following - done if piece.byte_count else 0
            yield Records(_NONE, done, piece.damage, lost)
            done, tail, gap = following, b"", following * size - position
            continue
        content = tail + piece.content[gap:]
        gap = max(gap - piece.byte_count, 0)
        count = len(content) // size
        if count:
            rows = np.frombuffer(content, np.uint8, count * size).reshape(count, size)
            yield Records(rows, done)
        done += count
        tail = content[count * size :]
    if tail:
        yield Records(_NONE, done, f"{group.name}: last record is cut", 1)


def _unsorted(
    blocks: Blocks, data: DataGroup, group: Group, is_open_ended: bool
) -> Iterator[Records]:
    sizes = {g.record_id: _size(g) for g in data.groups}
    done, tail, base = 0, b"", 0
    for piece in blocks.pieces(data.data, is_open_ended):
        if piece.content is None:
            yield Records(_NONE, done, f"{piece.damage}; unsorted records after it cannot be found")
            return
        content = tail + piece.content
        start, stop = _starts(content, data.id_bytes, sizes, group.record_id)
        rows = _gathered(content, start, group.record_bytes)
        if len(rows):
            yield Records(rows, done)
        done += len(rows)
        if stop < 0:
            yield Records(_NONE, done, f"unknown record identifier after byte {base} of the data")
            return
        base += stop
        tail = content[stop:]
    if tail:
        yield Records(_NONE, done, "last record is cut")


def _size(group: Group) -> int:
    return -1 if group.flags & VLSD_GROUP else group.record_bytes


def _starts(
    content: bytes, id_bytes: int, sizes: dict[int, int], wanted: int
) -> tuple[NDArray[np.int64], int]:
    """Where the wanted group's whole records begin, and where the first incomplete one does.

    The second value is -1 when an identifier is unknown.
    """
    found: list[int] = []
    position, end = 0, len(content)
    while position + id_bytes <= end:
        identifier = int.from_bytes(content[position : position + id_bytes], "little")
        size = sizes.get(identifier)
        if size is None:
            return np.array(found, np.int64), -1
        start = position + id_bytes
        if size < 0:
            if start + 4 > end:
                break
            size = 4 + int.from_bytes(content[start : start + 4], "little")
        if start + size > end:
            break
        if identifier == wanted:
            found.append(start)
        position = start + size
    return np.array(found, np.int64), position


def _gathered(content: bytes, start: NDArray[np.int64], size: int) -> Bytes:
    if not len(start):
        return np.zeros((0, size), np.uint8)
    buffer = np.frombuffer(content, np.uint8)
    return np.lib.stride_tricks.sliding_window_view(buffer, size)[start]
