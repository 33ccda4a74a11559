"""Writes MCAP whole or not at all: chunks, message indexes, statistics, every checksum.

The same rows give the same bytes. While it is written the file has another name in the same
folder; the final name appears when everything is on the disk.
"""

from __future__ import annotations

import struct
from collections import Counter, deque
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from types import TracebackType
from typing import Final, Literal, Self, TypeAlias

import numpy as np

from crosscue.replay.columns import Int64s
from crosscue.replay.errors import OutputError
from crosscue.replay.files.checksum import crc32
from crosscue.replay.files.partial_file import PartialFile
from crosscue.replay.files.whole_file import cannot_write

from .mcap_chunks import ChunkRows, Stretch, merged

MAGIC: Final = b"\x89MCAP0\r\n"
LIBRARY: Final = "crosscue"
CHUNK_BYTES: Final = 4 << 20
"""Uncompressed bytes that a chunk aims at."""
WINDOW_BYTES: Final = 8 << 20
"""Bytes that wait to be merged by time before they are cut into chunks."""
CHUNKS_AHEAD: Final = 3
"""Chunks being compressed while others are written."""
THREADS: Final = 2

HEADER, FOOTER, SCHEMA, CHANNEL = 0x01, 0x02, 0x03, 0x04
CHUNK, MESSAGE_INDEX, CHUNK_INDEX = 0x06, 0x07, 0x08
STATISTICS, SUMMARY_OFFSET, DATA_END = 0x0B, 0x0E, 0x0F

Compression: TypeAlias = Literal["zstd", "lz4", "none"]


def _text(text: str) -> bytes:
    raw = text.encode("utf-8")
    return struct.pack("<I", len(raw)) + raw


def _record(opcode: int, content: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(content)) + content


def _map(pairs: Mapping[str, str]) -> bytes:
    content = b"".join(_text(key) + _text(value) for key, value in sorted(pairs.items()))
    return struct.pack("<I", len(content)) + content


@dataclass(frozen=True, slots=True)
class _Packed:
    """A chunk ready to be written.

    Attributes:
        rows: What it holds; ``offset`` counts from the chunk's first record.
        head: The chunk record up to its records.
        stored: The records as stored.
        plain_size: Bytes of its records before compression.
    """

    rows: ChunkRows
    head: bytes
    stored: bytes | memoryview
    plain_size: int


@dataclass(slots=True)
class _Summary:
    schemas: list[bytes] = field(default_factory=list)
    channels: list[bytes] = field(default_factory=list)
    chunks: list[bytes] = field(default_factory=list)
    counts: Counter[int] = field(default_factory=Counter)
    first_ns: int | None = None
    last_ns: int = 0


class McapWriter:
    """One MCAP file with profile ``ros2``. Use it as a context manager.

    Leaving normally gives the file its name; leaving with an error leaves nothing.
    """

    def __init__(
        self,
        path: Path,
        *,
        compression: Compression = "zstd",
        overwrite: bool = False,
        chunk_bytes: int = CHUNK_BYTES,
    ) -> None:
        """Open a file beside ``path`` and write its header.

        Args:
            path: The final name.
            compression: Of chunks.
            overwrite: Replace a file that is there.
            chunk_bytes: Uncompressed bytes that a chunk aims at.

        Raises:
            OutputError: ``path`` exists, or cannot be written.
        """
        if path.is_dir():
            raise OutputError(f"{path}: is a folder; give the name of a file")
        if path.exists() and not overwrite:
            raise OutputError(f"{path}: exists; give another name or --overwrite")
        self.path = path
        self._compress = _compressor(compression)
        self._compression = "" if compression == "none" else compression
        self._chunk_bytes = chunk_bytes
        self._ids: dict[tuple[str, str], int] = {}
        self._schema_ids: dict[tuple[str, str, bytes], int] = {}
        self._new: list[bytes] = []
        self._waiting: list[Stretch] = []
        self._waiting_bytes = 0
        self._summary = _Summary()
        self._data_crc = 0
        self._at = 0
        self._ahead: deque[Future[_Packed]] = deque()
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._partial = PartialFile(path)
            self._file = self._partial.open()
        except OSError as error:
            raise cannot_write(path, error) from None
        self._pool = ThreadPoolExecutor(THREADS)
        self._guarded(lambda: self._data(MAGIC))
        self._guarded(lambda: self._data(_record(HEADER, _text("ros2") + _text(LIBRARY))))

    @property
    def counts(self) -> Mapping[int, int]:
        """Messages taken so far, by channel number."""
        return self._summary.counts

    def add_channel(
        self, topic: str, type_name: str, schema: bytes, schema_encoding: str = "ros2msg"
    ) -> int:
        """Number of the channel for CDR messages of a topic; the same call gives the same one.

        Args:
            topic: Name.
            type_name: ROS 2 spelling (``sensor_msgs/msg/Imu``).
            schema: Complete definition with all dependencies.
            schema_encoding: ``ros2msg`` or ``ros2idl``.

        Raises:
            OutputError: More topics than an MCAP file can number.
        """
        key = (topic, type_name)
        if key in self._ids:
            return self._ids[key]
        if len(self._ids) >= 0xFFFF:
            raise OutputError(f"{self.path}: over 65535 topics; choose some with --topics")
        schema_id = self._schema(type_name, schema_encoding, schema)
        number = self._ids[key] = len(self._ids) + 1
        content = struct.pack("<HH", number, schema_id) + _text(topic) + _text("cdr") + _map({})
        self._define(self._summary.channels, _record(CHANNEL, content))
        return number

    def _schema(self, name: str, encoding: str, schema: bytes) -> int:
        key = (name, encoding, schema)
        if key not in self._schema_ids:
            number = self._schema_ids[key] = len(self._schema_ids) + 1
            content = struct.pack("<H", number) + _text(name) + _text(encoding)
            content += struct.pack("<I", len(schema)) + schema
            self._define(self._summary.schemas, _record(SCHEMA, content))
        return self._schema_ids[key]

    def _define(self, known: list[bytes], record: bytes) -> None:
        known.append(record)
        self._new.append(record)

    def write(self, stretch: Stretch) -> None:
        """Take messages; times must not be negative.

        Raises:
            OutputError: The disk is full.
            ValueError: A time before 1970.
        """
        if not len(stretch.messages):
            return
        if int(stretch.log_ns.min()) < 0 or int(stretch.publish_ns.min()) < 0:
            raise ValueError("MCAP has no times before 1970")
        self._waiting.append(stretch)
        self._waiting_bytes += stretch.stored_bytes
        self._summary.counts[stretch.channel] += len(stretch.messages)
        if self._waiting_bytes >= WINDOW_BYTES:
            self._guarded(self._flush)

    def _flush(self) -> None:
        """Merge what waits, and hand it on chunk by chunk."""
        waiting, self._waiting, self._waiting_bytes = self._waiting, [], 0
        for rows in merged(waiting, self._chunk_bytes):
            definitions, self._new = b"".join(self._new), []
            self._ahead.append(self._pool.submit(self._pack, rows, definitions))
            while len(self._ahead) > CHUNKS_AHEAD:
                self._put(self._ahead.popleft().result())

    def _pack(self, rows: ChunkRows, definitions: bytes) -> _Packed:
        records: bytes | memoryview = rows.records.data
        if definitions:
            records = definitions + rows.records.tobytes()
            rows = ChunkRows(
                rows.records, rows.channel, rows.log_ns, rows.offset + len(definitions)
            )
        stored = self._compress(records)
        head = struct.pack(
            "<QQQI",
            int(rows.log_ns.min()),
            int(rows.log_ns.max()),
            len(records),
            crc32(records),
        )
        head += _text(self._compression) + struct.pack("<Q", len(stored))
        whole = struct.pack("<BQ", CHUNK, len(head) + len(stored)) + head
        return _Packed(rows, whole, stored, len(records))

    def _put(self, chunk: _Packed) -> None:
        begin = self._at
        self._data(chunk.head)
        self._data(chunk.stored)
        index_begin = self._at
        places: dict[int, int] = {}
        for channel, log_ns, offset in _by_channel(chunk.rows):
            places[channel] = self._at
            self._data(_message_index(channel, log_ns, offset))
        first, last = int(chunk.rows.log_ns.min()), int(chunk.rows.log_ns.max())
        offsets = b"".join(struct.pack("<HQ", *pair) for pair in places.items())
        content = struct.pack("<QQQQ", first, last, begin, index_begin - begin)
        content += struct.pack("<I", len(offsets)) + offsets
        content += struct.pack("<Q", self._at - index_begin) + _text(self._compression)
        content += struct.pack("<QQ", len(chunk.stored), chunk.plain_size)
        self._summary.chunks.append(_record(CHUNK_INDEX, content))
        known = self._summary.first_ns
        self._summary.first_ns = first if known is None else min(known, first)
        self._summary.last_ns = max(self._summary.last_ns, last)

    def _data(self, content: bytes | memoryview) -> None:
        self._data_crc = crc32(content, self._data_crc)
        self._at += len(content)
        self._file.write(content)

    def _finish(self) -> None:
        self._flush()
        while self._ahead:
            self._put(self._ahead.popleft().result())
        for record in self._new:
            self._data(record)
        end = _record(DATA_END, struct.pack("<I", self._data_crc))
        self._file.write(end)
        start = self._at + len(end)
        body, offsets = self._summary_section(start)
        offset_start = start + len(body)
        tail = struct.pack("<BQQQ", FOOTER, 20, start, offset_start)
        crc = crc32(tail, crc32(body + offsets))
        self._file.write(body + offsets + tail + struct.pack("<I", crc) + MAGIC)
        self._file.close()
        self._partial.keep()

    def _summary_section(self, start: int) -> tuple[bytes, bytes]:
        summary = self._summary
        groups = (
            (SCHEMA, b"".join(summary.schemas)),
            (CHANNEL, b"".join(summary.channels)),
            (STATISTICS, _record(STATISTICS, self._statistics())),
            (CHUNK_INDEX, b"".join(summary.chunks)),
        )
        body, offsets = b"", b""
        for opcode, content in groups:
            if content:
                place = struct.pack("<BQQ", opcode, start + len(body), len(content))
                offsets += _record(SUMMARY_OFFSET, place)
                body += content
        return body, offsets

    def _statistics(self) -> bytes:
        summary = self._summary
        counts = b"".join(struct.pack("<HQ", *pair) for pair in sorted(summary.counts.items()))
        return (
            struct.pack(
                "<QHIIIIQQ",
                summary.counts.total(),
                len(summary.schemas),
                len(summary.channels),
                0,
                0,
                len(summary.chunks),
                summary.first_ns or 0,
                summary.last_ns,
            )
            + struct.pack("<I", len(counts))
            + counts
        )

    def _guarded(self, step: Callable[[], None]) -> None:
        try:
            step()
        except OSError as error:
            self.discard()
            raise cannot_write(self.path, error) from None

    def close(self) -> None:
        """Finish the file and give it its name.

        Raises:
            OutputError: The disk is full.
        """
        self._guarded(self._finish)
        self._pool.shutdown()

    def discard(self) -> None:
        """Leave nothing behind."""
        self._pool.shutdown(cancel_futures=True)
        # Bytes that cannot be flushed now belong to a file that is removed anyway.
        with suppress(OSError):
            self._file.close()
        self._partial.drop()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if kind is None:
            self.close()
        else:
            self.discard()


def _by_channel(rows: ChunkRows) -> list[tuple[int, Int64s, Int64s]]:
    order = np.argsort(rows.channel, kind="stable")
    channel = rows.channel[order]
    edges = [0, *(np.flatnonzero(np.diff(channel)) + 1).tolist(), len(channel)]
    return [
        (int(channel[a]), rows.log_ns[order[a:b]], rows.offset[order[a:b]])
        for a, b in pairwise(edges)
    ]


def _message_index(channel: int, log_ns: Int64s, offset: Int64s) -> bytes:
    pairs = np.stack([log_ns, offset], axis=1).astype("<u8").tobytes()
    return _record(MESSAGE_INDEX, struct.pack("<HI", channel, len(pairs)) + pairs)


def _compressor(compression: Compression) -> Callable[[bytes | memoryview], bytes | memoryview]:
    if compression == "zstd":
        from zstandard import ZstdCompressor

        # A compressor must not be shared by threads.
        return lambda records: ZstdCompressor().compress(records)
    if compression == "lz4":
        from lz4.frame import compress

        def squeeze(records: bytes | memoryview) -> bytes:
            return bytes(compress(records))

        return squeeze
    return lambda records: records
