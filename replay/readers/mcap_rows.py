"""The messages in a stretch of records, as columns.

A stretch is the content of a chunk, or a run of records outside chunks. Where the messages begin is
taken from the chunk's message indexes if these are true, and found by scanning if not. True means:
every entry points to a message of its channel and log time, and the messages together with the few
other records between them cover the chunk exactly.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.columns import Bytes, Int64s

from .mcap_records import (
    ATTACHMENT,
    CHANNEL,
    CHUNK,
    DATA_END,
    FOOTER,
    HEADER,
    MESSAGE,
    MESSAGE_FIXED,
    MESSAGE_HEAD,
    MESSAGE_INDEX,
    PREFIX,
    SCHEMA,
    BrokenRecordError,
    MessageIndex,
    overlapping_heads,
)
from .mcap_scan import Scan, Scanner

GAPS_WORTH_A_LOOK: Final = 256
"""Stretches between indexed messages beyond which scanning everything is as fast."""
DEFINITIONS_MOST: Final = 1 << 17
"""Schemas and channels together in one chunk; each has a 16-bit number."""


@dataclass(frozen=True, slots=True)
class Definition:
    """A Schema or Channel record met on the way.

    Attributes:
        at: Where its record begins.
        opcode: ``SCHEMA`` or ``CHANNEL``.
        content: The record's content.
    """

    at: int
    opcode: int
    content: bytes


@dataclass(frozen=True, slots=True, eq=False)
class Rows:
    """N messages of one buffer, in stored order.

    Attributes:
        buffer: Shape (B,).
        offset: Shape (N,), int64, ascending: where each message record begins.
        head: Shape (N,), MESSAGE_HEAD.
        definitions: The schemas and channels between them.
        ignored: Number of records of other kinds.
        end: Where the last whole record ends.
    """

    buffer: Bytes
    offset: Int64s
    head: NDArray[np.void]
    definitions: Sequence[Definition]
    ignored: int
    end: int

    def __len__(self) -> int:
        return len(self.offset)

    def between(self, begin: int, end: int) -> Rows:
        """The messages from ``begin`` to ``end``, with all definitions."""
        part = slice(begin, end)
        return replace(self, offset=self.offset[part], head=self.head[part])


def opcodes(*codes: int) -> NDArray[np.bool_]:
    """A table of operation codes, true at ``codes``."""
    table = np.zeros(256, dtype=np.bool_)
    table[list(codes)] = True
    return table


NEVER_IN_A_CHUNK: Final = opcodes(
    HEADER, FOOTER, CHUNK, MESSAGE_INDEX, ATTACHMENT, DATA_END, 0x08, 0x0A, 0x0B, 0x0C, 0x0D, 0x0E
)


def rows_by_index(buffer: Bytes, indexes: Sequence[MessageIndex]) -> Rows | None:
    """The messages of a chunk, found through its message indexes; None if these are not true."""
    offsets = np.concatenate([index.entries["offset"] for index in indexes])
    if not len(offsets) or offsets.max() > max(len(buffer) - MESSAGE_HEAD.itemsize, 0):
        return None
    offset = offsets.astype(np.int64)
    channel = np.repeat([index.channel_id for index in indexes], [len(i.entries) for i in indexes])
    log = np.concatenate([index.entries["log"] for index in indexes])
    order = np.argsort(offset, kind="stable")
    offset = offset[order]
    head = overlapping_heads(buffer, offset)
    lengths = head["length"]
    if (
        (head["opcode"] != MESSAGE).any()
        or (head["channel"] != channel[order]).any()
        or (head["log"] != log[order]).any()
        or lengths.min() < MESSAGE_FIXED
        or lengths.max() > len(buffer)
    ):
        return None
    begin = np.append(offset, len(buffer))
    end = np.concatenate(([0], offset + lengths.astype(np.int64) + PREFIX.size))
    gaps = np.flatnonzero(end != begin)
    if len(gaps) > GAPS_WORTH_A_LOOK or (end > begin).any():
        return None
    definitions: list[Definition] = []
    ignored = 0
    for gap in gaps.tolist():
        others = _others(buffer, int(end[gap]), int(begin[gap]))
        if others is None:
            return None
        definitions += others[0]
        ignored += others[1]
        if len(definitions) + ignored > DEFINITIONS_MOST:
            return None
    return Rows(buffer, offset, head, definitions, ignored, len(buffer))


def rows_by_scan(buffer: Bytes, scanner: Scanner, stop_at: NDArray[np.bool_], most: int) -> Rows:
    """The messages of a stretch up to where it cannot be followed any further (``Rows.end``).

    Args:
        buffer: Shape (B,).
        scanner: Does the stepping.
        stop_at: Operation codes before which to stop.
        most: Records allowed.

    Raises:
        BrokenRecordError: More than ``most`` records, or too many definitions.
    """
    scan = scanner(buffer, stop_at, most + 1)
    if len(scan.offset) > most:
        raise BrokenRecordError(f"holds more than {most} records")
    is_message = scan.opcode == MESSAGE
    offset = scan.offset[is_message]
    end = scan.end
    after = np.append(scan.offset, end)[1:][is_message]
    short = np.flatnonzero(after - offset < MESSAGE_HEAD.itemsize)
    if len(short):  # a message that cannot hold its own fields: nothing is trusted from there on
        end = int(offset[short[0]])
        offset = offset[: short[0]]
    definitions, ignored = _definitions(buffer, scan, end)
    return Rows(buffer, offset, overlapping_heads(buffer, offset), definitions, ignored, end)


def _definitions(buffer: Bytes, scan: Scan, end: int) -> tuple[list[Definition], int]:
    begins, ends = scan.offset, np.append(scan.offset, scan.end)[1:]
    wanted = ((scan.opcode == SCHEMA) | (scan.opcode == CHANNEL)) & (begins < end)
    at = np.flatnonzero(wanted)
    if len(at) > DEFINITIONS_MOST:
        raise BrokenRecordError(f"holds more than {DEFINITIONS_MOST} schemas and channels")
    definitions = [
        Definition(b, code, buffer[b + PREFIX.size : e].tobytes())
        for b, e, code in zip(
            begins[at].tolist(), ends[at].tolist(), scan.opcode[at].tolist(), strict=True
        )
    ]
    messages = int(((scan.opcode == MESSAGE) & (begins < end)).sum())
    return definitions, int((begins < end).sum()) - messages - len(definitions)


def _others(buffer: Bytes, begin: int, end: int) -> tuple[list[Definition], int] | None:
    """What lies between two indexed messages; None if a message is there or it does not fit."""
    view, at, ignored = buffer.data, begin, 0
    found: list[Definition] = []
    while at < end:
        if at + PREFIX.size > end:
            return None
        opcode, length = PREFIX.unpack_from(view, at)
        after = at + PREFIX.size + length
        if after > end or opcode in (0, MESSAGE) or NEVER_IN_A_CHUNK[opcode]:
            return None
        if opcode in (SCHEMA, CHANNEL):
            found.append(Definition(at, opcode, bytes(view[at + PREFIX.size : after])))
        else:
            ignored += 1
        if len(found) + ignored > DEFINITIONS_MOST:
            return None
        at = after
    return found, ignored


def contradicts(rows: Rows, indexes: Sequence[MessageIndex]) -> bool:
    """Does an index name a message that is not among ``rows``?"""
    for index in indexes:
        offsets = index.entries["offset"]
        if not len(offsets):
            continue
        if not len(rows):
            return True
        where = np.searchsorted(rows.offset, offsets.astype(np.int64))
        where = np.minimum(where, len(rows) - 1)
        head = rows.head[where]
        same = (
            (rows.offset[where].astype(np.uint64) == offsets)
            & (head["channel"] == index.channel_id)
            & (head["log"] == index.entries["log"])
        )
        if not same.all():
            return True
    return False
