"""Decompression of chunks to at most their declared size, with checksum verification."""

from __future__ import annotations

from collections.abc import Callable
from threading import local
from typing import TYPE_CHECKING, Final, cast

import numpy as np
from isal.isal_zlib import crc32

from crosscue.replay.columns import Bytes
from crosscue.replay.readers.mcap.records import BrokenRecordError, ChunkHead

if TYPE_CHECKING:
    import zstandard

# Values of zstandard and lz4 for frames that do not declare their size.
UNKNOWN_SIZES: Final = (-1, 0)
# Small steps keep what precedes damage. The lz4 library also allocates memory for each.
STEP: Final = 256 << 10
# Bits of an lz4 frame's flags and of a block's length, and the reach of a block into earlier ones.
_LZ4_DICTIONARY: Final = 1
_LZ4_SIZE: Final = 8
_LZ4_STORED: Final = 1 << 31
_LZ4_WINDOW: Final = 64 << 10
# The zstd library copies what it decompresses once more, unless a frame's room is passed at once.
AT_ONCE: Final = 1 << 62


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
    records = body
    if head.compression and len(body):
        done, fault = _FILL[head.compression](body, head.size, room, AT_ONCE)
        if done > head.size:
            fault = f"decompresses to more than the {head.size} bytes it declares"
        if fault:
            raise BrokenRecordError(fault)
        records = room[:done]
    if len(records) != head.size:
        raise BrokenRecordError(f"decompressed to {len(records)} bytes, declared {head.size}")
    return _verified(records, head)


def inflate_prefix(body: Bytes, head: ChunkHead) -> Bytes:
    """Decompress the start of a truncated chunk; at most ``head.size`` unverified bytes."""
    if not head.compression or not len(body):
        return body[: head.size]
    room = np.empty(head.size + 1, dtype=np.uint8)
    done, _ = _FILL[head.compression](body, head.size, room, STEP)
    records = room[: min(done, head.size)]
    return _verified(records, head) if len(records) == head.size else records


def _verified(records: Bytes, head: ChunkHead) -> Bytes:
    if head.crc and crc32(records.data) != head.crc:
        raise BrokenRecordError("does not match its checksum")
    return records


def _fill_zstd(body: Bytes, size: int, room: Bytes, most: int) -> tuple[int, str]:
    """Decompress up to one byte more than ``size``; return the number, and what ended it early."""
    import zstandard

    done = 0
    try:
        declared = zstandard.frame_content_size(body.data)
        if declared > size:
            return 0, f"its zstd frame declares {declared} bytes, the chunk {size}"
        with _decompressor().stream_reader(body.data, read_across_frames=True) as stream:
            while step := stream.readinto(room.data[done : min(done + most, size + 1)]):
                done += step
    except zstandard.ZstdError as error:
        return done, f"zstd: {error}"
    return done, ""


_of_thread: Final = local()


def _decompressor() -> zstandard.ZstdDecompressor:
    """Return this thread's decompressor; creating one takes as long as a small chunk."""
    import zstandard

    if not hasattr(_of_thread, "zstd"):
        _of_thread.zstd = zstandard.ZstdDecompressor()
    return cast("zstandard.ZstdDecompressor", _of_thread.zstd)


def _fill_lz4(body: Bytes, size: int, room: Bytes, _: int) -> tuple[int, str]:
    """Decompress block by block, because the library copies a frame's stored blocks twice."""
    import lz4.block
    import lz4.frame

    done, view, out = 0, body.data, room.data
    try:
        frame = lz4.frame.get_frame_info(view)
        declared, most = frame["content_size"], frame["block_size"]
        if declared not in (*UNKNOWN_SIZES, size):
            return 0, f"its lz4 frame declares {declared} bytes, the chunk {size}"
        if frame["content_checksum"] or frame["block_checksum"] or view[4] & _LZ4_DICTIONARY:
            return _stream_lz4(view, size, out)
        window = _LZ4_WINDOW if frame["block_linked"] else 0
        at = 15 if view[4] & _LZ4_SIZE else 7
        while done <= size and at + 4 <= len(view):
            length = int.from_bytes(view[at : at + 4], "little")
            if not length:
                return done, ""
            is_stored, length = length & _LZ4_STORED, length & ~_LZ4_STORED
            part: bytes | memoryview = view[at + 4 : at + 4 + length]
            at += 4 + length
            if length > most:
                return done, f"lz4: a block of {length} bytes"
            if not is_stored and at <= len(view):
                past = out[max(0, done - window) : done]
                part = lz4.block.decompress(part, uncompressed_size=most, dict=past)
            elif not is_stored:
                break
            step = min(len(part), size + 1 - done)
            out[done : done + step] = part[:step]
            done += step
    except (RuntimeError, ValueError, EOFError, lz4.block.LZ4BlockError) as error:
        return done, f"lz4: {error}"
    return done, f"its lz4 frame does not end after {done} bytes"


def _stream_lz4(view: memoryview, size: int, out: memoryview) -> tuple[int, str]:
    """Decompress a frame of any kind by the library, which verifies the frame's checksums."""
    import lz4.frame

    done, used, is_done = 0, 0, False
    context = lz4.frame.create_decompression_context()
    while not is_done and done <= size:
        try:
            step, taken, is_done = lz4.frame.decompress_chunk(
                context, view[used:], max_length=min(size + 1 - done, STEP)
            )
        except (RuntimeError, ValueError, EOFError) as error:
            return done, f"lz4: {error}"
        if not step and not taken:
            break
        out[done : done + len(step)] = step
        done, used = done + len(step), used + taken
    return done, "" if is_done else f"its lz4 frame does not end after {done} bytes"


_FILL: Final[dict[str, Callable[[Bytes, int, Bytes, int], tuple[int, str]]]] = {
    "lz4": _fill_lz4,
    "zstd": _fill_zstd,
}
