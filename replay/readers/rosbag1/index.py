"""Contents of a ROS 1 bag, from its index section or from a walk over its records.

Outside chunks, only a record's own length states its end. A message there is accepted if its end is
the start of another record, of a record with a damaged but recognisable header, or the file's end.
After damage, reading resumes at the next indexed chunk, or at earlier consecutive records that are
plausible by their kinds, sizes, connections and times.
"""

import re
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Final

from crosscue.replay.limits import Limits

from .chunk import inflate_records, read_chunk
from .records import (
    BAG_HEADER,
    CHUNK,
    CHUNK_INFO,
    CONNECTION,
    INDEX,
    MESSAGE,
    AheadBagFile,
    BagFile,
    BagRecord,
    ChunkInfo,
    Connection,
    Entries,
    chunk_info_of,
    connection_of,
    join_index_records,
    record_at,
)

# Number of consecutive plausible records that are accepted, or fewer up to the file's end.
IN_A_ROW: Final = 3
_SEARCHED_AT_ONCE: Final = 4 << 20
_OP: Final = b"\x04\x00\x00\x00op="
_CHUNK_OP: Final = _OP + bytes([CHUNK])
_BEFORE_OP: Final = 128
# Maximum header length of a record at which reading resumes.
_HEADER_MAX: Final = 256
_DAY_NS: Final = 86_400 * 10**9
_FIELD: Final = re.compile(
    rb"(.{4})(op|conn|time|compression|size|ver|count|topic|chunk_pos|start_time|end_time)=",
    re.DOTALL,
)


class BagResync:
    """Checks records outside chunks, and finds the next records after damage."""

    def __init__(self, file: BagFile, known: Sequence[int], connections: Collection[int]) -> None:
        """Prepare a search.

        Args:
            file: The bag.
            known: Sorted byte offsets of the chunks in the index.
            connections: Numbers of the connections found so far; may be extended later. If empty,
                any number is accepted.
        """
        self._file = file
        self._known = known
        self._connections = connections
        self._near_ns: int | None = None

    def is_believed(self, record: BagRecord) -> bool:
        """Return whether the length of a record outside chunks is confirmed."""
        if record.end > self._file.size:
            return False
        if record.op != MESSAGE:
            return True
        is_right = record.end == self._file.size or self.is_head(record.end)
        if is_right:
            self._near_ns = record.time_ns(b"time")
        return is_right

    def next(self, at: int) -> int | None:
        """Return the offset at or after ``at`` at which reading resumes; None if none exists."""
        place = self._known_chunk(at)
        stop = self._file.size if place is None else place
        found = self._searched(at, stop, _OP, self._goes_on)
        return place if found is None else found

    def next_chunk(self, at: int) -> int | None:
        """Return the start of the next chunk at or after ``at``, by the index or by search."""
        place = self._known_chunk(at)
        if place is not None:
            return place
        return self._searched(at, self._file.size, _CHUNK_OP, self._is_whole_chunk)

    def _known_chunk(self, at: int) -> int | None:
        return next((k for k in self._known if k >= at and self._is_chunk(k)), None)

    def _is_chunk(self, at: int) -> bool:
        record = self._file.record(at)
        return record is not None and record.op == CHUNK

    def _is_whole_chunk(self, at: int) -> bool:
        return self._is_chunk(at) and self._file.whole_record(at) is not None

    def is_head(self, at: int) -> bool:
        """Return whether a record starts at ``at``, possibly with a damaged header."""
        return self._file.record(at) is not None or _was_head(
            self._file.bytes_at(at, at + _HEADER_MAX)
        )

    def _searched(
        self, at: int, stop: int, op: bytes, is_wanted: Callable[[int], bool]
    ) -> int | None:
        """Return the first record from ``at`` on and before ``stop`` with this field, if wanted."""
        while at < stop:
            window = self._file.bytes_at(at, at + _SEARCHED_AT_ONCE + _HEADER_MAX)
            found = -1
            while (found := window.find(op, found + 1)) >= 0:
                for start in range(max(0, found - _BEFORE_OP), found):
                    if at + start >= stop:
                        return None
                    if _heads_record(window, start, found + len(op)) and is_wanted(at + start):
                        return at + start
            at += _SEARCHED_AT_ONCE
        return None

    def _goes_on(self, at: int) -> bool:
        """Return whether consecutive plausible records start at ``at``."""
        near_ns = self._near_ns
        for n in range(IN_A_ROW):
            if at == self._file.size:
                return n > 0
            record = self._file.record(at)
            if record is None or not self._is_plausible(record, near_ns):
                return False
            if record.end > self._file.size:
                return n > 0
            if record.op == CHUNK:
                return True
            near_ns = record.time_ns(b"time") if record.op == MESSAGE else near_ns
            at = record.end
        return True

    def _is_plausible(self, record: BagRecord, near_ns: int | None) -> bool:
        if record.op == INDEX:
            return record.u32(b"ver") == 1 and record.size == 12 * record.u32(b"count")
        if record.op == CHUNK_INFO:
            return record.u32(b"ver") == 1 and record.size == 8 * record.u32(b"count")
        if record.op != MESSAGE:
            return record.op != BAG_HEADER
        if self._connections and record.u32(b"conn") not in self._connections:
            return False
        return near_ns is None or abs(record.time_ns(b"time") - near_ns) <= _DAY_NS


def _heads_record(window: bytes, start: int, op_end: int) -> bool:
    length = int.from_bytes(window[start : start + 4], "little")
    if not op_end <= start + 4 + length <= start + _HEADER_MAX:
        return False
    return record_at(window, start) is not None


def _was_head(head: bytes) -> bool:
    """Return whether these bytes start a record with one damaged header field or length."""
    fields = [
        (found[2], found.start(), found.start() + 4 + int.from_bytes(found[1], "little"))
        for found in _FIELD.finditer(head)
    ]
    if len(fields) < 2 or fields[0][1] < 4:
        return False
    if any(end == 4 + int.from_bytes(head[:4], "little") for _, _, end in fields):
        return True
    first, second = fields[:2]
    return first[0] == b"op" and first[1] == 4 and first[2] == second[1]


ENTRY_BYTES: Final = 12


@dataclass(frozen=True, slots=True)
class ChunkUnit:
    """A chunk with the index records after it.

    Attributes:
        record: The chunk record.
        stored_stop: Offset one past the last byte that may belong to its body.
        is_framed: True if its length, or the size of its uncompressed content, is confirmed by a
            following record or by the file's end.
        end: Start of the next unit.
        entries: Index records, or None if they are missing or damaged.
    """

    record: BagRecord
    stored_stop: int
    is_framed: bool
    end: int
    entries: Entries | None = None


@dataclass(frozen=True, slots=True)
class BytesBetween:
    """Bytes that are not a record.

    Attributes:
        at: Offset of the first byte.
        stop: Offset at which reading resumes, or the file's end.
    """

    at: int
    stop: int


@dataclass(slots=True)
class Contents:
    """Contents of a bag known before its chunks are decompressed.

    Attributes:
        connections: The first record of each connection, by number.
        infos: Chunk infos by the offset of the chunk.
        is_complete: True if ``infos`` lists every chunk of the file.
        gaps: Ranges without a readable record, found by a walk: start and end in bytes.
        first: Offset of the first record.
        index_at: Offset of the index section in the bag header, or 0.
        chunk_count: Number of chunks in the bag header, or -1.
    """

    connections: dict[int, Connection] = field(default_factory=dict)
    infos: dict[int, ChunkInfo] = field(default_factory=dict)
    is_complete: bool = False
    gaps: list[tuple[int, int]] = field(default_factory=list)
    first: int = 0
    index_at: int = 0
    chunk_count: int = -1


def read_index(file: BagFile, index_at: int, largest: int) -> Contents | None:
    """Read the index section at ``index_at``; None unless its records extend to the file's end."""
    contents = Contents(is_complete=True)
    at = index_at
    file = AheadBagFile(file.fd, file.size, file)
    while at < file.size:
        record = file.whole_record(at)
        if record is None or not add_index_record(file, record, contents, largest):
            return None
        at = record.end
    return contents if at == file.size else None


def add_index_record(file: BagFile, record: BagRecord, contents: Contents, largest: int) -> bool:
    """Add a connection or chunk info record; return False for other or damaged records."""
    if record.size > 2 * largest:
        return False
    body = file.bytes_at(record.body, record.end)
    if record.op == CONNECTION and (connection := connection_of(record, body, largest)):
        contents.connections.setdefault(connection.conn, connection)
        return True
    if record.op == CHUNK_INFO and (info := chunk_info_of(record, body)):
        contents.infos[info.at] = info
        return True
    return False


def units(
    file: BagFile, first: int, known: list[int], limits: Limits, connections: Collection[int]
) -> Iterator[ChunkUnit | BagRecord | BytesBetween]:
    """Yield the file's contents in order: chunks with their index, other records, gaps.

    Args:
        file: The bag.
        first: Byte offset of the first record.
        known: Sorted byte offsets of the chunks in the index.
        limits: Limits on the size of an index.
        connections: Numbers of the connections known so far; may be extended later.
    """
    at, resync = first, BagResync(file, known, connections)
    while at < file.size:
        record = file.record(at)
        if record is not None and record.op == CHUNK:
            unit = _chunk_unit(file, record, limits, resync)
            yield unit
            at = unit.end
        elif record is not None and resync.is_believed(record):
            yield record
            at = record.end
        else:
            after = resync.next(at + 1)
            stop = file.size if after is None else after
            yield BytesBetween(at, stop)
            at = stop


def _chunk_unit(file: BagFile, record: BagRecord, limits: Limits, resync: BagResync) -> ChunkUnit:
    is_plain = record.fields[b"compression"] == b"none"
    ends = [record.end, record.body + record.u32(b"size")] if is_plain else [record.end]
    for end in ends:
        if end == file.size:
            return ChunkUnit(record, end, is_framed=True, end=end)
        if end < file.size and resync.is_head(end):
            entries, after = _index_records(file, end, limits)
            return ChunkUnit(record, end, True, after, entries)
    # The records of an uncompressed chunk would be mistaken for records outside chunks.
    onward = resync.next_chunk(record.body) if is_plain else resync.next(record.body)
    stop = file.size if onward is None else onward
    if record.end <= stop and record.u32(b"size") == record.size:
        return ChunkUnit(record, record.end, is_framed=True, end=record.end)
    return ChunkUnit(record, stop, is_framed=False, end=stop)


def _index_records(file: BagFile, at: int, limits: Limits) -> tuple[Entries | None, int]:
    """Read the index records from ``at`` on (None if one is invalid), and return their end."""
    parts: list[tuple[int, bytes]] = []
    listed = 0
    is_sound = True
    while (record := file.whole_record(at)) is not None and record.op == INDEX:
        count = record.u32(b"count")
        listed += count
        if record.u32(b"ver") != 1 or record.size != count * ENTRY_BYTES:
            is_sound = False
        elif listed <= limits.records_per_chunk:
            parts.append((record.u32(b"conn"), file.bytes_at(record.body, record.end)))
        else:
            is_sound = False
        at = record.end
    return (join_index_records(parts) if is_sound and parts else None), at


def scan_records(file: BagFile, first: int, limits: Limits) -> Contents:
    """Collect the contents without an index section; decompress only for new connections."""
    contents = Contents()
    chunks: set[int] = set()
    is_whole = True
    for unit in units(file, first, [], limits, contents.connections):
        if isinstance(unit, ChunkUnit):
            chunks.add(unit.record.at)
            if unit.record.end > file.size and not unit.is_framed:
                contents.gaps.append((unit.record.at, file.size))
            is_whole &= unit.is_framed
            if unit.entries is None or not unit.entries.counts().keys() <= (
                contents.connections.keys()
            ):
                _learn_from_chunk(file, unit, contents, limits)
        elif isinstance(unit, BytesBetween):
            is_whole = False
            contents.gaps.append((unit.at, unit.stop))
        elif unit.op in (CONNECTION, CHUNK_INFO):
            is_whole &= add_index_record(file, unit, contents, limits.schema_bytes)
    contents.is_complete = is_whole and bool(chunks) and chunks == contents.infos.keys()
    return contents


def _learn_from_chunk(file: BagFile, unit: ChunkUnit, contents: Contents, limits: Limits) -> None:
    size = unit.record.u32(b"size")
    if size > limits.chunk_bytes or unit.record.size > limits.chunk_bytes:
        return
    stored = file.bytes_at(unit.record.body, unit.stored_stop)
    inflated = inflate_records(unit.record.fields[b"compression"], stored, size, unit.is_framed)
    rows = read_chunk(inflated, unit.entries, limits.schema_bytes, limits.records_per_chunk)
    for connection in rows.connections:
        contents.connections.setdefault(connection.conn, connection)
