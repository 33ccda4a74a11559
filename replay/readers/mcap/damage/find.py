"""Search for the next chunk or recording after unreadable records.

A candidate is accepted as a chunk only if it is verified: its lengths are consistent, and its
records match their checksum. Without a checksum, the records must fill the chunk and be within its
declared time range. The search ends where another recording starts, so that the chunks of that
recording are not accepted.
"""

from typing import Final

import numpy as np

from crosscue.replay.columns import Bytes
from crosscue.replay.limits import Limits
from crosscue.replay.readers.mcap.bytes import PIECE, ByteFile
from crosscue.replay.readers.mcap.chunks.inflate import inflate_chunk
from crosscue.replay.readers.mcap.chunks.rows import NEVER_IN_A_CHUNK, rows_by_scan
from crosscue.replay.readers.mcap.records import (
    CHUNK_FIXED,
    COMPRESSIONS,
    MAGIC,
    MAX_HEAD,
    PREFIX,
    BrokenRecordError,
    ChunkHead,
    ChunkIndex,
    Op,
    read_chunk_head,
)

# Number of bytes searched first; doubled until something is found.
FIRST_PIECE: Final = 4 << 10
# Maximum number of candidates decompressed, which keeps a search linear in its bytes.
TRIES: Final = 16


def find_bytes(file: ByteFile, at: int, end: int, wanted: bytes) -> int | None:
    """Return the next offset of these bytes from ``at`` on that ends before ``end``."""
    while at + len(wanted) <= end:
        window = bytes(file.read(at, min(PIECE, end - at)))
        found = window.find(wanted)
        if found >= 0:
            return at + found
        at += max(len(window) - len(wanted) + 1, 1)
    return None


def find_chunk(
    file: ByteFile, since: int, at: int, until: int, end: int, limits: Limits
) -> tuple[int, bool] | None:
    """Find the next chunk or recording.

    Args:
        file: The bytes.
        since: First offset at which another recording may start. It is before ``at`` if the record
            before the damage may extend over the recording's start.
        at: First offset at which a chunk may start.
        until: End of the search.
        end: Latest end of a chunk.
        limits: Chunks over these limits are not tried.

    Returns:
        The offset, and True for a chunk or False for a recording; None if neither is found.
    """
    begins = MAGIC + bytes([Op.HEADER])
    other = find_bytes(file, since, min(at + len(begins), until), begins)
    tries, piece = 0, FIRST_PIECE
    while other is None and at < until:
        behind = min(at + piece, until)
        other = find_bytes(file, at, min(behind + len(begins), end), begins)
        stop = end if other is None else other
        window = file.read(at, min(piece + MAX_HEAD, stop - at))
        for offset in _candidates(window, min(piece, behind - at)):
            if tries < TRIES and _agrees(file, at + offset, end, limits):
                tries += 1
                if _is_verified(file, at + offset, limits):
                    return at + offset, True
        at, piece = behind, min(2 * piece, PIECE)
    return None if other is None else (other, False)


def _candidates(window: Bytes, limit_at: int) -> list[int]:
    """Return offsets up to ``limit_at`` at which a chunk of plausible length may start."""
    first = window[: max(min(limit_at, len(window) - PREFIX.size - CHUNK_FIXED), 0)]
    at = np.flatnonzero(first == Op.CHUNK)
    for byte in (6, 7, 8):  # no chunk has a length of 2^40 bytes
        at = at[window[at + byte] == 0]
    for byte in (1, 2, 3):  # nor a compression name of 256 characters
        at = at[window[at + PREFIX.size + 28 + byte] == 0]
    found: list[int] = at.tolist()
    return found


def _agrees(file: ByteFile, at: int, end: int, limits: Limits) -> bool:
    """Return whether the lengths of a chunk at ``at`` would be consistent."""
    raw = file.peek(at, MAX_HEAD)
    length = PREFIX.unpack_from(raw)[1]
    try:
        head = read_chunk_head(raw[PREFIX.size :])
    except BrokenRecordError:
        return False
    return (
        head.compression in COMPRESSIONS
        and bool(head.size)
        and length == head.body_at + head.body_size
        and at + PREFIX.size + length <= end
        and max(head.size, head.body_size) <= limits.chunk_bytes
    )


def _is_verified(file: ByteFile, at: int, limits: Limits) -> bool:
    head = read_chunk_head(file.peek(at, MAX_HEAD)[PREFIX.size :])
    body_at = at + PREFIX.size + head.body_at
    try:
        room = file.buffers.take(head.size + 1)
        records = inflate_chunk(file.read(body_at, head.body_size), head, room)
        return bool(head.crc) or _is_filled(records, head, limits)
    except BrokenRecordError:
        return False


def _is_filled(records: Bytes, head: ChunkHead, limits: Limits) -> bool:
    """Return whether records fill a chunk without checksum and lie in its declared time range."""
    rows = rows_by_scan(records, NEVER_IN_A_CHUNK, limits.records_per_chunk)
    if rows.end != len(records) or not len(rows):
        return False
    return bool(rows.log.min() == head.start and rows.log.max() == head.end)


REPAIRED: Final = "its damaged header was repaired from the summary and verified by the checksum"
_CRC_AT: Final = PREFIX.size + 24


def verified_head(file: ByteFile, index: ChunkIndex, limits: Limits) -> ChunkHead | None:
    """Return a chunk's header from the summary if the chunk's checksum verifies it; else None.

    Args:
        file: The bytes.
        index: Entry of the chunk in the summary.
        limits: Maximum sizes that are decompressed.
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
        inflate_chunk(body, head, file.buffers.take(index.size + 1))
    except BrokenRecordError:
        return None
    return head


def is_doubtful(kind: bool, head: ChunkHead | None, index: ChunkIndex) -> bool:
    """Return whether a chunk's record contradicts its entry in the summary.

    Args:
        kind: True if the record's operation code is that of a chunk.
        head: Header of the chunk; None if it cannot be read.
        index: Entry of the chunk in the summary.
    """
    if head is None or not kind:
        return True
    said = (head.size, head.body_size, head.compression)
    return said != (index.size, index.body_size, index.compression)
