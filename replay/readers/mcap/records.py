r"""Types and parsers of single MCAP records.

Field names and layouts are those of the MCAP specification, version 0. In a string that is not
UTF-8, invalid bytes are replaced by ``\xNN``, so that it can be printed. Records may be longer than
their fields (the format may be extended); a record shorter than its fields is broken.
"""

import struct
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.columns import Bytes
from crosscue.replay.errors import LogFormatError

MAGIC: Final = b"\x89MCAP0\r\n"


class Op:
    """Operation codes of records."""

    HEADER: Final = 0x01
    FOOTER: Final = 0x02
    SCHEMA: Final = 0x03
    CHANNEL: Final = 0x04
    MESSAGE: Final = 0x05
    CHUNK: Final = 0x06
    MESSAGE_INDEX: Final = 0x07
    CHUNK_INDEX: Final = 0x08
    ATTACHMENT: Final = 0x09
    ATTACHMENT_INDEX: Final = 0x0A
    STATISTICS: Final = 0x0B
    METADATA: Final = 0x0C
    METADATA_INDEX: Final = 0x0D
    SUMMARY_OFFSET: Final = 0x0E
    DATA_END: Final = 0x0F


# Header of every record: operation code and length of the content.
PREFIX: Final = struct.Struct("<BQ")
FOOTER_SIZE: Final = PREFIX.size + 20
DATA_END_SIZE: Final = PREFIX.size + 4
# Key of ``Topic.converted_from`` in a channel's metadata.
CONVERTED_FROM: Final = "crosscue.converted_from"
COMPRESSIONS: Final = frozenset({"", "lz4", "zstd"})

# The first 31 bytes of a message record, as in the file.
MESSAGE_HEAD: Final = np.dtype(
    [
        ("opcode", "u1"),
        ("length", "<u8"),
        ("channel", "<u2"),
        ("sequence", "<u4"),
        ("log", "<u8"),
        ("publish", "<u8"),
    ]
)
INDEX_ENTRY: Final = np.dtype([("log", "<u8"), ("offset", "<u8")])
MESSAGE_FIXED: Final = MESSAGE_HEAD.itemsize - PREFIX.size
_INDEX_HEAD: Final = struct.Struct("<HI")
_INDEX_RECORD: Final = struct.Struct("<BQHI")
_CHUNK_HEAD: Final = struct.Struct("<QQQII")
CHUNK_FIXED: Final = 40
# Maximum size of a chunk record before its compressed records.
MAX_HEAD: Final = PREFIX.size + CHUNK_FIXED + 32


class BrokenRecordError(LogFormatError):
    """A record's content contradicts its own lengths; readers report it as a loss."""


class FieldParser:
    """Parses the fields of a record's content in order."""

    def __init__(self, content: bytes | memoryview) -> None:
        self.content = content
        self.at = 0

    def take(self, size: int) -> memoryview:
        """Return the next ``size`` bytes.

        Raises:
            BrokenRecordError: Fewer bytes are left.
        """
        end = self.at + size
        if end > len(self.content):
            raise BrokenRecordError(
                f"a field needs {end} bytes, the record has {len(self.content)}"
            )
        taken = memoryview(self.content)[self.at : end]
        self.at = end
        return taken

    def number(self, size: int) -> int:
        """Return the next unsigned integer of ``size`` bytes."""
        return int.from_bytes(self.take(size), "little")

    def text(self) -> str:
        """Return the next length-prefixed string."""
        return bytes(self.take(self.number(4))).decode("utf-8", "backslashreplace")


@dataclass(frozen=True, slots=True)
class Schema:
    """A message definition."""

    id: int
    name: str
    encoding: str
    text: bytes


@dataclass(frozen=True, slots=True)
class Channel:
    """A stream of messages, with only the metadata entry that ``convert`` writes."""

    id: int
    schema_id: int
    topic: str
    message_encoding: str
    converted_from: str = ""


# These are not frozen, because several are created for each chunk, which takes three times as long.
@dataclass(slots=True)
class ChunkHead:
    """The fields of a chunk record before its records.

    Attributes:
        start: Earliest log time in nanoseconds, as stored (unsigned).
        end: Latest log time.
        size: Size of the decompressed records in bytes.
        crc: CRC-32 of the decompressed records, 0 for none.
        compression: ``""``, ``lz4``, ``zstd`` or an unsupported name.
        body_at: Offset of the (compressed) records in the content.
        body_size: Size of the (compressed) records in bytes.
    """

    start: int
    end: int
    size: int
    crc: int
    compression: str
    body_at: int
    body_size: int


@dataclass(slots=True)
class ChunkIndex:
    """The entry of a chunk in the summary; offsets count from the file's start."""

    start: int
    end: int
    at: int
    length: int
    channels: frozenset[int]
    index_length: int
    compression: str
    body_size: int
    size: int


@dataclass(slots=True, eq=False)
class MessageIndex:
    """Log times and offsets of a channel's messages within a chunk: ``count`` ``INDEX_ENTRY``s."""

    channel_id: int
    count: int
    packed: bytes

    @property
    def entries(self) -> NDArray[np.void]:
        """Shape (N,), INDEX_ENTRY."""
        return np.frombuffer(self.packed, INDEX_ENTRY)


@dataclass(frozen=True, slots=True)
class Statistics:
    """Counts of a complete file; ``by_channel`` is empty if the writer did not count.

    ``start`` and ``end`` are the first and last log time, 0 without messages.
    """

    message_count: int
    chunk_count: int
    by_channel: Mapping[int, int]
    start: int = 0
    end: int = 0


@dataclass(frozen=True, slots=True)
class Footer:
    """Offsets of the summary from the file's start; 0 for none."""

    summary_at: int
    summary_offset_at: int
    crc: int


def read_schema(content: bytes | memoryview) -> Schema:
    """Parse a Schema record."""
    fields = FieldParser(content)
    schema_id, name, encoding = fields.number(2), fields.text(), fields.text()
    return Schema(schema_id, name, encoding, bytes(fields.take(fields.number(4))))


def read_channel(content: bytes | memoryview) -> Channel:
    """Parse a Channel record."""
    fields = FieldParser(content)
    channel = Channel(fields.number(2), fields.number(2), fields.text(), fields.text())
    return replace(channel, converted_from=_converted_from(fields.take(fields.number(4))))


def _converted_from(metadata: bytes | memoryview) -> str:
    """Return the entry that crosscue writes; invalid metadata is ignored."""
    key = CONVERTED_FROM.encode()
    if key not in bytes(metadata):
        return ""
    fields = FieldParser(metadata)
    try:
        while True:
            name, value = fields.text(), fields.text()
            if name == CONVERTED_FROM:
                return value
    except BrokenRecordError:
        return ""


def read_chunk_head(content: bytes | memoryview) -> ChunkHead:
    """Parse the first fields of a Chunk record; ``content`` may end right after them.

    Raises:
        BrokenRecordError: A field is incomplete, or the compression name exceeds 32 bytes.
    """
    if len(content) < CHUNK_FIXED:
        raise BrokenRecordError(f"a chunk's fields need {CHUNK_FIXED} bytes, found {len(content)}")
    start, end, size, crc, name_length = _CHUNK_HEAD.unpack_from(content)
    body_at = CHUNK_FIXED + name_length
    if name_length > 32 or body_at > len(content):
        raise BrokenRecordError(f"a compression name of {name_length} bytes")
    name = bytes(content[_CHUNK_HEAD.size : body_at - 8])
    body_size = int.from_bytes(content[body_at - 8 : body_at], "little")
    compression = name.decode("utf-8", "backslashreplace")
    return ChunkHead(start, end, size, crc, compression, body_at, body_size)


def read_message_index(content: bytes | memoryview) -> MessageIndex:
    """Parse a MessageIndex record."""
    if len(content) < _INDEX_HEAD.size:
        raise BrokenRecordError(f"a message index of {len(content)} bytes")
    channel_id, size = _INDEX_HEAD.unpack_from(content)
    if size % INDEX_ENTRY.itemsize or _INDEX_HEAD.size + size > len(content):
        raise BrokenRecordError(f"a message index of {size} bytes does not match its record")
    # A copy: a view would keep everything that was read with it.
    packed = bytes(content[_INDEX_HEAD.size : _INDEX_HEAD.size + size])
    return MessageIndex(channel_id, size // INDEX_ENTRY.itemsize, packed)


def read_message_indexes(records: memoryview, max_bytes: int) -> tuple[list[MessageIndex], int]:
    """Parse the whole MessageIndex records of up to ``max_bytes`` at the start, and their size."""
    found: list[MessageIndex] = []
    at, last = 0, len(records) - _INDEX_RECORD.size
    while at <= last:
        opcode, length, channel_id, size = _INDEX_RECORD.unpack_from(records, at)
        begin, after = at + _INDEX_RECORD.size, at + PREFIX.size + length
        if opcode != Op.MESSAGE_INDEX or length > max_bytes or after > len(records):
            break
        if size % INDEX_ENTRY.itemsize or size > after - begin:
            break
        packed = bytes(records[begin : begin + size])
        found.append(MessageIndex(channel_id, size // INDEX_ENTRY.itemsize, packed))
        at = after
    return found, at


def read_statistics(content: bytes | memoryview) -> Statistics:
    """Parse a Statistics record."""
    fields = FieldParser(content)
    message_count = fields.number(8)
    fields.take(2 + 4 + 4 + 4)
    chunk_count = fields.number(4)
    start, end = fields.number(8), fields.number(8)
    size = fields.number(4)
    if size % 10:
        raise BrokenRecordError(f"a map of {size} bytes ends inside an entry")
    pairs = np.frombuffer(fields.take(size), dtype=np.dtype([("id", "<u2"), ("n", "<u8")]))
    by_channel = dict(zip(pairs["id"].tolist(), pairs["n"].tolist(), strict=True))
    return Statistics(message_count, chunk_count, by_channel, start, end)


def read_footer(content: bytes | memoryview) -> Footer:
    """Parse a Footer record."""
    fields = FieldParser(content)
    return Footer(fields.number(8), fields.number(8), fields.number(4))


def check_metadata(content: bytes | memoryview) -> None:
    """Raise BrokenRecordError unless ``content`` is a Metadata record."""
    fields = FieldParser(content)
    fields.text()
    entries = FieldParser(fields.take(fields.number(4)))
    while entries.at < len(entries.content):
        entries.text()


@dataclass(frozen=True, slots=True, eq=False)
class Heads:
    """Header fields of N message records, in columns of shape (N,).

    Attributes:
        opcode: Operation code, uint8.
        size: Size of the content in bytes, int64; its two highest bytes are in ``number``.
        number: Channel number in the upper half, uint32; the lower half is zero in valid records.
        channel: Channel number, uint16.
        sequence: The sender's counter, uint32.
        log: Log time, uint64.
        publish: Publish time, uint64.
    """

    opcode: NDArray[np.uint8]
    size: NDArray[np.int64]
    number: NDArray[np.uint32]
    channel: NDArray[np.uint16]
    sequence: NDArray[np.uint32]
    log: NDArray[np.uint64]
    publish: NDArray[np.uint64]


# Header of a message record and the byte before it, so that every field is aligned; the length's
# upper two bytes and the channel number are one field.
_BEHIND_A_BYTE: Final = np.dtype(
    {
        "names": ["size", "opcode", "number", "channel", "sequence", "log", "publish"],
        "formats": ["<i8", "u1", "<u4", "<u2", "<u4", "<u8", "<u8"],
        "offsets": [0, 1, 8, 10, 12, 16, 24],
        "itemsize": 32,
    }
)


def heads_at(buffer: Bytes, offsets: NDArray[np.int64]) -> Heads:
    """Gather the message headers at ``offsets`` in one step.

    Args:
        buffer: Shape (B,), contiguous.
        offsets: Shape (N,), each at most B - 31.
    """
    width = _BEHIND_A_BYTE.itemsize
    if len(buffer) < width:
        buffer = np.concatenate((buffer, np.zeros(width, np.uint8)))
    every = np.ndarray((len(buffer) - width + 1,), f"V{width}", buffer, strides=(1,))
    raw = every[np.maximum(offsets - 1, 0)]
    at_zero = (offsets == 0).nonzero()[0]  # these have no preceding byte
    if len(at_zero):
        raw.view(np.uint8).reshape(-1, width)[at_zero, 1:] = buffer[: width - 1]
    fields = raw.view(_BEHIND_A_BYTE)
    return Heads(
        fields["opcode"],
        fields["size"] >> 16,
        fields["number"],
        fields["channel"],
        fields["sequence"],
        fields["log"],
        fields["publish"],
    )
