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
    from xxhash import xxh32_intdigest

    done, view, out = 0, body.data, room.data
    try:
        frame = lz4.frame.get_frame_info(view)
        declared, most, after = frame["content_size"], frame["block_size"], 0
        if declared not in (*UNKNOWN_SIZES, size):
            return 0, f"its lz4 frame declares {declared} bytes, the chunk {size}"
        # The header may have a size of eight bytes and the number of a dictionary.
        at = 7 + (view[4] & _LZ4_SIZE) + 4 * (view[4] & _LZ4_DICTIONARY)
        while done <= size and (length := _number(view, at)):
            is_stored, at, length = length & _LZ4_STORED, at + 4, length & ~_LZ4_STORED
            part: bytes | memoryview = view[at : at + length]
            after = at + length
            if length > most or (after > len(view) and not is_stored):
                return done, f"lz4: a block of {length} bytes at byte {at} of {len(view)}"
            if frame["block_checksum"] and after <= len(view):
                if xxh32_intdigest(part) != _number(view, after):
                    return done, "lz4: a block does not match its checksum"
                after += 4
            if not is_stored:
                past = out[max(0, done - _LZ4_WINDOW) : done] if frame["block_linked"] else b""
                part = lz4.block.decompress(part, uncompressed_size=most, dict=past)
            if len(part) > size + 1 - done:
                part = part[: size + 1 - done]
            begin, done, at = done, done + len(part), after
            out[begin:done] = part
    except (RuntimeError, ValueError, EOFError, lz4.block.LZ4BlockError) as error:
        return done, f"lz4: {error}"
    if at + 4 > len(view):
        return done, f"its lz4 frame does not end after {done} bytes"
    is_wrong = frame["content_checksum"] and xxh32_intdigest(out[:done]) != _number(view, at + 4)
    return done, "lz4: its content does not match its checksum" if is_wrong else ""


def _number(view: memoryview, at: int) -> int:
    return int.from_bytes(view[at : at + 4], "little")


_FILL: Final[dict[str, Callable[[Bytes, int, Bytes, int], tuple[int, str]]]] = {
    "lz4": _fill_lz4,
    "zstd": _fill_zstd,
}
