"""Columns of the messages in a chunk, or in a run of records outside chunks.

The offsets of the messages are read from the chunk's message indexes if these are correct, and
found by scanning otherwise. The indexes are correct if every entry points to a message of its
channel and log time, and the messages with the few other records between them cover the chunk
exactly.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import accumulate, pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.columns import Bytes, Int64s
from crosscue.replay.readers.mcap.records import (
    MESSAGE_FIXED,
    MESSAGE_HEAD,
    PREFIX,
    BrokenRecordError,
    MessageIndex,
    Op,
    heads_at,
)

# Number of gaps between indexed messages above which scanning the complete chunk is as fast.
MAX_GAPS: Final = 256
# Maximum number of schemas and channels in a chunk; each has a 16-bit number.
MAX_DEFINITIONS: Final = 1 << 17


@dataclass(frozen=True, slots=True)
class Definition:
    """A Schema or Channel record between messages.

    Attributes:
        at: Offset of the record.
        opcode: ``SCHEMA`` or ``CHANNEL``.
        content: Content of the record.
    """

    at: int
    opcode: int
    content: bytes


@dataclass(frozen=True, slots=True, eq=False)
class Rows:
    """N messages of one buffer.

    Attributes:
        buffer: Shape (B,), uint8.
        offset: Shape (N,), int64: start of each message record.
        stop: Shape (N,), int64: end of each message record.
        channel: Shape (N,), uint16: channel numbers.
        sequence: Shape (N,), uint32: sequence numbers.
        log: Shape (N,), uint64: log times.
        publish: Shape (N,), uint64: publish times.
        definitions: The schemas and channels between the messages.
        ignored: Number of records of other kinds.
        end: End of the last complete record.
        groups: Channel numbers with the ranges of their messages, if the messages are sorted by
            channel and then in stored order. If empty, all messages are in stored order.
        times: First and last log time of each chunk, if found by index.
    """

    buffer: NDArray[np.uint8]
    offset: NDArray[np.int64]
    stop: NDArray[np.int64]
    channel: NDArray[np.uint16]
    sequence: NDArray[np.uint32]
    log: NDArray[np.uint64]
    publish: NDArray[np.uint64]
    definitions: Sequence[Definition]
    ignored: int
    end: int
    groups: tuple[tuple[int, slice], ...] = ()
    times: tuple[tuple[int, int], ...] = ()

    def __len__(self) -> int:
        return len(self.offset)

    def take(self, index: slice | NDArray[np.intp]) -> Rows:
        """Return the selected messages in the order of ``index``, with all definitions."""
        return replace(
            self,
            offset=self.offset[index],
            stop=self.stop[index],
            channel=self.channel[index],
            sequence=self.sequence[index],
            log=self.log[index],
            publish=self.publish[index],
            groups=(),
        )

    def in_stored_order(self) -> Rows:
        """Return the messages of all channels in stored order."""
        return self.take(np.argsort(self.offset, kind="stable")) if self.groups else self


def opcodes(*codes: int) -> NDArray[np.bool_]:
    """Return a mask of operation codes that is true at ``codes``."""
    table = np.zeros(256, dtype=np.bool_)
    table[list(codes)] = True
    return table


NEVER_IN_A_CHUNK: Final = opcodes(Op.HEADER, Op.FOOTER, *range(Op.CHUNK, Op.DATA_END + 1))


def rows_by_index(
    buffer: NDArray[np.uint8], chunks: Sequence[tuple[int, int, Sequence[MessageIndex]]]
) -> Rows | None:
    """Find the messages of consecutive chunks by their indexes; None if one is incorrect.

    Args:
        buffer: Shape (B,): records of all chunks.
        chunks: Start and end of each chunk's records in ``buffer``, and its indexes.
    """
    pieces: dict[int, list[tuple[int, MessageIndex]]] = {}
    for owner, (_, _, indexes) in enumerate(chunks):
        for index in indexes:
            if index.count:
                pieces.setdefault(index.channel_id, []).append((owner, index))
    every = [piece for of_channel in pieces.values() for piece in of_channel]
    owners = [owner for owner, _ in every]
    if len({*owners}) < len(chunks):
        return None
    counts = [index.count for _, index in every]
    packed = b"".join([index.packed for _, index in every])
    entries = np.frombuffer(packed, "<u8").reshape(-1, 2)
    log, offset = entries[:, 0].copy(), entries[:, 1].astype(np.int64)
    last = len(buffer) - MESSAGE_HEAD.itemsize
    if np.minimum.reduce(offset) < 0 or np.maximum.reduce(offset) > last:
        return None
    bounds = np.array([chunk[:2] for chunk in chunks], np.int64)[owners]
    if len(chunks) > 1:
        offset += np.repeat(bounds[:, 0], counts)
        if np.maximum.reduce(offset) > last:
            return None
    head = heads_at(buffer, offset)
    number = np.repeat(np.array([i.channel_id for _, i in every], np.uint32) << 16, counts)
    stop = offset + head.size
    stop += PREFIX.size
    if (
        np.count_nonzero(head.opcode != Op.MESSAGE)
        or np.count_nonzero(head.number != number)
        or np.count_nonzero(head.log != log)
        or np.minimum.reduce(head.size) < MESSAGE_FIXED
    ):
        return None
    edges = [0, *accumulate(counts)]
    if np.count_nonzero(np.maximum.reduceat(stop, edges[:-1]) > bounds[:, 1]):
        return None
    others = _between_messages(buffer, offset, stop, [chunk[0] for chunk in chunks[1:]])
    if others is None:
        return None
    lengths = [sum(i.count for _, i in of_channel) for of_channel in pieces.values()]
    inner = [0, *accumulate(lengths)]
    groups = zip(pieces, (slice(*edge) for edge in pairwise(inner)), strict=True)
    early = np.full(len(chunks), (1 << 64) - 1, np.uint64)
    late = np.zeros(len(chunks), np.uint64)
    np.minimum.at(early, owners, np.minimum.reduceat(log, edges[:-1]))
    np.maximum.at(late, owners, np.maximum.reduceat(log, edges[:-1]))
    rows = Rows(
        buffer,
        offset,
        stop,
        head.channel,
        head.sequence.copy(),
        log,
        head.publish.copy(),
        *others,
        len(buffer),
        tuple(groups),
        tuple(zip(early.tolist(), late.tolist(), strict=True)),
    )
    turns = sum(bool(offset[edge] < offset[edge - 1]) for edge in inner[1:-1])
    is_stored_order = np.count_nonzero(offset[1:] < offset[:-1]) == turns
    return rows if is_stored_order else rows.in_stored_order()


def _between_messages(
    buffer: NDArray[np.uint8],
    offset: NDArray[np.int64],
    stop: NDArray[np.int64],
    borders: Sequence[int],
) -> tuple[list[Definition], int] | None:
    """Return the definitions and the number of other records, if no bytes are left over.

    Messages do not overlap if and only if the k-th end is at most the (k+1)-th start for all k.
    Starts and ends can therefore be sorted separately. No record between messages extends past one
    of the ``borders``, where the next chunk begins.
    """
    begin = np.concatenate([offset, borders, [len(buffer)]], dtype=np.int64, casting="unsafe")
    end = np.concatenate([[0], borders, stop], dtype=np.int64, casting="unsafe")
    begin.sort(kind="stable")
    end.sort(kind="stable")
    gaps = (end != begin).nonzero()[0]
    if len(gaps) > MAX_GAPS or np.count_nonzero(end > begin):
        return None
    definitions: list[Definition] = []
    ignored = 0
    for gap in gaps.tolist():
        others = _others(buffer, int(end[gap]), int(begin[gap]))
        if others is None:
            return None
        definitions += others[0]
        ignored += others[1]
        if len(definitions) + ignored > MAX_DEFINITIONS:
            return None
    return definitions, ignored


def rows_by_scan(buffer: NDArray[np.uint8], stop_at: NDArray[np.bool_], max_records: int) -> Rows:
    """Find messages by scanning records up to the first unreadable one (``Rows.end``).

    Args:
        buffer: Shape (B,).
        stop_at: Mask of the operation codes before which to stop.
        max_records: Maximum number of records.

    Raises:
        BrokenRecordError: More than ``max_records`` records, or too many definitions.
    """
    begins, end, codes = _scan(buffer, stop_at, max_records + 1)
    if len(begins) > max_records:
        raise BrokenRecordError(f"holds more than {max_records} records")
    is_message = codes == Op.MESSAGE
    offset = begins[is_message]
    ends = np.append(begins, end)[1:]
    after = ends[is_message]
    short = np.flatnonzero(after - offset < MESSAGE_HEAD.itemsize)
    if len(short):  # a message shorter than its fields: nothing after it is trusted
        end = int(offset[short[0]])
        offset = offset[: short[0]]
        after = after[: short[0]]
    head = heads_at(buffer, offset)
    return Rows(
        buffer,
        offset,
        after,
        head.channel,
        head.sequence.copy(),
        head.log.copy(),
        head.publish.copy(),
        *_definitions(buffer, begins, ends, codes, end),
        end,
    )


def _scan(buffer: Bytes, stop_at: NDArray[np.bool_], max_records: int) -> tuple[Int64s, int, Bytes]:
    """Return the offsets of the records, the end of the last one, and their operation codes.

    The offset of a record depends on the length of the previous one, so the scan cannot be
    vectorised. A plain loop takes 0.15 us per record, a quarter of the total reading time. A loop
    compiled by Numba was faster only from four million records on, and its import took 140 MB of
    memory. The scan ends at the first record that is incomplete or has operation code 0.
    """
    view, unpack = buffer.data, PREFIX.unpack_from
    stops = frozenset(np.flatnonzero(stop_at).tolist()) | {0}
    at, size, last = 0, len(buffer), len(buffer) - PREFIX.size
    offsets: list[int] = []
    codes = bytearray()
    while at <= last and len(offsets) < max_records:
        code, length = unpack(view, at)
        after = at + PREFIX.size + length
        if after > size or code in stops:
            break
        offsets.append(at)
        codes.append(code)
        at = after
    return np.array(offsets, dtype=np.int64), at, np.frombuffer(codes, dtype=np.uint8)


def _definitions(
    buffer: Bytes, begins: Int64s, ends: Int64s, codes: Bytes, end: int
) -> tuple[list[Definition], int]:
    wanted = ((codes == Op.SCHEMA) | (codes == Op.CHANNEL)) & (begins < end)
    at = np.flatnonzero(wanted)
    if len(at) > MAX_DEFINITIONS:
        raise BrokenRecordError(f"holds more than {MAX_DEFINITIONS} schemas and channels")
    definitions = [
        Definition(b, code, buffer[b + PREFIX.size : e].tobytes())
        for b, e, code in zip(
            begins[at].tolist(), ends[at].tolist(), codes[at].tolist(), strict=True
        )
    ]
    messages = int(((codes == Op.MESSAGE) & (begins < end)).sum())
    return definitions, int((begins < end).sum()) - messages - len(definitions)


def _others(buffer: NDArray[np.uint8], begin: int, end: int) -> tuple[list[Definition], int] | None:
    """Parse the records between two indexed messages; None if invalid or if one is a message."""
    view, at, ignored = buffer.data, begin, 0
    found: list[Definition] = []
    while at < end:
        if at + PREFIX.size > end:
            return None
        opcode, length = PREFIX.unpack_from(view, at)
        after = at + PREFIX.size + length
        if after > end or opcode in (0, Op.MESSAGE) or NEVER_IN_A_CHUNK[opcode]:
            return None
        if opcode in (Op.SCHEMA, Op.CHANNEL):
            found.append(Definition(at, opcode, bytes(view[at + PREFIX.size : after])))
        else:
            ignored += 1
        if len(found) + ignored > MAX_DEFINITIONS:
            return None
        at = after
    return found, ignored


def contradicts(rows: Rows, indexes: Sequence[MessageIndex]) -> bool:
    """Return whether an index refers to a message that is not in ``rows``."""
    rows = rows.in_stored_order()
    for index in indexes:
        offsets = index.entries["offset"]
        if not len(offsets):
            continue
        if not len(rows):
            return True
        where = np.searchsorted(rows.offset, offsets.astype(np.int64))
        where = np.minimum(where, len(rows) - 1)
        same = (
            (rows.offset[where].astype(np.uint64) == offsets)
            & (rows.channel[where] == index.channel_id)
            & (rows.log[where] == index.entries["log"])
        )
        if not same.all():
            return True
    return False
