"""Decompression of chunks to at most their declared size, with checksum verification."""

from __future__ import annotations

from collections.abc import Callable
from threading import local
from typing import TYPE_CHECKING, Final, TypeAlias, cast

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.files.checksum import crc32
from crosscue.replay.readers.mcap.records import BrokenRecordError, ChunkHead

if TYPE_CHECKING:
    import zstandard

Bytes: TypeAlias = NDArray[np.uint8]

# Values of zstandard and lz4 for frames that do not declare their size.
UNKNOWN_SIZES: Final = (-1, 0)
LZ4_STEP: Final = 256 << 10


def inflate_chunk(body: Bytes, head: ChunkHead, room: Bytes) -> Bytes:
    """Decompress the records of a chunk, and verify their size and checksum.

    Args:
        body: Shape (B,): the chunk's records as stored.
        head: The chunk's header.
        room: Output buffer, one byte larger than ``head.size``; unused for uncompressed chunks.

    Returns:
        Shape (``head.size``,), uint8: the start of ``room``, or ``body``.

    Raises:
        BrokenRecordError: The records contradict the header. No memory beyond the declared size
            was allocated.
    """
    if len(body) != head.body_size:
        raise BrokenRecordError(f"holds {len(body)} of {head.body_size} bytes")
    records = _WHOLE[head.compression](body, head.size, room) if len(body) else body
    if len(records) != head.size:
        raise BrokenRecordError(f"decompressed to {len(records)} bytes, declared {head.size}")
    if head.crc and crc32(records.data) != head.crc:
        raise BrokenRecordError("does not match its checksum")
    return records


def inflate_prefix(body: Bytes, head: ChunkHead) -> Bytes:
    """Decompress the start of a truncated chunk; at most ``head.size`` unverified bytes."""
    if head.compression == "" or not len(body):
        return body[: head.size]
    give = _zstd_prefix if head.compression == "zstd" else _lz4_prefix
    records = give(body, head.size)
    if len(records) == head.size and head.crc and crc32(records.data) != head.crc:
        raise BrokenRecordError("does not match its checksum")
    return records


def _plain(body: Bytes, size: int, records: Bytes) -> Bytes:
    return body


def _zstd(body: Bytes, size: int, records: Bytes) -> Bytes:
    import zstandard

    try:
        declared = zstandard.frame_content_size(body.data)
        if declared > size:
            raise BrokenRecordError(f"its zstd frame declares {declared} bytes, the chunk {size}")
        # The buffer is one byte too large, so that oversized frames are detected.
        done = 0
        with _decompressor().stream_reader(body.data, read_across_frames=True) as stream:
            while done <= size:
                step = stream.readinto(records.data[done : size + 1])
                if not step:
                    break
                done += step
    except zstandard.ZstdError as error:
        raise BrokenRecordError(f"zstd: {error}") from None
    if done > size:
        raise BrokenRecordError(f"decompresses to more than the {size} bytes it declares")
    return records[:done]


_of_thread: Final = local()


def _decompressor() -> zstandard.ZstdDecompressor:
    """Return this thread's decompressor; creating one takes as long as a small chunk."""
    import zstandard

    if not hasattr(_of_thread, "zstd"):
        _of_thread.zstd = zstandard.ZstdDecompressor()
    return cast("zstandard.ZstdDecompressor", _of_thread.zstd)


def _lz4(body: Bytes, size: int, records: Bytes) -> Bytes:
    import lz4.frame

    done, used, is_done = 0, 0, False
    view, context = body.data, lz4.frame.create_decompression_context()
    try:
        declared = lz4.frame.get_frame_info(view)["content_size"]
        if declared not in (*UNKNOWN_SIZES, size):
            raise BrokenRecordError(f"its lz4 frame declares {declared} bytes, the chunk {size}")
        while not is_done:
            # Small steps, because the library allocates memory each time, which is slow if large.
            step, taken, is_done = lz4.frame.decompress_chunk(
                context, view[used:], max_length=min(size - done, LZ4_STEP) or 1
            )
            if not step and not taken:
                break
            if len(step) > size - done:
                raise BrokenRecordError(f"decompresses to more than the {size} bytes it declares")
            records[done : done + len(step)] = np.frombuffer(step, dtype=np.uint8)
            done, used = done + len(step), used + taken
    except (RuntimeError, ValueError, EOFError) as error:
        raise BrokenRecordError(f"lz4: {error}") from None
    if not is_done:
        raise BrokenRecordError(f"its lz4 frame does not end after {done} bytes")
    return records[:done]


def _zstd_prefix(body: Bytes, size: int) -> Bytes:
    import zstandard

    records, done = np.empty(size, dtype=np.uint8), 0
    with zstandard.ZstdDecompressor().stream_reader(body.data, read_across_frames=True) as stream:
        try:
            while done < size:
                step = stream.readinto(records.data[done : done + (128 << 10)])
                if not step:
                    break
                done += step
        except zstandard.ZstdError:
            pass  # keep the part before the damage
    return records[:done]


def _lz4_prefix(body: Bytes, size: int) -> Bytes:
    import lz4.frame

    stream = lz4.frame.LZ4FrameDecompressor()
    got: list[bytes] = []
    left, piece = size, body.tobytes()
    try:
        while left > 0:
            step = stream.decompress(piece, max_length=min(left, 4 << 20))
            got.append(step)
            left -= len(step)
            piece = b""
            if stream.eof or not step:
                break
    except (RuntimeError, ValueError, EOFError):
        pass  # keep the part before the damage
    return np.frombuffer(b"".join(got), dtype=np.uint8)


_WHOLE: Final[dict[str, Callable[[Bytes, int, Bytes], Bytes]]] = {
    "": _plain,
    "lz4": _lz4,
    "zstd": _zstd,
}
