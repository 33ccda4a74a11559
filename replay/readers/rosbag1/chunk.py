"""Decompression of a chunk of a ROS 1 bag within limits, and columns of its messages.

The reader relies on the chunk's bytes. The index records after a chunk locate its messages without
a step per message. They are trusted only if the messages fill the chunk exactly and have the same
connections and times. After damaged bytes, the index locates the next message.
"""

from __future__ import annotations

import bz2
import struct
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from crosscue.replay.columns import Bytes, Int64s

from .records import (
    CONNECTION,
    MESSAGE,
    Connection,
    Entries,
    connection_of,
    parse_fields,
    record_at,
    record_kind,
    tally,
)

DAMAGED_BYTES: Final = "damaged bytes in a chunk"
DISAGREES: Final = "record and index disagree"
INFLATE: Final = "damaged compressed chunk"
CUT: Final = "file is cut"
TOO_LARGE: Final = "chunk over the size limit"
TOO_MANY: Final = "more records in a chunk than the limit"

# Length of a message record's header with op, conn and time, in any order.
_HEADER: Final = 38
_HEAD: Final = 4 + _HEADER + 4
_U32 = struct.Struct("<I")
_FIRST_RUN: Final = 16
# Number of consecutive plausible messages accepted after damaged bytes without an index.
_IN_A_ROW: Final = 3
_DAY_NS: Final = 86_400 * 10**9
_LONGEST_RUN: Final = 65_536
_NO_STEPS: Final = (np.empty(0, np.int64),) * 5


@dataclass(frozen=True, slots=True)
class Inflated:
    """The decompressed contents of a chunk.

    Attributes:
        raw: The records.
        is_checked: True if a checksum over all of ``raw`` was verified.
        fault: Reason why ``raw`` is not the complete chunk, or empty.
        sizes: The declared and the actual size, if they differ; else empty.
        unused: Stored bytes after the end of the compressed content.
    """

    raw: bytes
    is_checked: bool
    fault: str = ""
    sizes: str = ""
    unused: int = 0


def inflate_records(compression: bytes, stored: bytes, size: int, is_framed: bool) -> Inflated:
    """Decompress at most ``size`` bytes of a chunk's records.

    Args:
        compression: Compression in the chunk's header.
        stored: The chunk's body, followed by later bytes if its length is unknown.
        size: Decompressed size in the header, which the caller has checked against the limit.
        is_framed: True if ``stored`` is exactly the body.
    """
    if compression == b"none":
        raw = stored if is_framed else stored[:size]
        return Inflated(raw, is_checked=False, fault=CUT if len(raw) < size else "")
    try:
        if compression == b"bz2":
            return _inflate_bz2(stored, size)
        if compression == b"lz4":
            return _inflate_lz4(stored, size)
    except (OSError, ValueError, EOFError, RuntimeError, MemoryError):
        return Inflated(b"", is_checked=False, fault=INFLATE)
    return Inflated(b"", is_checked=False, fault="chunk with an unknown compression")


def _inflate_bz2(stored: bytes, size: int) -> Inflated:
    stream = bz2.BZ2Decompressor()
    raw = stream.decompress(stored, max_length=size + 1)
    return _ended(raw, size, stream.eof, True, stream.unused_data)


def _inflate_lz4(stored: bytes, size: int) -> Inflated:
    from lz4.frame import LZ4FrameDecompressor

    stream = LZ4FrameDecompressor()
    raw = stream.decompress(stored, max_length=size + 1)
    is_checked = len(stored) > 4 and bool(stored[4] & 0x14)
    return _ended(raw, size, bool(stream.eof), is_checked, stream.unused_data)


def _ended(
    raw: bytes, size: int, is_at_end: bool, is_checked: bool, unused: bytes | None
) -> Inflated:
    if is_at_end and len(raw) == size:
        return Inflated(raw, is_checked, unused=len(unused or b""))
    if is_at_end or len(raw) > size:
        produced = "more" if len(raw) > size else f"{len(raw)} bytes"
        sizes = f"inflates to {produced}, declares {size} bytes"
        return Inflated(b"", is_checked=False, fault=INFLATE, sizes=sizes)
    return Inflated(raw, is_checked=False, fault=CUT)


@dataclass(frozen=True, slots=True, eq=False)
class ChunkRows:
    """The messages of one chunk, in stored order.

    Attributes:
        conn: Shape (N,), int64: connection of each message.
        log_ns: Shape (N,), int64: log times.
        start: Shape (N,), int64: offset of the first payload byte.
        stop: Shape (N,), int64: offset one past the last payload byte.
        connections: Connection records in the chunk.
        fault: Reason why there may have been more messages, or empty.
        fault_at: Offset of the fault in the decompressed chunk, or -1.
    """

    conn: Int64s
    log_ns: Int64s
    start: Int64s
    stop: Int64s
    connections: tuple[Connection, ...] = ()
    fault: str = ""
    fault_at: int = -1

    def counts(self) -> dict[int, int]:
        """Return the number of messages by connection."""
        return tally(self.conn)

    def take(self, keep: NDArray[np.bool_]) -> ChunkRows:
        """Return the selected messages, with all other attributes."""
        columns = (self.conn[keep], self.log_ns[keep], self.start[keep], self.stop[keep])
        return ChunkRows(*columns, self.connections, self.fault, self.fault_at)


@dataclass(frozen=True, slots=True, eq=False)
class _Layout:
    """One writer's order of the fields in a message record's header.

    Attributes:
        head: Shape (46,), uint8: a header of that layout.
        is_fixed: Shape (46,), bool: mask of the bytes that are equal in all such headers.
        conn: Offset of the connection number.
        time: Offset of the time.
    """

    head: Bytes
    is_fixed: NDArray[np.bool_]
    conn: int
    time: int


def _layout_of(head: bytes) -> _Layout | None:
    if len(head) < _HEAD or _U32.unpack_from(head, 0)[0] != _HEADER:
        return None
    header = head[4 : 4 + _HEADER]
    if record_kind(parse_fields(header)) != MESSAGE:
        return None
    places: dict[bytes, int] = {}
    at = 4
    while at < 4 + _HEADER:
        size = _U32.unpack_from(head, at)[0]
        places[bytes(head[at + 4 : at + 4 + size].partition(b"=")[0])] = at
        at += 4 + size
    conn, time = places[b"conn"] + 9, places[b"time"] + 9
    is_fixed = np.ones(_HEAD, dtype=np.bool_)
    is_fixed[conn : conn + 4] = False
    is_fixed[time : time + 8] = False
    is_fixed[_HEAD - 4 :] = False
    return _Layout(np.frombuffer(head, dtype=np.uint8, count=_HEAD), is_fixed, conn, time)


def _heads(
    buffer: Bytes, at: Int64s, layout: _Layout
) -> tuple[NDArray[np.bool_], Int64s, Int64s, Int64s]:
    """Return which message headers are valid, their connections, log times and payload ends."""
    heads = sliding_window_view(buffer, _HEAD)[at]
    fits = (heads[:, layout.is_fixed] == layout.head[layout.is_fixed]).all(axis=1)
    conn = _u32(heads, layout.conn)
    log_ns = _u32(heads, layout.time) * 1_000_000_000 + _u32(heads, layout.time + 4)
    return fits, conn, log_ns, at + _HEAD + _u32(heads, _HEAD - 4)


def _u32(heads: Bytes, at: int) -> Int64s:
    return heads[:, at : at + 4].copy().view("<u4")[:, 0].astype(np.int64)


def read_chunk(
    inflated: Inflated, entries: Entries | None, largest: int, max_records: int
) -> ChunkRows:
    """Find the messages of a decompressed chunk.

    Args:
        inflated: Records of the chunk.
        entries: Index records after the chunk, or None.
        largest: Maximum size of a message definition in bytes.
        max_records: Maximum number of records in a chunk.
    """
    if entries is not None and len(entries) and not inflated.fault:
        rows = _by_index(inflated.raw, entries, largest)
        if rows is not None and len(rows.conn) <= max_records:
            return rows
    return _by_steps(inflated, entries, largest, max_records)


def _by_index(raw: bytes, entries: Entries, largest: int) -> ChunkRows | None:
    """Return the rows at the index's offsets, if they and connection records fill ``raw``."""
    buffer = np.frombuffer(raw, dtype=np.uint8)
    at = entries.offset
    if at[-1] + _HEAD > len(raw):
        return None
    layout = _layout_of(raw[at[0] : at[0] + _HEAD])
    if layout is None:
        return None
    fits, conn, log_ns, stop = _heads(buffer, at, layout)
    if not (fits & (conn == entries.conn) & (log_ns == entries.log_ns)).all():
        return None
    ends = np.concatenate(([0], stop))
    starts = np.concatenate((at, [len(raw)]))
    connections: list[Connection] = []
    for gap in np.flatnonzero(ends != starts):
        found = _connections_between(raw, int(ends[gap]), int(starts[gap]), largest)
        if found is None:
            return None
        connections += found
    return ChunkRows(conn, log_ns, at + _HEAD, stop, tuple(connections))


def _connections_between(raw: bytes, at: int, stop: int, largest: int) -> list[Connection] | None:
    found: list[Connection] = []
    while at < stop:
        record = record_at(memoryview(raw), at)
        if record is None or record.op != CONNECTION or record.end > stop:
            return None
        connection = connection_of(record, raw[record.body : record.end], largest)
        if connection is None:
            return None
        found.append(connection)
        at = record.end
    return found if at == stop else None


@dataclass(slots=True)
class _Steps:
    """Rows collected while stepping through a chunk.

    Attributes:
        parts: Columns of rows: record, connection, log time, start and stop of the payload.
        connections: Connection records.
    """

    parts: list[tuple[Int64s, ...]] = field(default_factory=list)
    connections: list[Connection] = field(default_factory=list)

    def last(self, stop: int) -> int | None:
        """Return the offset of the last row if it ends at ``stop``, else None."""
        part = self.parts[-1] if self.parts else _NO_STEPS
        return int(part[0][-1]) if len(part[0]) and part[4][-1] == stop else None


def _by_steps(
    inflated: Inflated, entries: Entries | None, largest: int, max_records: int
) -> ChunkRows:
    """Find rows by stepping from record to record; skip damage with the help of the index."""
    raw = inflated.raw
    steps = _Steps()
    at, records, run = 0, 0, _FIRST_RUN
    fault, fault_at = inflated.fault, -1
    while at < len(raw):
        if records > max_records:
            fault, fault_at = TOO_MANY, at
            break
        taken, at = _run_of_messages(raw, at, steps, run)
        records += taken + 1
        run = min(2 * run, _LONGEST_RUN) if taken == run else _FIRST_RUN
        if taken == run or at >= len(raw):
            continue
        after = _one_record(raw, at, steps, largest)
        if after is not None:
            at = after
            continue
        onward = _next_plausible(raw, at, steps) if entries is None else None
        onward = onward or _next_confirmed(raw, at, entries)
        is_tail_of_cut = inflated.fault == CUT and onward is None
        if fault_at < 0:
            fault, fault_at = fault or DAMAGED_BYTES, at
        is_confirmed = entries is not None and at in entries.offset
        if not is_tail_of_cut and not is_confirmed and steps.last(at) is not None:
            # Its length is not confirmed.
            steps.parts[-1] = tuple(column[:-1] for column in steps.parts[-1])
        if onward is None:
            break
        at = onward
    columns = (np.concatenate(parts) for parts in zip(_NO_STEPS, *steps.parts, strict=True))
    offsets, conn, log_ns, start, stop = columns
    rows = ChunkRows(conn, log_ns, start, stop, tuple(steps.connections), fault, fault_at)
    if entries is None or inflated.is_checked:
        return rows
    return _without_disputed(raw, rows, offsets, entries)


def _run_of_messages(raw: bytes, at: int, steps: _Steps, max_count: int) -> tuple[int, int]:
    """Collect up to ``max_count`` messages of one layout; return their number and end."""
    layout = _layout_of(raw[at : at + _HEAD])
    if layout is None:
        return 0, at
    places: list[int] = []
    here, size = at, len(raw)
    unpack = _U32.unpack_from
    while len(places) < max_count and here + _HEAD <= size and unpack(raw, here)[0] == _HEADER:
        after = here + _HEAD + unpack(raw, here + _HEAD - 4)[0]
        if after > size:
            break
        places.append(here)
        here = after
    if not places:
        return 0, at
    offsets = np.array(places, dtype=np.int64)
    fits, conn, log_ns, stop = _heads(np.frombuffer(raw, dtype=np.uint8), offsets, layout)
    good = len(places) if fits.all() else int(np.argmin(fits))
    columns = (offsets, conn, log_ns, offsets + _HEAD, stop)
    steps.parts.append(tuple(column[:good] for column in columns))
    return good, int(stop[good - 1])


def _one_record(raw: bytes, at: int, steps: _Steps, largest: int) -> int | None:
    """Process a connection or an unusual message; return its end, or None if damaged."""
    record = record_at(memoryview(raw), at)
    if record is None or record.end > len(raw):
        return None
    if record.op == MESSAGE:
        columns = (at, record.u32(b"conn"), record.time_ns(b"time"), record.body, record.end)
        steps.parts.append(tuple(np.array([value], np.int64) for value in columns))
        return record.end
    if record.op != CONNECTION:
        return None
    connection = connection_of(record, raw[record.body : record.end], largest)
    if connection is None:
        return None
    steps.connections.append(connection)
    return record.end


def _next_confirmed(raw: bytes, at: int, entries: Entries | None) -> int | None:
    """Return the next indexed offset at which a message agrees with the index."""
    if entries is None:
        return None
    first = int(np.searchsorted(entries.offset, at, side="right"))
    for i in range(first, len(entries)):
        if _is_confirmed(raw, entries, i):
            return int(entries.offset[i])
    return None


def _next_plausible(raw: bytes, at: int, steps: _Steps) -> int | None:
    """Return the next offset with several consecutive plausible messages, without an index.

    The message that led to ``at`` may have a damaged length, so the search starts inside it.
    """
    last = steps.last(at)
    begin = (at if last is None else last) + 1
    known = {int(conn) for part in steps.parts for conn in np.unique(part[1])}
    last_ns = next((int(part[2][-1]) for part in reversed(steps.parts) if len(part[2])), None)
    found = raw.find(_U32.pack(_HEADER), begin)
    while found >= 0:
        if _is_consecutive(raw, found, known, last_ns):
            return found
        found = raw.find(_U32.pack(_HEADER), found + 1)
    return None


def _is_consecutive(raw: bytes, at: int, known: set[int], near_ns: int | None) -> bool:
    """Return whether ``_IN_A_ROW`` plausible messages, or fewer up to the end, start at ``at``."""
    for _ in range(_IN_A_ROW):
        if at == len(raw):
            return True
        record = record_at(memoryview(raw)[at : at + _HEAD], 0, at)
        if record is None or record.op != MESSAGE or record.end > len(raw):
            return False
        if known and record.u32(b"conn") not in known:
            return False
        near_ns = record.time_ns(b"time") if near_ns is None else near_ns
        if abs(record.time_ns(b"time") - near_ns) > _DAY_NS:
            return False
        at = record.end
    return True


def _is_confirmed(raw: bytes, entries: Entries, i: int) -> bool:
    record = record_at(memoryview(raw), int(entries.offset[i]))
    if record is None or record.op != MESSAGE or record.end > len(raw):
        return False
    found = record.u32(b"conn"), record.time_ns(b"time")
    return found == (entries.conn[i], entries.log_ns[i])


def _without_disputed(raw: bytes, rows: ChunkRows, at: Int64s, entries: Entries) -> ChunkRows:
    """Drop rows that contradict the index, because no checksum decides which is right."""
    if not len(at) or not len(entries):
        return rows
    place = np.minimum(np.searchsorted(entries.offset, at), len(entries) - 1)
    is_listed = entries.offset[place] == at
    differs = (entries.conn[place] != rows.conn) | (entries.log_ns[place] != rows.log_ns)
    is_bad = is_listed & differs
    for i in np.flatnonzero(~np.isin(entries.offset, at)):
        if _is_confirmed(raw, entries, int(i)):
            covering = int(np.searchsorted(at, entries.offset[i])) - 1
            if covering >= 0 and entries.offset[i] < rows.stop[covering]:
                is_bad[covering] = True
    if not is_bad.any():
        return rows
    fault_at = int(at[np.argmax(is_bad)]) if rows.fault_at < 0 else rows.fault_at
    return replace(rows.take(~is_bad), fault=rows.fault or DISAGREES, fault_at=fault_at)
