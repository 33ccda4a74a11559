"""Decompression bombs in logs are refused in bounded memory."""

import bz2
import gzip
import re
import shutil
import sqlite3
import struct
import zlib
from collections.abc import Callable
from contextlib import closing
from functools import cache
from pathlib import Path

import lz4.frame
import pytest
import zstandard

from crosscue.replay.limits import DEFAULT_LIMITS, MIB
from support.can_files import blf, random_frames
from support.mcap_files import MAGIC, ChunkOf, channel, header, message, schema, stored_chunk
from support.measured import measured
from support.mf4_files import unsorted
from support.rosbag_files import bag, chunk, connection, rows_of, write_folder
from support.trees import written

BOMB_BYTES = 1 << 30
# Memory limit of a process that refuses a bomb, including Python and its libraries.
MAX_MB = 200
PIECE = bytes(1 << 20)
Writer = Callable[[Path], Path]


@cache
def zstd_bomb(size: int = -1) -> bytes:
    """Return a zstd frame that declares its size, unless it is -1."""
    packer = zstandard.ZstdCompressor(write_content_size=size >= 0).compressobj(size=size)
    return b"".join(packer.compress(PIECE) for _ in range(BOMB_BYTES >> 20)) + packer.flush()


@cache
def lz4_bomb() -> bytes:
    context = lz4.frame.create_compression_context()
    parts = [lz4.frame.compress_begin(context)]
    parts += [lz4.frame.compress_chunk(context, PIECE) for _ in range(BOMB_BYTES >> 20)]
    return b"".join([*parts, lz4.frame.compress_flush(context)])


@cache
def bz2_bomb() -> bytes:
    packer = bz2.BZ2Compressor()
    return b"".join(packer.compress(PIECE) for _ in range(64)) + packer.flush()


def _chunk(suffix: str, coding: str, body: Callable[[], bytes], declared: int) -> Writer:
    def make(folder: Path) -> Path:
        path = folder / f"bomb{suffix}"
        if suffix == ".mcap":
            parts = [schema(1), channel(1, 1, "/a"), message(1, 1, b"\0\1\0\0\1\0\0\0")]
            sound = MAGIC + header() + ChunkOf(parts).coded()
            path.write_bytes(sound + stored_chunk(body(), declared, coding))
        else:
            bag(path, connection(0, b"/a"), chunk(body(), coding.encode(), declared))
        return path

    return make


@cache
def _deflated(size: int) -> bytes:
    packer = zlib.compressobj(1)
    return b"".join(packer.compress(PIECE) for _ in range(size >> 20)) + packer.flush()


def _blf(declared: int) -> Writer:
    def make(folder: Path) -> Path:
        path = folder / "bomb.blf"
        body = struct.pack("<H6xL4x", 2, declared) + _deflated(BOMB_BYTES)
        size = 16 + len(body)  # Of the object, including its header.
        padded = body + bytes(size % 4)
        path.write_bytes(
            blf(random_frames(30)) + struct.pack("<4sHHII", b"LOBJ", 16, 1, size, 10) + padded
        )
        return path

    return make


def _in_db3(size: int) -> Writer:
    def make(folder: Path) -> Path:
        bag = write_folder(folder / "bag", rows_of(40))
        (path,) = bag.glob("*.db3")
        with sqlite3.connect(path) as database:
            database.execute(
                "UPDATE messages SET data = ? WHERE id = (SELECT max(id) FROM messages)",
                (zstd_bomb(size),),
            )
        return path

    return make


def _bag_with_zstd_file(size: int) -> Writer:
    def make(folder: Path) -> Path:
        bag = write_folder(folder / "bag", rows_of(40))
        (plain,) = bag.glob("*.db3")
        plain.with_name(plain.name + ".zstd").write_bytes(zstd_bomb(size))
        plain.unlink()
        return bag

    return make


def _in_wal(folder: Path) -> Path:
    """Write a bag of a killed recorder whose last row, the bomb, is only in the -wal file."""
    bag = write_folder(folder / "bag", rows_of(40))
    (path,) = bag.glob("*.db3")
    killed = folder / "killed"
    shutil.copytree(bag, killed)
    with closing(sqlite3.connect(path)) as database:
        database.execute("PRAGMA journal_mode = WAL")
        database.execute("PRAGMA wal_autocheckpoint = 0")
        database.execute(
            "UPDATE messages SET data = ? WHERE id = (SELECT max(id) FROM messages)",
            (zstd_bomb(BOMB_BYTES),),
        )
        database.commit()
        for one in bag.glob("*.db3*"):
            shutil.copy(one, killed / one.name)
    assert list(killed.glob("*-wal"))
    return killed


def _mf4(size: int, declared: int) -> Writer:
    """Replace a log's second compressed block by another one at the file's end."""

    def make(folder: Path) -> Path:
        sound = unsorted(
            random_frames(200), virtual=True, is_finalized=True, stretch=500, coding=0
        ).content
        packed = _deflated(size)
        head = struct.pack("<2sBxLQQ", b"DT", 0, 0, declared, len(packed))
        block = struct.pack("<4s4xQQ", b"##DZ", 24 + len(head) + len(packed), 0) + head + packed
        second = sound.index(b"##DZ", sound.index(b"##DZ") + 1)
        sound += bytes(-len(sound) % 8)
        listed = sound.replace(struct.pack("<Q", second), struct.pack("<Q", len(sound)), 1)
        return written(folder / "bomb.mf4", listed + block)

    return make


BYTES, CHUNK, MESSAGE = BOMB_BYTES, DEFAULT_LIMITS.chunk_bytes, DEFAULT_LIMITS.message_bytes
# How to write the log, the exit status, and the declared or read size and the limit.
LOGS: dict[str, tuple[Writer, int, object, object]] = {
    "MCAP zstd over the limit": (_chunk(".mcap", "zstd", zstd_bomb, BYTES), 3, BYTES, CHUNK),
    "MCAP zstd more than declared": (_chunk(".mcap", "zstd", zstd_bomb, 1000), 3, 1000, "more"),
    "MCAP lz4 over the limit": (_chunk(".mcap", "lz4", lz4_bomb, BYTES), 3, BYTES, CHUNK),
    "MCAP lz4 more than declared": (_chunk(".mcap", "lz4", lz4_bomb, 1000), 3, 1000, "more"),
    "bag bz2 over the limit": (_chunk(".bag", "bz2", bz2_bomb, BYTES), 3, BYTES, CHUNK),
    "bag bz2 more than declared": (_chunk(".bag", "bz2", bz2_bomb, 1000), 3, 1000, "more"),
    "bag lz4 over the limit": (_chunk(".bag", "lz4", lz4_bomb, BYTES), 3, BYTES, CHUNK),
    "bag lz4 more than declared": (_chunk(".bag", "lz4", lz4_bomb, 1000), 3, 1000, "more"),
    "BLF over the limit": (_blf(BYTES), 3, BYTES, CHUNK),
    "BLF more than declared": (_blf(1000), 3, "more than 1000", "declares 1000"),
    "db3 message over the limit": (_in_db3(BOMB_BYTES), 3, BYTES, MESSAGE),
    "db3 message without declared size": (_in_db3(-1), 3, f"more than {MESSAGE}", MESSAGE),
    "MF4 over the limit": (_mf4(BYTES, BYTES), 3, BYTES, CHUNK),
    "MF4 more than declared": (_mf4(BYTES, 500), 3, "more than 500", "declares 500"),
    "db3 message in the WAL": (_in_wal, 3, BYTES, MESSAGE),
    "zstd file with declared size": (_bag_with_zstd_file(BYTES), 4, BYTES, CHUNK),
    "zstd file": (_bag_with_zstd_file(-1), 4, r"\d+ bytes decompress", CHUNK),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", list(LOGS), ids=lambda name: name.replace(" ", "-"))
def test_bomb_in_log_is_refused_with_size_and_limit(tmp_path: Path, case: str) -> None:
    make, wanted, *numbers = LOGS[case]
    path = make(tmp_path)

    status, output, peak_mb = measured(["info", str(path)])

    assert status == wanted, output
    assert peak_mb < MAX_MB
    for number in numbers:
        assert re.search(str(number), output), (number, output)


@pytest.mark.slow
def test_gzip_file_is_refused_without_decompression(tmp_path: Path) -> None:
    path = tmp_path / "drive.mcap.gz"
    with gzip.open(path, "wb", compresslevel=1) as file:
        for _ in range(BOMB_BYTES >> 20):
            file.write(PIECE)

    status, output, peak_mb = measured(["info", str(path)])

    assert status == 4, output
    assert peak_mb < MAX_MB
    assert "gzip" in output


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["message", "file"])
def test_max_chunk_option_limits_zstd_size_in_bag(tmp_path: Path, kind: str) -> None:
    make = _in_db3 if kind == "message" else _bag_with_zstd_file
    path = make(BOMB_BYTES)(tmp_path)

    status, output, _ = measured(["info", str(path), "--max-chunk", "2"])

    assert status == (3 if kind == "message" else 4)
    assert f"declares {BOMB_BYTES} bytes, the limit is {2 * MIB} (--max-chunk)" in output
