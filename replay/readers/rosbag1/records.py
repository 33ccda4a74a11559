"""Parser of the records of the ROS 1 bag format 2.0.

A record is ``<u32 header length> <header> <u32 body length> <body>``. A header is a sequence of
``<u32 length> name=value``. No length is trusted: the parsers return None for a record that does
not fit or lacks a required field.
"""

import os
import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.remote.ranges import RangedFile
from crosscue.replay.seal.touched import Touched

MAGIC: Final = b"#ROSBAG V2.0\n"
MESSAGE: Final = 2
BAG_HEADER: Final = 3
INDEX: Final = 4
CHUNK: Final = 5
CHUNK_INFO: Final = 6
CONNECTION: Final = 7

# Maximum plausible length of a record header; real headers are shorter than a kilobyte.
HEADER_BYTES: Final = 1 << 20

_U32 = struct.Struct("<I")
_U64 = struct.Struct("<Q")
_TIME = struct.Struct("<II")
_FIRST_LOOK: Final = 512
_AHEAD: Final = 1 << 20
_NEEDED: Final[dict[int, dict[bytes, int | None]]] = {
    MESSAGE: {b"conn": 4, b"time": 8},
    BAG_HEADER: {b"index_pos": 8, b"conn_count": 4, b"chunk_count": 4},
    INDEX: {b"ver": 4, b"conn": 4, b"count": 4},
    CHUNK: {b"compression": None, b"size": 4},
    CHUNK_INFO: {b"ver": 4, b"chunk_pos": 8, b"start_time": 8, b"end_time": 8, b"count": 4},
    CONNECTION: {b"conn": 4, b"topic": None},
}


@dataclass(frozen=True, slots=True)
class BagRecord:
    """The header of a record, and the position of its body.

    Attributes:
        at: Byte offset of the record.
        op: Kind of the record.
        fields: Header fields as stored; the required fields exist and have the right sizes.
        body: Byte offset of the body.
        size: Declared size of the body in bytes.
    """

    at: int
    op: int
    fields: dict[bytes, bytes]
    body: int
    size: int

    @property
    def end(self) -> int:
        """Offset one past the record's last byte."""
        return self.body + self.size

    def u32(self, name: bytes) -> int:
        """Return a four-byte field."""
        return int(_U32.unpack(self.fields[name])[0])

    def u64(self, name: bytes) -> int:
        """Return an eight-byte field."""
        return int(_U64.unpack(self.fields[name])[0])

    def time_ns(self, name: bytes) -> int:
        """Return a field of seconds and nanoseconds in nanoseconds."""
        seconds, nanos = _TIME.unpack(self.fields[name])
        return int(seconds) * 1_000_000_000 + int(nanos)


def parse_fields(header: bytes) -> dict[bytes, bytes] | None:
    """Parse the fields of a record header; None if they do not fill it exactly."""
    fields: dict[bytes, bytes] = {}
    at = 0
    while at < len(header):
        if at + 4 > len(header):
            return None
        stop = at + 4 + _U32.unpack_from(header, at)[0]
        name, equals, value = header[at + 4 : stop].partition(b"=")
        if stop > len(header) or not equals:
            return None
        fields[name] = value
        at = stop
    return fields


def record_kind(fields: dict[bytes, bytes] | None) -> int | None:
    """Return the kind of a record with these header fields; None if they are invalid."""
    if fields is None or len(fields.get(b"op", b"")) != 1:
        return None
    op = fields[b"op"][0]
    needed = _NEEDED.get(op)
    if needed is None:
        return None
    for name, size in needed.items():
        if name not in fields or (size is not None and len(fields[name]) != size):
            return None
    return op


def record_at(source: bytes | memoryview, at: int, base: int = 0) -> BagRecord | None:
    """Parse the record at ``at`` of ``source``; None if its header is invalid.

    The body may extend beyond ``source``.

    Args:
        source: Bytes with at least the record's header.
        at: Offset of the record in ``source``.
        base: Offset that is added to every offset of the result.
    """
    if at + 4 > len(source):
        return None
    body = at + 8 + int(_U32.unpack_from(source, at)[0])
    if body > len(source) or body - at > HEADER_BYTES:
        return None
    fields = parse_fields(bytes(source[at + 4 : body - 4]))
    op = record_kind(fields)
    if op is None or fields is None:
        return None
    size = int(_U32.unpack_from(source, body - 4)[0])
    return BagRecord(base + at, op, fields, base + body, size)


@dataclass(frozen=True, slots=True, eq=False)
class BagFile:
    """Random access to an open file, without a map because a shrinking map kills the process.

    Attributes:
        fd: Open file descriptor.
        size: File size in bytes when it was opened.
        path: Path of the file in ``touched``.
        touched: Record of the bytes read, for a seal.
    """

    fd: int
    size: int
    path: Path = field(default=Path(), kw_only=True)
    touched: Touched = field(default_factory=Touched, kw_only=True)

    def bytes_at(self, start: int, stop: int) -> bytes:
        """Read the bytes from ``start`` to ``stop``; fewer at the file's end."""
        parts: list[bytes] = []
        while start < stop and (part := os.pread(self.fd, stop - start, start)):
            parts.append(part)
            self.touched.add(self.path, start, len(part))
            start += len(part)
        return parts[0] if len(parts) == 1 else b"".join(parts)

    def expect(self, ranges: Sequence[tuple[int, int]]) -> None:
        """Announce sorted ranges that are going to be read; a local file ignores them."""

    def record(self, at: int) -> BagRecord | None:
        """Read the record at byte ``at``; None if it is invalid or does not fit into the file."""
        look = self.bytes_at(at, at + _FIRST_LOOK)
        if len(look) >= 4:
            header = int(_U32.unpack_from(look, 0)[0])
            if _FIRST_LOOK < header + 8 <= HEADER_BYTES:
                look = self.bytes_at(at, at + header + 8)
        return record_at(look, 0, at)

    def whole_record(self, at: int) -> BagRecord | None:
        """Read the record at byte ``at``; None unless its complete body is in the file."""
        record = self.record(at)
        return record if record is not None and record.end <= self.size else None


@dataclass(frozen=True, slots=True, eq=False)
class RangedBagFile(BagFile):
    """A remote bag, of which only the bytes read are fetched."""

    ranged: RangedFile

    def bytes_at(self, start: int, stop: int) -> bytes:
        """Read the bytes from ``start`` to ``stop``; fewer at the object's end."""
        size = max(0, stop - start)
        return bytes(self.ranged.at_least(start, size)[:size])

    def expect(self, ranges: Sequence[tuple[int, int]]) -> None:
        """Announce sorted ranges that are going to be read, so that larger pieces are fetched."""
        self.ranged.expect(ranges)


@dataclass(frozen=True, slots=True, eq=False)
class AheadBagFile(BagFile):
    """A bag with a read-ahead of a MiB, for many small consecutive records.

    Attributes:
        source: The underlying bag.
        held: The bytes read last, and their offset.
    """

    source: BagFile
    held: list[tuple[int, bytes]] = field(default_factory=list)

    def bytes_at(self, start: int, stop: int) -> bytes:
        """Read the bytes from ``start`` to ``stop``; fewer at the file's end."""
        stop = min(stop, self.size)
        for begin, raw in self.held:
            if begin <= start and stop <= begin + len(raw):
                return raw[start - begin : stop - begin]
        raw = self.source.bytes_at(start, max(stop, min(start + _AHEAD, self.size)))
        self.held[:] = [(start, raw)]
        return raw[: max(0, stop - start)]


@dataclass(frozen=True, slots=True)
class Connection:
    """The stream of one publisher.

    Attributes:
        conn: Number of the connection in the bag.
        topic: Topic under which the messages are stored.
        type_name: ROS 1 message type.
        definition: Full message definition, as stored.
        md5sum: Hash of the definition, as stored.
        published: Topic under which they were published; it differs only if renamed or damaged.
    """

    conn: int
    topic: str
    type_name: str
    definition: bytes
    md5sum: bytes
    published: str


def connection_of(record: BagRecord, body: bytes, largest: int) -> Connection | None:
    """Parse a connection record; None if its body is damaged or exceeds ``largest`` bytes."""
    fields = parse_fields(body)
    if fields is None or not {b"type", b"message_definition"} <= fields.keys():
        return None
    if len(fields[b"message_definition"]) > largest:
        return None
    topic = record.fields[b"topic"]
    return Connection(
        record.u32(b"conn"),
        _text(topic),
        _text(fields[b"type"]),
        fields[b"message_definition"],
        fields.get(b"md5sum", b""),
        _text(fields.get(b"topic", topic)),
    )


def _text(raw: bytes) -> str:
    return raw.decode("utf-8", "backslashreplace")


@dataclass(frozen=True, slots=True)
class ChunkInfo:
    """The entry of a chunk in the index section.

    Attributes:
        at: Byte offset of the chunk record.
        start_ns: First log time in the chunk.
        end_ns: Last log time in the chunk.
        counts: Number of messages by connection.
    """

    at: int
    start_ns: int
    end_ns: int
    counts: dict[int, int]


def chunk_info_of(record: BagRecord, body: bytes) -> ChunkInfo | None:
    """Parse a chunk info record; None if its body contradicts its header."""
    if record.u32(b"ver") != 1 or len(body) != 8 * record.u32(b"count"):
        return None
    pairs = np.frombuffer(body, dtype="<u4").reshape(-1, 2)
    counts = {int(conn): int(count) for conn, count in pairs}
    start, end = record.time_ns(b"start_time"), record.time_ns(b"end_time")
    return ChunkInfo(record.u64(b"chunk_pos"), start, end, counts)


@dataclass(frozen=True, slots=True, eq=False)
class Entries:
    """The index records after one chunk, sorted by offset.

    Attributes:
        offset: Shape (N,), int64: offset of each message record in the decompressed chunk.
        conn: Shape (N,), int64: connection of each message.
        log_ns: Shape (N,), int64: log times.
    """

    offset: NDArray[np.int64]
    conn: NDArray[np.int64]
    log_ns: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.offset)

    def counts(self) -> dict[int, int]:
        """Return the number of messages by connection."""
        return tally(self.conn)


_FEW_NUMBERS: Final = 65_536


def tally(conn: NDArray[np.int64]) -> dict[int, int]:
    """Count the occurrences of each connection number; damaged numbers may be large."""
    if len(conn) and conn.max() < _FEW_NUMBERS:
        counts = np.bincount(conn)
        return {int(c): int(counts[c]) for c in np.flatnonzero(counts)}
    conns, counts = np.unique(conn, return_counts=True)
    return {int(c): int(n) for c, n in zip(conns, counts, strict=True)}


_ENTRY: Final = np.dtype([("sec", "<u4"), ("nsec", "<u4"), ("offset", "<u4")])


def join_index_records(parts: list[tuple[int, bytes]]) -> Entries:
    """Join index records, passed as connection and body."""
    tables: list[NDArray[np.void]] = [np.frombuffer(body, dtype=_ENTRY) for _, body in parts]
    joined = np.concatenate(tables) if tables else np.empty(0, dtype=_ENTRY)
    lengths = [len(table) for table in tables]
    conn = np.repeat(np.array([c for c, _ in parts], dtype=np.int64), lengths)
    offset = joined["offset"].astype(np.int64)
    log_ns = joined["sec"].astype(np.int64) * 1_000_000_000 + joined["nsec"]
    order = np.argsort(offset, kind="stable")
    return Entries(offset[order], conn[order], log_ns[order])
