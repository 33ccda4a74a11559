"""A chunk whose own header is damaged, read by what the summary's index says of it.

Nobody has to be believed: the chunk's own checksum, of its decompressed records, is the proof.
"""

from __future__ import annotations

from typing import Final

from crosscue.replay.base import Limits
from crosscue.replay.readers.mcap.bytes import ByteFile
from crosscue.replay.readers.mcap.chunks.inflate import inflate
from crosscue.replay.readers.mcap.records import (
    CHUNK_FIXED,
    COMPRESSIONS,
    PREFIX,
    BrokenRecordError,
    ChunkHead,
    ChunkIndex,
)

REPAIRED: Final = "its header is damaged, repaired by the summary and proved by the checksum"
_CRC_AT: Final = PREFIX.size + 24


def proved_head(file: ByteFile, index: ChunkIndex, limits: Limits) -> ChunkHead | None:
    """A chunk's head as the summary has it, if the chunk's checksum proves it; else None.

    Args:
        file: The bytes.
        index: What the summary says of the chunk.
        limits: Nothing larger is decompressed.
    """
    name = index.compression
    body_at = CHUNK_FIXED + len(name)
    if name not in COMPRESSIONS or index.length != PREFIX.size + body_at + index.body_size:
        return None
    crc = int.from_bytes(file.read(index.at + _CRC_AT, 4).tobytes(), "little")
    if not crc or max(index.size, index.body_size) > limits.chunk_bytes:
        return None
    head = ChunkHead(index.start, index.end, index.size, crc, name, body_at, index.body_size)
    try:
        body = file.read(index.at + PREFIX.size + body_at, index.body_size)
        inflate(body, head, file.buffers.take(index.size + 1))
    except BrokenRecordError:
        return None
    return head


def is_doubtful(kind: bool, head: ChunkHead | None, index: ChunkIndex) -> bool:
    """Does the summary say otherwise what a chunk is, and where and how its records are stored?

    Args:
        kind: Its record says that it is a chunk.
        head: What it says of itself; None if that cannot be read.
        index: What the summary says.
    """
    if head is None or not kind:
        return True
    said = (head.size, head.body_size, head.compression)
    return said != (index.size, index.body_size, index.compression)
