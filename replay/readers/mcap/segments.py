"""The recordings in an MCAP file, and their summaries.

A file is one segment, or several if recordings were joined with ``cat``. The footer at the end of
the file locates the summary. If it does not, the file is searched from its start.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

import numpy as np
from isal.isal_zlib import crc32

from crosscue.replay.errors import LogFormatError
from crosscue.replay.limits import Limits
from crosscue.replay.readers.mcap.chunks.chunk_table import ChunkTable, parse_chunk_indexes, run_of
from crosscue.replay.readers.mcap.chunks.inflate import inflate_chunk, inflate_prefix
from crosscue.replay.readers.mcap.chunks.rows import NEVER_IN_A_CHUNK, Definition, rows_by_scan
from crosscue.replay.readers.mcap.damage.find import find_bytes, verified_head

from .bytes import PIECE, ByteFile
from .channels import Declarations, TopicBook
from .records import (
    DATA_END_SIZE,
    FOOTER_SIZE,
    MAGIC,
    PREFIX,
    BrokenRecordError,
    Channel,
    ChunkIndex,
    Op,
    Schema,
    Statistics,
    read_channel,
    read_footer,
    read_schema,
    read_statistics,
)
from .walk import End, How, LooseRecords, UnreadChunk, Walk

MAX_HEADER: Final = 1 << 16
NO_CHUNKS: Final = parse_chunk_indexes(b"", (), (), 0)
DATA_END_PREFIX: Final = PREFIX.pack(Op.DATA_END, DATA_END_SIZE - PREFIX.size)


@dataclass(frozen=True, slots=True)
class Summary:
    """A summary section.

    Attributes:
        schemas: Schemas by number.
        channels: Channels by number.
        statistics: Counts, or None.
        chunks: Index entries of chunks by offset from the file's start.
        is_verified: True if it has a checksum and matches it.
    """

    schemas: Mapping[int, Schema] = field(default_factory=dict)
    channels: Mapping[int, Channel] = field(default_factory=dict)
    statistics: Statistics | None = None
    chunks: ChunkTable = field(default_factory=lambda: NO_CHUNKS)
    is_verified: bool = False

    @property
    def counts_channels(self) -> bool:
        """True if its statistics have counts by channel."""
        counted = self.statistics
        return counted is not None and (bool(counted.by_channel) or not counted.message_count)

    @property
    def mentioned(self) -> frozenset[int]:
        """Numbers of the channels in its counts or indexes."""
        found = frozenset(np.flatnonzero(np.bincount(self.chunks.channel)).tolist())
        return found if self.statistics is None else found | self.statistics.by_channel.keys()

    @property
    def names_all(self) -> bool:
        """True if it declares every mentioned channel, with its schema."""
        if not self.channels:
            return self.statistics is not None and not self.statistics.message_count
        known = self.schemas.keys() | {0}
        is_complete = all(channel.schema_id in known for channel in self.channels.values())
        return is_complete and self.mentioned <= self.channels.keys()


@dataclass(frozen=True, slots=True)
class RecordingSegment:
    """One recording within a file.

    Attributes:
        base: Offset of its magic bytes.
        begin: Offset of the first record after the header.
        end: Offset of its data end record if ``has_end``, else the end of the file.
        has_end: True if its data section is closed.
        data_crc: CRC-32 of the bytes from ``base`` to ``end``, 0 for none.
        summary: Its summary, or None.
        schemas: All schemas known before reading.
        channels: All channels known before reading.
        notices: Remarks on the recording.
        after: Damage after its messages, because of which the file's original contents are
            unknown; empty for none.
    """

    base: int
    begin: int
    end: int
    has_end: bool
    data_crc: int = 0
    summary: Summary | None = None
    schemas: tuple[Schema, ...] = ()
    channels: tuple[Channel, ...] = ()
    notices: tuple[str, ...] = ()
    after: str = ""

    def declarations(self, book: TopicBook) -> Declarations:
        """Return the schemas and channels known before reading."""
        return Declarations(book, self.schemas, self.channels)

    def known_chunks(self, file: ByteFile, limits: Limits) -> Mapping[int, ChunkIndex] | None:
        """Return the known chunks, for a walk; None if not even the end is known."""
        if not self.has_end:
            return None
        if self.summary is None:
            return {}
        is_sure = self.summary.is_verified
        return self.summary.chunks if is_sure else _confirmed(file, self.summary.chunks, limits)


def find_segments(
    file: ByteFile, path: Path, book: TopicBook, limits: Limits
) -> tuple[RecordingSegment, ...]:
    """Find the recordings in a file, and add their topics to ``book``.

    Raises:
        LogFormatError: The file is not MCAP, or has no readable record.
    """
    if not file.size:
        raise LogFormatError(f"{path}: an empty file; nothing was recorded, or the copy failed")
    if bytes(file.peek(0, len(MAGIC))) != MAGIC:
        raise LogFormatError(
            f"{path}: not an MCAP file (it starts without 89 4d 43 41 50 30 0d 0a); check the file"
        )
    segment = _by_footer(file, limits)
    if segment is not None and segment.summary is not None and segment.summary.names_all:
        return (_enter(segment, Declarations(book, *_declared(segment.summary))),)
    segments = (
        (_survey_named(file, segment, book, limits),)
        if segment is not None
        else _survey(file, book, limits)
    )
    if not book.topics and not segments[0].has_end and not _has_header(file, 0):
        raise LogFormatError(
            f"{path}: no readable record after the first 8 bytes; the file was cut"
        )
    return segments


def has_whole_summary(file: ByteFile, limits: Limits) -> bool:
    """Return whether the file ends with a summary that declares every channel."""
    segment = _by_footer(file, limits) if file.size else None
    return segment is not None and segment.summary is not None and segment.summary.names_all


def _by_footer(file: ByteFile, limits: Limits) -> RecordingSegment | None:
    """Return the only segment, if the footer and the summary before it are valid."""
    footer_at = file.size - FOOTER_SIZE - len(MAGIC)
    if footer_at < len(MAGIC) + DATA_END_SIZE:
        return None
    raw = bytes(file.peek(footer_at, FOOTER_SIZE + len(MAGIC)))
    opcode, length = PREFIX.unpack_from(raw)
    if (opcode, length) != (Op.FOOTER, FOOTER_SIZE - PREFIX.size) or not raw.endswith(MAGIC):
        return None
    footer = read_footer(raw[PREFIX.size : FOOTER_SIZE])
    data_end_at = footer.summary_at - DATA_END_SIZE
    if not len(MAGIC) <= data_end_at <= footer_at - DATA_END_SIZE:
        return None
    data_crc = _data_end(file, data_end_at)
    if data_crc is None:
        return None
    try:
        summary = _read_summary(file, 0, footer.summary_at, footer_at, footer.crc, limits)
    except BrokenRecordError:
        return None
    return RecordingSegment(0, _begin(file, 0), data_end_at, True, data_crc, summary)


def _data_end(file: ByteFile, at: int) -> int | None:
    """Return the checksum in the data end record at ``at``; None if it is not one."""
    raw = bytes(file.peek(at, DATA_END_SIZE))
    if len(raw) < DATA_END_SIZE:
        return None
    opcode, length = PREFIX.unpack_from(raw)
    if (opcode, length) != (Op.DATA_END, DATA_END_SIZE - PREFIX.size):
        return None
    return int.from_bytes(raw[PREFIX.size :], "little")


def _has_header(file: ByteFile, base: int) -> bool:
    return _begin(file, base) > base + len(MAGIC)


def _begin(file: ByteFile, base: int) -> int:
    """Return the offset after the header, or after the magic bytes if the header is broken."""
    at = base + len(MAGIC)
    raw = file.peek(at, PREFIX.size)
    if len(raw) < PREFIX.size:
        return at
    opcode, length = PREFIX.unpack(raw)
    after = at + PREFIX.size + length
    return after if opcode == Op.HEADER and length <= MAX_HEADER and after <= file.size else at


def _read_summary(
    file: ByteFile, base: int, begin: int, footer_at: int, crc: int, limits: Limits
) -> Summary:
    """Read the summary between ``begin`` and the footer.

    Raises:
        BrokenRecordError: Its checksum is wrong, its records are invalid, or it is too large.
    """
    if footer_at - begin > limits.chunk_bytes:
        raise BrokenRecordError(f"a summary of {footer_at - begin} bytes")
    raw = file.read(begin, footer_at + FOOTER_SIZE - begin).tobytes()
    records, checked = raw[: footer_at - begin], raw[: footer_at - begin + FOOTER_SIZE - 4]
    if crc and crc32(checked) != crc:
        raise BrokenRecordError("the summary does not match its checksum")
    summary = _parse_summary(records, base)
    return replace(summary, is_verified=bool(crc))


def _parse_summary(records: bytes, base: int) -> Summary:
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    begins: list[int] = []
    sizes: list[int] = []
    statistics: Statistics | None = None
    view, at = memoryview(records), 0
    while at < len(records):
        if at + PREFIX.size > len(records):
            raise BrokenRecordError("the summary ends inside a record")
        opcode, length = PREFIX.unpack_from(records, at)
        content = view[at + PREFIX.size : at + PREFIX.size + length]
        if len(content) < length or not opcode:
            raise BrokenRecordError("the summary's records have wrong lengths")
        if opcode == Op.SCHEMA:
            schema = read_schema(content)
            schemas[schema.id] = schema
        elif opcode == Op.CHANNEL:
            channel = read_channel(content)
            channels[channel.id] = channel
        elif opcode == Op.STATISTICS:
            statistics = read_statistics(content)
        elif opcode == Op.CHUNK_INDEX:
            size = PREFIX.size + length
            run = run_of(records, at, size)
            begins += range(at + PREFIX.size, at + run * size, size)
            sizes += [length] * run
            at += (run - 1) * size
        at += PREFIX.size + length
    chunks = parse_chunk_indexes(records, begins, sizes, base)
    return Summary(schemas, channels, statistics, chunks)


def _confirmed(
    file: ByteFile, chunks: Mapping[int, ChunkIndex], limits: Limits
) -> dict[int, ChunkIndex]:
    """Select the entries of an index without checksum that the chunks themselves confirm."""
    confirmed: dict[int, ChunkIndex] = {}
    for at, index in chunks.items():
        raw = file.peek(at, PREFIX.size)
        is_chunk = bytes(raw) == PREFIX.pack(Op.CHUNK, max(index.length - PREFIX.size, 0))
        if is_chunk or verified_head(file, index, limits) is not None:
            confirmed[at] = replace(index, index_length=0)
    return confirmed


def _declared(summary: Summary) -> tuple[list[Schema], list[Channel]]:
    return list(summary.schemas.values()), list(summary.channels.values())


def _enter(segment: RecordingSegment, declarations: Declarations) -> RecordingSegment:
    """Return the segment with the declarations, and add its topics by channel number."""
    for _ in declarations.topics():
        pass
    return replace(segment, schemas=declarations.schemas, channels=declarations.channels)


def _survey_named(
    file: ByteFile, segment: RecordingSegment, book: TopicBook, limits: Limits
) -> RecordingSegment:
    """Find channels in the data section that the summary does not declare."""
    walk = Walk(file, segment.begin, segment.end, segment.known_chunks(file, limits), limits)
    declarations = Declarations(book, *_declared(segment.summary or Summary()))
    _collect(file, walk, declarations, limits)
    return _enter(segment, declarations)


def _survey(file: ByteFile, book: TopicBook, limits: Limits) -> tuple[RecordingSegment, ...]:
    """Find all segments by walking over the file's outer records."""
    segments: list[RecordingSegment] = []
    base = 0
    while base < file.size:
        begin = _begin(file, base)
        walk = Walk(file, begin, file.size, None, limits)
        declarations = Declarations(book)
        end = _collect(file, walk, declarations, limits)
        segment, after = _close(file, base, begin, end, limits)
        summary = segment.summary or Summary()
        for channel in summary.channels.values():
            declarations.declare_missing(channel, summary.schemas.get(channel.schema_id))
        segments.append(_enter(segment, declarations))
        if after is None:
            break
        if bytes(file.peek(after, len(MAGIC))) != MAGIC:
            if _is_filled(file, after):
                left = f"{file.size - after} bytes from byte {after} on are not an MCAP recording"
                segments[-1] = replace(segments[-1], after=left)
            break
        base = after
    return tuple(segments)


def _collect(file: ByteFile, walk: Walk, declarations: Declarations, limits: Limits) -> End:
    """Walk to the end and collect definitions; chunks are read only if they may have new ones."""
    for item in walk:
        if isinstance(item, End):
            return item
        if isinstance(item, LooseRecords):
            _take(declarations, item.rows.definitions)
        elif isinstance(item, UnreadChunk) and not _is_known(item, declarations):
            _take(declarations, _definitions_in(file, item, limits))
    raise AssertionError("a walk ends with an End")


def _is_known(chunk: UnreadChunk, declarations: Declarations) -> bool:
    ids = {index.channel_id for index in chunk.messages}
    return bool(ids) and ids <= declarations.complete


def _definitions_in(file: ByteFile, chunk: UnreadChunk, limits: Limits) -> list[Definition]:
    """Return the schemas and channels of a chunk; empty if it cannot be read."""
    head = chunk.head
    if head is None or chunk.fault or max(head.size, head.body_size) > limits.chunk_bytes:
        return []
    try:
        body = file.read(chunk.body_at, head.body_size)
        buffer = (
            inflate_prefix(body, head)
            if chunk.is_cut
            else inflate_chunk(body, head, file.buffers.take(head.size + 1))
        )
        rows = rows_by_scan(buffer, NEVER_IN_A_CHUNK, limits.records_per_chunk)
    except BrokenRecordError:
        return []
    return list(rows.definitions)


def _take(declarations: Declarations, definitions: Sequence[Definition]) -> None:
    for definition in definitions:
        try:
            if declarations.changed_by(definition):
                list(declarations.topics())  # adds the topics before their numbers are redefined
            declarations.declare(definition)
        except BrokenRecordError:
            continue  # reported when it is read again


def _close(
    file: ByteFile, base: int, begin: int, end: End, limits: Limits
) -> tuple[RecordingSegment, int | None]:
    """Return a segment whose data section ends at ``end``, and the possible start of the next."""
    if end.how not in (How.DATA_END, How.FOOTER):
        after = end.at if end.how is How.REPORTED and end.at < file.size else None
        return RecordingSegment(base, begin, after or file.size, has_end=False), after
    data_crc = _data_end(file, end.at) or 0
    summary_at = end.at + (DATA_END_SIZE if end.how is How.DATA_END else 0)
    segment = RecordingSegment(base, begin, end.at, True, data_crc)
    footer_at = _footer_after(file, summary_at)
    if footer_at is None:
        if bytes(file.peek(file.size - len(MAGIC), len(MAGIC))) != MAGIC:
            return replace(segment, after="the file ends inside its summary"), None
        notice = "the file is damaged inside its summary, which is not used"
        following = find_bytes(file, summary_at, file.size, MAGIC + bytes([Op.HEADER]))
        hidden = None if following else find_bytes(file, summary_at, file.size, DATA_END_PREFIX)
        left = f"another recording, damaged at its start, ends at byte {hidden}"
        return replace(segment, notices=(notice,), after=left if hidden else ""), following
    summary: Summary | None = None
    notices: list[str] = []
    if footer_at > summary_at:
        footer = read_footer(file.peek(footer_at + PREFIX.size, FOOTER_SIZE - PREFIX.size))
        try:
            summary = _read_summary(file, base, summary_at, footer_at, footer.crc, limits)
        except BrokenRecordError as error:
            notices.append(f"its summary is not used: {error}")
    after = footer_at + FOOTER_SIZE
    left = ""
    if after + len(MAGIC) > file.size:
        left = "the file ends inside the closing magic bytes"
    elif bytes(file.peek(after, len(MAGIC))) != MAGIC:
        notices.append("it does not end with the magic bytes of MCAP")
    segment = replace(segment, summary=summary, notices=tuple(notices), after=left)
    return segment, after + len(MAGIC)


def _footer_after(file: ByteFile, at: int) -> int | None:
    """Return the offset of the footer after the summary at ``at``, if it can be reached."""
    while True:
        raw = file.peek(at, PREFIX.size)
        if len(raw) < PREFIX.size:
            return None
        opcode, length = PREFIX.unpack(raw)
        if opcode == Op.FOOTER:
            return (
                at
                if length == FOOTER_SIZE - PREFIX.size and at + FOOTER_SIZE <= file.size
                else None
            )
        if not opcode:
            return None
        at += PREFIX.size + length


def _is_filled(file: ByteFile, at: int) -> bool:
    """Return whether a byte after ``at`` is not zero; some recorders reserve space with zeros."""
    while at < file.size:
        window = file.window(at, PIECE)
        if not len(window) or any(window):
            break
        at += len(window)
    return at < file.size
