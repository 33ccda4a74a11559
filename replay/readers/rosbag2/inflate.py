"""Decompression of messages that rosbag2 compressed individually with zstd."""

from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.columns import BLOCK_BYTES, Bytes, Int64s, Messages
from crosscue.replay.limits import Limits

# First bytes of a zstd frame as a little-endian number; no CDR message starts with them.
ZSTD_MAGIC: Final = 0xFD2FB528

DAMAGED: Final = "damaged compressed message"
_WINDOW_BYTES: Final = 1 << 27


def is_compressed(buffer: Bytes, start: Int64s, stop: Int64s) -> NDArray[np.bool_]:
    """Return a mask of the messages that start like a zstd frame, shape (N,)."""
    packed: NDArray[np.bool_] = stop - start >= 4
    words = np.ndarray((max(len(buffer) - 3, 0),), "<u4", buffer.data, 0, (1,))
    packed[packed] = words[start[packed]] == ZSTD_MAGIC
    return packed


def inflated(
    messages: Messages, limits: Limits
) -> Iterator[tuple[slice, Messages, dict[int, str]]]:
    """Decompress the compressed messages in parts of limited size.

    Yields:
        The range of rows of a part, its messages, and the problems of damaged messages by their
        index in the part. Damaged messages have an empty range.
    """
    packed = is_compressed(messages.buffer, messages.start, messages.stop)
    if not packed.any():
        yield slice(0, len(messages)), messages, {}
        return
    first, parts, bad, size = 0, list[bytes](), dict[int, str](), 0
    for i in range(len(messages)):
        raw = bytes(messages.payload(i))
        part, fault = _one(raw, limits) if packed[i] else (raw, "")
        if fault:
            bad[i - first] = fault
        parts.append(part)
        size += len(part)
        if size >= BLOCK_BYTES or i + 1 == len(messages):
            yield slice(first, i + 1), joined(parts), bad
            first, parts, bad, size = i + 1, [], {}, 0


def joined(parts: Sequence[bytes | memoryview]) -> Messages:
    """Return messages in one buffer."""
    length = np.fromiter(map(len, parts), dtype=np.int64, count=len(parts))
    stop = np.cumsum(length)
    return Messages(np.frombuffer(b"".join(parts), dtype=np.uint8), stop - length, stop)


def _one(raw: bytes, limits: Limits) -> tuple[bytes, str]:
    """Decompress a message within the limits; return it, or empty bytes and the problem."""
    import zstandard

    largest, limit = limits.message_bytes, str(limits.message_bytes)
    if limits.chunk_bytes < largest:
        largest, limit = limits.chunk_bytes, f"{limits.chunk_bytes} (--max-chunk)"
    try:
        declared = zstandard.frame_content_size(raw)
        if declared > largest:
            return b"", f"declares {declared} bytes, the limit is {limit}"
        room = largest if declared < 0 else declared
        stream = zstandard.ZstdDecompressor(max_window_size=_WINDOW_BYTES)
        with stream.stream_reader(raw) as reader:
            found = reader.read(room + 1)
    except (zstandard.ZstdError, MemoryError) as error:
        return b"", f"{len(raw)} bytes, zstd: {error}"
    if len(found) > room:
        said = "" if declared < 0 else f", declares {declared}"
        return b"", f"decompresses to more than {room} bytes{said}; the limit is {limit}"
    if 0 <= declared != len(found):
        return b"", f"decompresses to {len(found)} bytes, declares {declared}"
    return found, ""
