"""Merging of the blocks of storage files with overlapping times, by topic and time."""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import chain, pairwise
from typing import Final, cast

import numpy as np

from crosscue.replay.columns import BLOCK_BYTES, BLOCK_ROWS, Block, Messages

from .inflate import joined

# Maximum payload bytes held back; beyond it, rows are yielded before their order is certain.
HELD_BYTES: Final = 16 * BLOCK_BYTES

_EARLIEST: Final = -(2**63)
_LATEST: Final = 2**63 - 1


@dataclass(frozen=True, slots=True)
class StorageStream:
    """The blocks of one storage file.

    Attributes:
        blocks: Blocks in stored order, in repeated passes over the topics.
        topics: Names of the topics that may occur.
    """

    blocks: Iterator[Block]
    topics: frozenset[str]


@dataclass(slots=True)
class _Front:
    """The progress of a stream.

    Attributes:
        reached_ns: Earliest time expected of the following rows.
        latest_ns: Latest time so far.
        met: Topics found in the current pass over the topics.
    """

    reached_ns: int = _EARLIEST
    latest_ns: int = _EARLIEST
    met: set[str] = field(default_factory=set)

    def advance(self, block: Block) -> None:
        """Update the progress with a block; a repeated topic starts a new pass."""
        if block.topic in self.met:
            self.met.clear()
            self.reached_ns = self.latest_ns
        self.met.add(block.topic)
        if len(block):
            self.latest_ns = max(self.latest_ns, int(block.log_ns.max()))


def merge_streams(streams: Sequence[StorageStream]) -> Iterator[Block]:
    """Yield all blocks; topics that occur in several streams are in order of log time."""
    many = Counter(chain.from_iterable(stream.topics for stream in streams))
    shared = {name for name, count in many.items() if count > 1}
    fronts = {i: _Front() for i in range(len(streams))}
    held: dict[str, list[Block]] = {}
    size = 0
    while fronts:
        last = min(fronts, key=lambda i: fronts[i].reached_ns)
        before = fronts[last].reached_ns
        block = next(streams[last].blocks, None)
        if block is None:
            del fronts[last]
        else:
            fronts[last].advance(block)
            if block.topic not in shared:
                yield block
                continue
            held.setdefault(block.topic, []).append(block)
            size += _payload_bytes(block)
        reached = min((front.reached_ns for front in fronts.values()), default=_LATEST)
        if reached > before or size > HELD_BYTES or not fronts:
            until = reached if size <= HELD_BYTES and fronts else _LATEST
            held, ready = _parted(held, until)
            size = sum(_payload_bytes(one) for blocks in held.values() for one in blocks)
            yield from ready


def _payload_bytes(block: Block) -> int:
    rows = cast("Messages", block.rows)
    return int((rows.stop - rows.start).sum())


def _parted(
    held: dict[str, list[Block]], until_ns: int
) -> tuple[dict[str, list[Block]], list[Block]]:
    """Merge each topic's rows before ``until_ns``; return the remaining and the merged blocks."""
    remain: dict[str, list[Block]] = {}
    ready: list[Block] = []
    for name, blocks in held.items():
        early: list[Block] = []
        for block in blocks:
            is_early = (block.log_ns < until_ns) | (until_ns == _LATEST)
            if is_early.any():
                early.append(block if is_early.all() else block.take(is_early))
            if not is_early.all():
                remain.setdefault(name, []).append(block.take(~is_early))
        ready += _in_order(early)
    return remain, ready


def _in_order(blocks: list[Block]) -> list[Block]:
    """Join the rows of ``blocks`` sorted by log time, with a stable order."""
    if len(blocks) < 2:
        return blocks
    times = [block.log_ns for block in blocks]
    if all(a[-1] <= b[0] for a, b in pairwise(times)):
        return blocks
    whole = _joined(blocks)
    whole = whole.take(np.argsort(whole.log_ns, kind="stable"))
    return [
        whole.take(slice(first, first + BLOCK_ROWS)) for first in range(0, len(whole), BLOCK_ROWS)
    ]


def _joined(blocks: list[Block]) -> Block:
    payloads = [
        rows.payload(i)
        for rows in (cast("Messages", b.rows) for b in blocks)
        for i in range(len(rows))
    ]
    published = [block.publish_ns for block in blocks if block.publish_ns is not None]
    counters = [block.sequence for block in blocks if block.sequence is not None]
    return Block(
        blocks[0].topic,
        np.concatenate([block.log_ns for block in blocks]),
        joined(payloads),
        publish_ns=np.concatenate(published) if len(published) == len(blocks) else None,
        sequence=np.concatenate(counters) if len(counters) == len(blocks) else None,
    )
