"""Decompression bombs are refused, within bounded memory."""

from __future__ import annotations

import bz2
import re
import struct
from collections.abc import Callable
from pathlib import Path

import lz4.frame
import pytest
import zstandard

from crosscue.replay.limits import DEFAULT_LIMITS
from support.mcap_files import MAGIC, ChunkOf, channel, header, message, record, schema, text
from support.measured import measured
from support.rosbag_files import header_field
from support.rosbag_files import record as bag_record

BOMB_BYTES = 1 << 30
# Memory limit of a process that refuses a bomb, including Python and its libraries.
MAX_MB = 200
PIECE = bytes(1 << 20)


def zstd_bomb() -> bytes:
    packer = zstandard.ZstdCompressor(write_content_size=False).compressobj()
    return b"".join(packer.compress(PIECE) for _ in range(BOMB_BYTES >> 20)) + packer.flush()


def lz4_bomb() -> bytes:
    context = lz4.frame.create_compression_context()
    parts = [lz4.frame.compress_begin(context)]
    parts += [lz4.frame.compress_chunk(context, PIECE) for _ in range(BOMB_BYTES >> 20)]
    return b"".join([*parts, lz4.frame.compress_flush(context)])


def bz2_bomb() -> bytes:
    packer = bz2.BZ2Compressor()
    return b"".join(packer.compress(PIECE) for _ in range(64)) + packer.flush()


def mcap(body: bytes, compression: str, declared: int) -> bytes:
    """Write a recording with a valid chunk and a bomb."""
    sound = ChunkOf([schema(1), channel(1, 1, "/a"), message(1, 1, b"\0\1\0\0\1\0\0\0")])
    head = struct.pack("<QQQI", 1, 1, declared, 0) + text(compression)
    return MAGIC + header() + sound.coded() + record(6, head + struct.pack("<Q", len(body)) + body)


def bag(body: bytes, compression: str, declared: int) -> bytes:
    """Write a ROS 1 bag with a bomb and a connection."""
    names = {
        b"topic": b"/a",
        b"type": b"std_msgs/String",
        b"md5sum": b"x",
        b"message_definition": b"string data\n",
    }
    about = b"".join(header_field(*pair) for pair in names.items())
    return (
        b"#ROSBAG V2.0\n"
        + bag_record(
            b" " * 4027, op=b"\3", index_pos=bytes(8), conn_count=bytes(4), chunk_count=bytes(4)
        )
        + bag_record(about, op=b"\7", conn=bytes(4), topic=b"/a")
        + bag_record(
            body, op=b"\5", compression=compression.encode(), size=struct.pack("<I", declared)
        )
    )


CASES: dict[str, tuple[str, str, Callable[[], bytes], int]] = {
    "mcap zstd over the limit": (".mcap", "zstd", zstd_bomb, BOMB_BYTES),
    "mcap zstd more than declared": (".mcap", "zstd", zstd_bomb, 1000),
    "mcap lz4 over the limit": (".mcap", "lz4", lz4_bomb, BOMB_BYTES),
    "mcap lz4 more than declared": (".mcap", "lz4", lz4_bomb, 1000),
    "bag bz2 over the limit": (".bag", "bz2", bz2_bomb, BOMB_BYTES),
    "bag bz2 more than declared": (".bag", "bz2", bz2_bomb, 1000),
    "bag lz4 over the limit": (".bag", "lz4", lz4_bomb, BOMB_BYTES),
    "bag lz4 more than declared": (".bag", "lz4", lz4_bomb, 1000),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", list(CASES), ids=lambda name: name.replace(" ", "-"))
def test_bomb_is_refused_with_size_and_limit_in_bounded_memory(tmp_path: Path, case: str) -> None:
    suffix, compression, body, declared = CASES[case]
    path = tmp_path / f"bomb{suffix}"
    path.write_bytes((mcap if suffix == ".mcap" else bag)(body(), compression, declared))

    status, output, peak_mb = measured(["info", str(path)])

    assert status == 3
    assert peak_mb < MAX_MB
    assert str(declared) in output
    other = str(DEFAULT_LIMITS.chunk_bytes) if "limit" in case else "more"
    assert re.search(rf"\b{other}\b", output)
