"""Messages that rosbag2 compressed one by one (zstd), known by their own first bytes."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.base import BLOCK_BYTES, Bytes, Int64s, Limits, Messages

ZSTD_MAGIC: Final = 0xFD2FB528
"""As a little-endian number; no CDR message begins so."""

DAMAGED: Final = "damaged compressed message"
_WINDOW_BYTES: Final = 1 << 27


def is_compressed(buffer: Bytes, start: Int64s, stop: Int64s) -> NDArray[np.bool_]:
    """Shape (N,): which messages begin as a zstd frame does."""
    long: NDArray[np.bool_] = stop - start >= 4
    first = np.zeros(len(start), dtype=np.uint32)
    for shift in range(4):
        first[long] |= buffer[start[long] + shift].astype(np.uint32) << np.uint32(8 * shift)
    packed: NDArray[np.bool_] = long & (first == ZSTD_MAGIC)
    return packed


def inflated(
    messages: Messages, limits: Limits
) -> Iterator[tuple[slice, Messages, dict[int, str]]]:
    """Messages with the compressed ones decompressed, a bounded stretch at a time.

    Yields:
        The stretch of the rows given, its messages, and what is wrong with those that are damaged,
        by their number within the stretch; their range is empty.
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
            yield slice(first, i + 1), _joined(parts), bad
            first, parts, bad, size = i + 1, [], {}, 0


def _joined(parts: list[bytes]) -> Messages:
    length = np.fromiter(map(len, parts), dtype=np.int64, count=len(parts))
    stop = np.cumsum(length)
    return Messages(np.frombuffer(b"".join(parts), dtype=np.uint8), stop - length, stop)


def _one(raw: bytes, limits: Limits) -> tuple[bytes, str]:
    """The message, or nothing and why; never more than the limits allow is taken."""
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
        return b"", f"{len(raw)} bytes, zstd says: {error}"
    if len(found) > room:
        said = "" if declared < 0 else f", declares {declared}"
        return b"", f"decompresses to more than {room} bytes{said}; the limit is {limit}"
    if 0 <= declared != len(found):
        return b"", f"decompresses to {len(found)} bytes, declares {declared}"
    return found, ""
