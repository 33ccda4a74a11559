"""Walk over the records of a data section, without reading the chunks' contents.

The walk follows the records' lengths. If a length cannot be right, the walk continues at the next
chunk in the summary's index; without an index, at the next chunk that its checksum verifies
(``damage.find``). If there are records outside chunks, it continues at the next plausible
consecutive records (``damage.resync``).
"""

from bisect import bisect_right
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from enum import Enum
from typing import Final, TypeAlias

import numpy as np

from crosscue.replay.columns import Bytes
from crosscue.replay.limits import Limits
from crosscue.replay.readers.mcap.chunks.rows import Rows, opcodes, rows_by_scan
from crosscue.replay.readers.mcap.damage.find import (
    REPAIRED,
    find_chunk,
    is_doubtful,
    verified_head,
)
from crosscue.replay.readers.mcap.damage.resync import McapResync, Plausible, is_definition

from .bytes import WINDOW, ByteFile
from .records import (
    CHUNK_FIXED,
    COMPRESSIONS,
    DATA_END_SIZE,
    FOOTER_SIZE,
    INDEX_ENTRY,
    MAGIC,
    MAX_HEAD,
    MESSAGE_FIXED,
    MESSAGE_HEAD,
    PREFIX,
    BrokenRecordError,
    ChunkHead,
    ChunkIndex,
    MessageIndex,
    Op,
    check_metadata,
    read_chunk_head,
    read_message_index,
    read_message_indexes,
)

# Maximum number of bytes outside chunks read at once, unless one record is larger.
RUN_BYTES: Final = 4 << 20
STOPS_A_RUN: Final = ~opcodes(Op.SCHEMA, Op.CHANNEL, Op.MESSAGE)
# Maximum size of records that are checked completely (metadata and similar).
SMALL: Final = 1 << 20


@dataclass(slots=True, eq=False)
class UnreadChunk:
    """A chunk that is not yet read, with the message indexes that follow it.

    Attributes:
        at: Offset of the record.
        body_at: Offset of its (compressed) records.
        head: Its header; None if it cannot be read.
        index: Its entry in the summary, or None.
        fault: Reason why it cannot be read; empty if it is probably readable.
        differs: Differences between header and summary; empty if they agree.
        is_cut: True if the file ends inside it.
        messages: Its readable message indexes.
        index_fault: Problem of its message indexes; empty for none.
    """

    at: int
    body_at: int
    head: ChunkHead | None
    index: ChunkIndex | None
    fault: str = ""
    differs: str = ""
    is_cut: bool = False
    messages: tuple[MessageIndex, ...] = ()
    index_fault: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class LooseRecords:
    """Messages, schemas and channels outside chunks, from byte ``at`` on."""

    at: int
    rows: Rows


@dataclass(frozen=True, slots=True)
class Oversized:
    """A message outside chunks that exceeds the size limit and was not read."""

    at: int
    size: int
    channel_id: int
    log: int


@dataclass(frozen=True, slots=True)
class Attachment:
    """An attachment; ``crc`` (0 for none) is stored at ``crc_at`` and covers the content before."""

    at: int
    crc_at: int
    crc: int


@dataclass(frozen=True, slots=True)
class Ignored:
    """A record of a kind that a reader must ignore."""

    at: int
    opcode: int


@dataclass(frozen=True, slots=True)
class Stray:
    """A message index without a chunk before it, because the chunk cannot be recognised."""

    at: int
    index: MessageIndex


@dataclass(frozen=True, slots=True)
class UnreadableBytes:
    """Bytes from ``at`` to ``to`` that cannot be read as records.

    A run before it may extend beyond ``at``. Its records from ``at`` on cannot be trusted.
    """

    at: int
    to: int
    why: str


class How(Enum):
    """The kind of end of a data section."""

    DATA_END = "with a data end record"
    FOOTER = "with a footer, without a data end record"
    CUT = "in the middle of a record"
    BARE = "without a data end record"
    REPORTED = "inside the previous chunk or gap"


@dataclass(frozen=True, slots=True)
class End:
    """The end of a data section."""

    at: int
    how: How


Item: TypeAlias = (
    UnreadChunk | LooseRecords | Oversized | Attachment | Ignored | Stray | UnreadableBytes | End
)


class Walk:
    """One pass over a data section; iterate over it once. The last item is an ``End``."""

    def __init__(
        self,
        file: ByteFile,
        begin: int,
        end: int,
        chunks: Mapping[int, ChunkIndex] | None,
        limits: Limits,
        plausible: Plausible | None = None,
    ) -> None:
        """Prepare a walk from ``begin``.

        Args:
            file: The bytes.
            begin: Offset of the first record after the header.
            end: Offset of the data end record. If ``chunks`` is None, the end of the file or the
                start of another recording.
            chunks: Entries of a trusted summary by offset; None if no end is known.
            limits: Maximum sizes that are read.
            plausible: Criteria for messages outside chunks, known before the walk.
        """
        self._file = file
        self._at = begin
        self._end = end
        self._has_end = chunks is not None
        self._chunks = chunks or {}
        self._known = sorted(self._chunks)
        self._limits = limits
        self._max_index_bytes = limits.records_per_chunk * INDEX_ENTRY.itemsize
        self._run_bytes = 0
        self._is_over = False
        self._last_at = begin
        self._resync = McapResync(file, end, self._has_end, self._known, plausible or Plausible())
        self._before: LooseRecords | None = None
        self._has_bare = not self._known

    def __iter__(self) -> Iterator[Item]:
        """Yield the items in the order of the file."""
        while self._at < self._end:
            before = self._at
            try:
                item = self._next()
            except BrokenRecordError as error:
                item = self._gap(str(error))
            self._last_at = before
            if item is not None:
                yield item
            if isinstance(item, End):
                return
            since = item.at if isinstance(item, UnreadableBytes) else before
            assert self._at > since or self._is_over, "a walk must go forward"
        how = How.DATA_END if self._has_end else How.REPORTED if self._is_over else How.BARE
        yield End(self._end, how)

    def _bound(self, at: int) -> int:
        """Return the first known start of another item after ``at``."""
        after = bisect_right(self._known, at)
        return self._known[after] if after < len(self._known) else self._end

    def _next(self) -> Item | None:
        at = self._at
        if at in self._chunks:
            return self._chunk(self._chunks[at])
        head = self._file.peek(at, PREFIX.size)
        if len(head) < PREFIX.size:
            return self._cut("its prefix")
        opcode, length = PREFIX.unpack(head)
        after, bound = at + PREFIX.size + length, self._bound(at)
        if not self._has_end and self._is_end(opcode, length):
            return End(at, How.DATA_END if opcode == Op.DATA_END else How.FOOTER)
        if opcode == Op.CHUNK:
            return self._chunk(None)
        if after > bound:
            return self._overlong(opcode, length, bound)
        if opcode in (Op.SCHEMA, Op.CHANNEL, Op.MESSAGE):
            return self._run(opcode, length, bound)
        return self._other(opcode, length)

    def _is_end(self, opcode: int, length: int) -> bool:
        if opcode == Op.DATA_END:
            return length == DATA_END_SIZE - PREFIX.size
        if opcode != Op.FOOTER or length != FOOTER_SIZE - PREFIX.size:
            return False
        return bytes(self._file.peek(self._at + FOOTER_SIZE, len(MAGIC))) == MAGIC

    def _gap(self, why: str) -> Item:
        """Skip bytes that are not a record, up to the next known or verified item."""
        at, bound = self._at, self._bound(self._at)
        since, record = self._next_record(at, bound)
        if bound < self._end:
            self._at = bound if record is None else record
            return UnreadableBytes(since, self._at, why)
        self._at = self._end if record is None else record
        after = min(self._last_at, since) + 1
        found = find_chunk(self._file, after, since + 1, self._at, self._end, self._limits)
        place, is_chunk = found if found is not None else (self._at, record is not None)
        if is_chunk:
            self._at = place
        elif not self._has_end:
            self._at, self._end, self._is_over = max(place, since), place, True
        return UnreadableBytes(since, self._at, why)

    def _next_record(self, at: int, bound: int) -> tuple[int, int | None]:
        """Return where records outside chunks become untrustworthy, and where they resume."""
        if not self._has_bare:
            return at, None
        since = at
        if self._before is not None and self._before.at + self._before.rows.end == at:
            since = self._before.at + self._resync.last_trusted(self._before.rows)
        head = self._file.peek(at, PREFIX.size)
        if len(head) == PREFIX.size:
            # Only its kind may be damaged; its length then leads to the next record.
            after = at + PREFIX.size + PREFIX.unpack(head)[1]
            if after < bound and self._resync.continues(after):
                return since, after
        return since, self._resync.find(since + 1, bound)

    def _cut(self, what: str) -> Item:
        if self._has_end or self._bound(self._at) != self._end:
            return self._gap(f"a record ends before {what} does")
        return End(self._at, How.CUT)

    def _overlong(self, opcode: int, length: int, bound: int) -> Item:
        is_cut = not self._has_end and bound == self._end and opcode in _KINDS
        if not is_cut or self._next_record(self._at, bound)[1] is not None:
            return self._gap(f"a record (kind {opcode:#04x}) of {length} bytes is too long")
        return End(self._at, How.CUT)

    def _other(self, opcode: int, length: int) -> Item | None:
        at, after = self._at, self._at + PREFIX.size + length
        if opcode == Op.ATTACHMENT:
            crc_at = self._attachment_crc_at(after)
            crc = int.from_bytes(self._file.peek(crc_at, 4), "little")
            item: Item | None = Attachment(at, crc_at, crc)
        elif opcode == Op.MESSAGE_INDEX:
            item = Stray(at, read_message_index(self._whole(length)))
        elif opcode == Op.METADATA:
            if length <= SMALL:
                check_metadata(self._whole(length))
            item = None
        elif opcode in (0, Op.HEADER, Op.FOOTER, Op.DATA_END):
            raise BrokenRecordError(f"a record of kind {opcode:#04x} is not allowed here")
        elif (hidden := self._hidden_chunk(opcode, length)) is not None:
            return hidden
        else:
            if self._has_bare and not self._is_unknown_kind(at, length):
                raise BrokenRecordError(f"a record of the unknown kind {opcode:#04x}")
            item = Ignored(at, opcode)
        self._at = after
        return item

    def _is_unknown_kind(self, at: int, length: int) -> bool:
        """Return whether a record of an unknown kind is genuine, and not a damaged message."""
        if self._resync.is_hidden(at, length):
            return False
        after = at + PREFIX.size + length
        return self._before is None or self._resync.follows_unknown(after)

    def _whole(self, length: int, near: memoryview | None = None) -> memoryview:
        """Return the content of the record here, of which ``near`` may have been read."""
        if length > self._max_index_bytes:
            raise BrokenRecordError(f"a record of {length} bytes is over the limit")
        if near is not None and len(near) >= PREFIX.size + length:
            return near[PREFIX.size : PREFIX.size + length]
        content = self._file.peek(self._at + PREFIX.size, length)
        if len(content) < length:
            raise BrokenRecordError("the file became shorter while being read")
        return content

    def _attachment_crc_at(self, after: int) -> int:
        """Return the offset of the checksum of the attachment that starts here."""
        at = self._at + PREFIX.size + 16
        for width in (4, 4, 8):
            raw = self._file.peek(at, width)
            at += width + int.from_bytes(raw, "little")
            if len(raw) < width or at + 4 > after:
                raise BrokenRecordError("an attachment contradicts its own length")
        return at

    def _hidden_chunk(self, opcode: int, length: int) -> Item | None:
        """Treat a record of an unknown kind with the structure of a chunk as a chunk."""
        raw = self._file.peek(self._at + PREFIX.size, CHUNK_FIXED + 32)
        try:
            head = read_chunk_head(raw)
        except BrokenRecordError:
            return None
        if head.body_at + head.body_size != length or head.compression not in COMPRESSIONS:
            return None
        return self._chunk(None)

    def _run(self, opcode: int, length: int, bound: int) -> Item:
        at, size = self._at, PREFIX.size + length
        if opcode == Op.MESSAGE and length < MESSAGE_FIXED:
            raise BrokenRecordError(f"a message record of {length} bytes")
        if size > max(self._limits.message_bytes, SMALL) + MESSAGE_HEAD.itemsize:
            self._at = at + size
            return self._oversized(at, opcode, length)
        buffer = self._run_buffer(at, size, bound)
        rows = rows_by_scan(buffer, STOPS_A_RUN, len(buffer))
        if not rows.end:
            raise BrokenRecordError("the file became shorter while being read")
        rows = self._without_hidden(at, rows)
        is_stopped = rows.end < len(buffer) and STOPS_A_RUN[buffer[rows.end]]
        self._run_bytes = 0 if is_stopped else min(2 * len(buffer), RUN_BYTES)
        self._at = at + rows.end
        self._has_bare = True
        self._before = LooseRecords(at, rows)
        self._resync.plausible.learn(rows)
        return self._before

    def _without_hidden(self, at: int, rows: Rows) -> Rows:
        """Cut a run before the first message whose kind was damaged to that of a definition.

        Raises:
            BrokenRecordError: The run starts with such a message.
        """
        for found in rows.definitions:
            if is_definition(found) or not self._resync.is_hidden(
                at + found.at, len(found.content)
            ):
                self._resync.plausible.declare(found)
                continue
            if not found.at:
                raise BrokenRecordError(f"a record of kind {found.opcode:#04x} cannot be read")
            kept = rows.take(np.flatnonzero(rows.offset < found.at))
            earlier = [one for one in rows.definitions if one.at < found.at]
            return replace(kept, definitions=earlier, end=found.at)
        return rows

    def _run_buffer(self, at: int, size: int, bound: int) -> Bytes:
        if self._run_bytes > size:
            return self._file.read(at, min(self._run_bytes, bound - at))
        near = self._file.window(at, min(size, bound - at))
        return np.frombuffer(near, dtype=np.uint8)[: bound - at]

    def _oversized(self, at: int, opcode: int, length: int) -> Item:
        if opcode != Op.MESSAGE:
            return Ignored(at, opcode)
        head = np.frombuffer(self._file.peek(at, MESSAGE_HEAD.itemsize), dtype=MESSAGE_HEAD)[0]
        return Oversized(at, length - MESSAGE_FIXED, int(head["channel"]), int(head["log"]))

    def _chunk(self, index: ChunkIndex | None) -> Item:
        at, bound = self._at, self._bound(self._at)
        raw = self._file.peek(at, PREFIX.size + CHUNK_FIXED + 32)
        if len(raw) < PREFIX.size:
            return self._cut("its prefix")
        opcode, length = PREFIX.unpack_from(raw)
        outer_end = at + PREFIX.size + length
        try:
            head = read_chunk_head(raw[PREFIX.size :])
        except BrokenRecordError as error:
            head, why = None, str(error)
        if index is not None and is_doubtful(opcode == Op.CHUNK, head, index):
            repaired = verified_head(self._file, index, self._limits)
            if repaired is not None:
                return self._repaired(index, repaired, bound)
        if head is None:
            return self._chunk_without_head(index, outer_end, bound, why)
        body_at = at + PREFIX.size + head.body_at
        inner_end = body_at + head.body_size
        fault = ""
        if opcode != Op.CHUNK:
            fault = f"its record has the kind {opcode:#04x}"
        elif head.compression not in COMPRESSIONS:
            fault = f"compression {head.compression!r} is unknown (known: none, lz4, zstd)"
        if index is not None:
            end = min(at + index.length, bound)
            differs = _differences(head, index, outer_end - at)
        elif outer_end <= bound:
            end, differs = outer_end, ""
        elif inner_end <= bound and head.crc:
            end, differs = inner_end, f"its record states {length} bytes"
        elif not self._has_end and bound == self._end and outer_end == inner_end:
            self._at, self._is_over = self._end, True
            return UnreadChunk(at, body_at, head, None, fault, is_cut=True)
        else:
            raise BrokenRecordError(f"a chunk of {length} bytes is too long")
        if inner_end < end and not differs:
            differs = f"{end - inner_end} bytes follow its records"
        if inner_end > end and not fault:
            fault = f"declares {head.body_size} bytes of records, has {max(0, end - body_at)}"
        messages, index_fault = self._message_indexes(end, index)
        # A search for records after damage would find those inside an uncompressed chunk.
        self._has_bare &= self._before is not None
        return UnreadChunk(at, body_at, head, index, fault, differs, False, messages, index_fault)

    def _repaired(self, index: ChunkIndex, head: ChunkHead, bound: int) -> UnreadChunk:
        """Return a chunk that is read by its entry in the summary."""
        at = self._at
        messages, index_fault = self._message_indexes(min(at + index.length, bound), index)
        self._has_bare &= self._before is not None
        body_at = at + PREFIX.size + head.body_at
        return UnreadChunk(at, body_at, head, index, "", REPAIRED, False, messages, index_fault)

    def _chunk_without_head(
        self, index: ChunkIndex | None, outer_end: int, bound: int, why: str
    ) -> Item:
        at = self._at
        if index is None and outer_end > bound:
            return self._cut("its fields") if bound == self._end else self._gap(why)
        end = outer_end if index is None else min(at + index.length, bound)
        messages, index_fault = self._message_indexes(end, index)
        return UnreadChunk(at, at, None, index, why, "", False, messages, index_fault)

    def _message_indexes(
        self, at: int, index: ChunkIndex | None
    ) -> tuple[tuple[MessageIndex, ...], str]:
        """Read the message indexes from ``at`` on, and move the walk to their end."""
        bound = self._bound(self._at)
        reported_end = min(at + index.index_length, bound) if index is not None else at
        # Up to the fields of the next chunk, or what is read without knowing.
        ahead = min(reported_end - at + MAX_HEAD, WINDOW) if reported_end > at else WINDOW
        found: list[MessageIndex] = []
        near, fault = memoryview(b""), ""
        while at + PREFIX.size <= bound:
            if len(near) < PREFIX.size:
                near = self._file.window(at, PREFIX.size, ahead)[: bound - at]
                if len(near) < PREFIX.size:
                    break
                whole, size = read_message_indexes(near, self._max_index_bytes)
                found += whole
                at, near = at + size, near[size:]
                continue
            opcode, length = PREFIX.unpack_from(near)
            after = at + PREFIX.size + length
            if opcode != Op.MESSAGE_INDEX or after > bound:
                break
            self._at = at
            try:
                found.append(read_message_index(self._whole(length, near)))
            except BrokenRecordError as error:
                fault = str(error)
            at, near = after, near[PREFIX.size + length :]
        if at < reported_end:
            at, fault = reported_end, fault or "a message index cannot be read"
        self._at = at
        return tuple(found), fault


def _differences(head: ChunkHead, index: ChunkIndex, length: int) -> str:
    """Describe the fields in which a chunk and its entry in the summary differ, or empty."""
    found = (length, head.start, head.end, head.size, head.body_size, head.compression)
    stated = (index.length, index.start, index.end, index.size, index.body_size, index.compression)
    if found == stated:
        return ""
    names = ("length", "start time", "end time", "size", "stored size", "compression")
    return ", ".join(
        f"{name} {said!r} (the summary states {reported!r})"
        for name, said, reported in zip(names, found, stated, strict=True)
        if said != reported
    )


_KINDS: Final = frozenset(range(Op.HEADER, Op.DATA_END + 1))
