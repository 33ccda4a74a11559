"""Division of messages of several topics in one buffer into blocks of one topic."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.base import Selection
from crosscue.replay.columns import BLOCK_ROWS, Block, Bytes, Int64s, Messages
from crosscue.replay.ledger import MESSAGE_TOO_LARGE, Ledger
from crosscue.replay.limits import Limits


@dataclass(frozen=True, slots=True, eq=False)
class MixedRows:
    """N messages of several topics as ranges of one buffer, in stored order.

    Attributes:
        buffer: Shape (B,), uint8.
        topic: Shape (N,), int64: index of the topic's name.
        log_ns: Shape (N,), int64: log times.
        start: Shape (N,), int64: offset of each message's first byte.
        stop: Shape (N,), int64: offset one past its last byte.
    """

    buffer: Bytes
    topic: Int64s
    log_ns: Int64s
    start: Int64s
    stop: Int64s

    def __len__(self) -> int:
        return len(self.topic)


def blocks_of(
    rows: MixedRows, names: Sequence[str], selection: Selection, limits: Limits, ledger: Ledger
) -> Iterator[Block]:
    """Yield blocks of each topic in stored order, and account for every row.

    Args:
        rows: Rows of several topics.
        names: Topic names, indexed by ``rows.topic``.
        selection: Rows outside it are counted as skipped.
        limits: Messages over ``message_bytes`` are skipped.
        ledger: Records the counts.
    """
    # NumPy uses a radix sort for 16-bit numbers.
    narrow = rows.topic.astype(np.int16) if len(names) <= 1 << 15 else rows.topic
    order = np.argsort(narrow, kind="stable")
    ordered = rows.topic[order]
    edges = np.flatnonzero(np.diff(ordered)) + 1
    for picked in np.split(order, edges):
        if len(picked):
            name = names[int(rows.topic[picked[0]])]
            yield from _one_topic(rows, picked, name, selection, limits, ledger)


def _one_topic(
    rows: MixedRows,
    picked: NDArray[np.intp],
    name: str,
    selection: Selection,
    limits: Limits,
    ledger: Ledger,
) -> Iterator[Block]:
    log_ns = rows.log_ns[picked]
    kept = selection.account(name, log_ns, ledger)
    if kept is not None:
        picked, log_ns = picked[kept], log_ns[kept]
    length = rows.stop[picked] - rows.start[picked]
    if len(length) and length.max() > limits.message_bytes:
        large = length > limits.message_bytes
        detail = f"{int(length.max())} bytes, limit {limits.message_bytes}"
        ledger.skip(name, MESSAGE_TOO_LARGE, int(large.sum()), detail, int(log_ns[large][0]))
        picked, log_ns = picked[~large], log_ns[~large]
    for first in range(0, len(picked), BLOCK_ROWS):
        part = slice(first, first + BLOCK_ROWS)
        messages = Messages(rows.buffer, rows.start[picked[part]], rows.stop[picked[part]])
        yield Block(name, log_ns[part], messages)
