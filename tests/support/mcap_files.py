"""MCAP files written record by record, valid or with intended defects, and read back."""

import struct
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeAlias

import lz4.frame
import zstandard

from crosscue.replay.base import EVERYTHING, Selection
from crosscue.replay.columns import Messages
from crosscue.replay.ledger import Ledger
from crosscue.replay.limits import DEFAULT_LIMITS, Limits
from crosscue.replay.readers.mcap.reader import McapLog

MAGIC = b"\x89MCAP0\r\n"
# Log time, publish time, payload.
Message: TypeAlias = tuple[int, int, bytes]


def record(opcode: int, content: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(content)) + content


def text(string: str | bytes) -> bytes:
    """A length-prefixed string."""
    raw = string.encode() if isinstance(string, str) else string
    return struct.pack("<I", len(raw)) + raw


def mapping(pairs: Iterable[bytes]) -> bytes:
    """A length-prefixed map of encoded entries."""
    return text(b"".join(pairs))


def header(profile: str = "") -> bytes:
    return record(1, text(profile) + text(""))


def schema(
    number: int, name: str | bytes = "a/B", encoding: str = "ros2msg", body: bytes = b"int32 x"
) -> bytes:
    return record(3, struct.pack("<H", number) + text(name) + text(encoding) + text(body))


def channel(number: int, schema_id: int, topic: str | bytes, encoding: str = "cdr") -> bytes:
    return record(
        4, struct.pack("<HH", number, schema_id) + text(topic) + text(encoding) + mapping([])
    )


def message(number: int, log: int, payload: bytes = b"", publish: int | None = None) -> bytes:
    stamps = struct.pack("<HIQQ", number, 0, log, log if publish is None else publish)
    return record(5, stamps + payload)


def message_index(number: int, entries: Sequence[tuple[int, int]]) -> bytes:
    """A MessageIndex record of (log time, offset) pairs."""
    coded = b"".join(struct.pack("<QQ", *entry) for entry in entries)
    return record(7, struct.pack("<H", number) + text(coded))


def attachment(name: str, body: bytes, crc: int | None = None) -> bytes:
    """An Attachment record with its valid checksum unless another one is specified."""
    content = struct.pack("<QQ", 0, 0) + text(name) + text("x/y") + struct.pack("<Q", len(body))
    content += body
    return record(9, content + struct.pack("<I", zlib.crc32(content) if crc is None else crc))


def stored_chunk(body: bytes, size: int, compression: str, length: int | None = None) -> bytes:
    """A Chunk record of a compressed body, which declares the size and length given here."""
    fixed = struct.pack("<QQQI", 1, 1, size, 0) + text(compression)
    return record(6, fixed + struct.pack("<Q", len(body) if length is None else length) + body)


@dataclass(frozen=True, slots=True)
class ChunkOf:
    """A chunk to be written, valid unless a field specifies otherwise.

    Attributes:
        records: Encoded records.
        compression: "", "lz4" or "zstd".
        crc: Checksum instead of the valid one.
        size: Declared size instead of the true one.
        is_indexed: Message indexes follow the chunk.
        times: Declared first and last time instead of the true ones.
    """

    records: Sequence[bytes]
    compression: str = ""
    crc: int | None = None
    size: int | None = None
    is_indexed: bool = True
    times: tuple[int, int] | None = None

    def entries(self) -> dict[int, list[tuple[int, int]]]:
        """Log time and offset of its messages by channel number."""
        entries: dict[int, list[tuple[int, int]]] = {}
        at = 0
        for one in self.records:
            if one[0] == 5 and len(one) >= 31:
                number, log = struct.unpack_from("<H4xQ", one, 9)
                entries.setdefault(number, []).append((log, at))
            at += len(one)
        return entries

    def span(self) -> tuple[int, int]:
        """Earliest and latest log time."""
        logs = [log for found in self.entries().values() for log, _ in found] or [0]
        return self.times or (min(logs), max(logs))

    def body(self) -> bytes:
        """Its records as stored."""
        raw = b"".join(self.records)
        if self.compression == "zstd":
            return zstandard.compress(raw)
        return lz4.frame.compress(raw) if self.compression == "lz4" else raw

    def coded(self) -> bytes:
        """The Chunk record."""
        raw, body = b"".join(self.records), self.body()
        size = len(raw) if self.size is None else self.size
        crc = zlib.crc32(raw) if self.crc is None else self.crc
        fixed = struct.pack("<QQQI", *self.span(), size, crc)
        return record(6, fixed + text(self.compression) + struct.pack("<Q", len(body)) + body)


@dataclass(slots=True)
class McapFile:
    """A file to be written; every optional part can be omitted.

    Attributes:
        parts: Encoded records or chunks of the data section, in order.
        data_crc: Write the checksum of the data section.
        summary: Write a summary with schemas, channels and an index of the chunks.
        statistics: Write the statistics record in it.
        summary_crc: Write the checksum of the summary.
    """

    parts: Sequence[bytes | ChunkOf] = field(default_factory=list)
    data_crc: bool = False
    summary: bool = True
    statistics: bool = True
    summary_crc: bool = True

    def coded(self) -> bytes:
        """Bytes of the file."""
        out = bytearray(MAGIC + header())
        indexes: list[bytes] = []
        definitions: dict[bytes, None] = {}
        counts: dict[int, int] = {}
        logs: list[int] = []
        for part in self.parts:
            at = len(out)
            if isinstance(part, bytes):
                out += part
                inner: list[bytes] = [part]
            else:
                out += part.coded()
                length, offsets = len(out) - at, {}
                for number, entries in part.entries().items() if part.is_indexed else ():
                    offsets[number] = len(out)
                    out += message_index(number, entries)
                indexes.append(_chunk_index(part, at, length, offsets, len(out) - at - length))
                inner = list(part.records)
            for one in inner:
                if one[0] in (3, 4):
                    definitions[one] = None
                elif one[0] == 5 and len(one) >= 31:
                    number, log = struct.unpack_from("<H4xQ", one, 9)
                    counts[number] = counts.get(number, 0) + 1
                    logs.append(log)
        out += record(15, struct.pack("<I", zlib.crc32(out) if self.data_crc else 0))
        summary = bytearray()
        if self.summary:
            again: list[bytes] = sorted(definitions, key=lambda one: one[0])
            summary += b"".join(again)
            summary += _statistics(counts, logs, len(indexes)) if self.statistics else b""
            summary += b"".join(indexes)
        footer = struct.pack("<BQQQ", 2, 20, len(out) if summary else 0, 0)
        crc = zlib.crc32(bytes(summary) + footer) if self.summary_crc else 0
        return bytes(out + summary + footer + struct.pack("<I", crc) + MAGIC)


def _chunk_index(
    chunk: ChunkOf, at: int, length: int, offsets: Mapping[int, int], index_length: int
) -> bytes:
    found = mapping(struct.pack("<HQ", *pair) for pair in offsets.items())
    fixed = struct.pack("<QQQQ", *chunk.span(), at, length) + found
    fixed += struct.pack("<Q", index_length) + text(chunk.compression)
    return record(8, fixed + struct.pack("<QQ", len(chunk.body()), len(b"".join(chunk.records))))


def _statistics(counts: Mapping[int, int], logs: Sequence[int], chunks: int) -> bytes:
    fixed = struct.pack("<QHIIII", len(logs), 1, len(counts), 0, 0, chunks)
    fixed += struct.pack("<QQ", min(logs, default=0), max(logs, default=0))
    return record(11, fixed + mapping(struct.pack("<HQ", *pair) for pair in counts.items()))


@dataclass(frozen=True, slots=True)
class Reading:
    """Result of reading a file once.

    Attributes:
        messages: Messages by topic, in the order of reading.
        ledger: Account of the reading.
        names: Topics listed before reading.
    """

    messages: Mapping[str, list[Message]]
    ledger: Ledger
    names: tuple[str, ...]

    def count(self) -> int:
        """Number of messages read."""
        return sum(len(found) for found in self.messages.values())

    def adds_up(self) -> bool:
        """Return whether the number of messages of every topic equals the account's."""
        accounts = self.ledger.accounts
        return all(
            len(self.messages.get(name, ())) == account.used for name, account in accounts.items()
        ) and set(self.messages) <= set(accounts)


def read_back(
    path: Path, selection: Selection = EVERYTHING, limits: Limits = DEFAULT_LIMITS
) -> Reading:
    """Read a file to its end, as plain tuples."""
    messages: dict[str, list[Message]] = {}
    ledger = Ledger(str(path))
    with McapLog(path, limits) as log:
        names = tuple(topic.name for topic in log.topics)
        for block in log.read(ledger, selection):
            assert isinstance(block.rows, Messages)
            assert block.publish_ns is not None
            rows = block.rows
            messages.setdefault(block.topic, []).extend(
                (log_ns, publish_ns, bytes(rows.payload(i)))
                for i, (log_ns, publish_ns) in enumerate(
                    zip(block.log_ns.tolist(), block.publish_ns.tolist(), strict=True)
                )
            )
    return Reading(messages, ledger, names)


def read_coded(
    folder: Path,
    coded: bytes | bytearray | McapFile,
    selection: Selection = EVERYTHING,
    limits: Limits = DEFAULT_LIMITS,
) -> Reading:
    """Read the file with these bytes, which remains in the folder as ``log.mcap``."""
    path = folder / "log.mcap"
    path.write_bytes(coded.coded() if isinstance(coded, McapFile) else coded)
    return read_back(path, selection, limits)
