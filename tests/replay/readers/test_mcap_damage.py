"""Damaged, truncated and hostile MCAP files: readable messages are read, losses are reported."""

import struct
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path

import lz4.frame
import numpy as np
import pytest
import zstandard

from crosscue.replay.ledger import Ledger
from crosscue.replay.limits import DEFAULT_LIMITS, Limits
from crosscue.replay.readers.mcap.chunks.inflate import inflate_chunk, inflate_prefix
from crosscue.replay.readers.mcap.reader import McapLog
from crosscue.replay.readers.mcap.records import BrokenRecordError, ChunkHead
from support.mcap_damage import Kind, copies, judge, sound_files, sound_parts
from support.mcap_files import (
    MAGIC,
    ChunkOf,
    McapFile,
    Message,
    Reading,
    channel,
    header,
    message,
    read_coded,
    record,
    schema,
    stored_chunk,
)
from support.trees import written


def messages_of(reading: Reading) -> Counter[tuple[str, Message]]:
    """Count all messages read, with their topics."""
    return Counter((t, one) for t, messages in reading.messages.items() for one in messages)


DEFINITIONS = [schema(1), channel(1, 1, "/a"), channel(2, 1, "/b")]
FORBIDDEN = (Kind.SILENT, Kind.WRONG, Kind.UNBALANCED)


def messages_on_both_channels(count: int, begin: int = 0) -> list[bytes]:
    return [message(1 + i % 2, begin + i, b"%05d" % i * 9) for i in range(count)]


@pytest.mark.parametrize(
    ("name", "coded"), [pytest.param(n, c, id=n.replace(" ", "-")) for n, c in sound_files()]
)
def test_any_damage_is_reported(name: str, coded: bytes, tmp_path: Path) -> None:
    truth = read_coded(tmp_path, coded)
    assert truth.ledger.is_whole
    assert truth.count() >= 600

    bad: list[str] = []
    for what, damaged in copies(coded, seed=len(coded), cuts=6, damages=14):
        verdict = judge(written(tmp_path / "log.mcap", damaged), truth)
        if verdict.kind in FORBIDDEN or (what.startswith("cut") and verdict.kind is Kind.SAME):
            bad.append(f"{what}: {verdict.kind.value}")

    assert bad == []


@pytest.mark.parametrize("compression", ["", "lz4", "zstd"])
def test_flipped_byte_drops_only_its_chunk_and_reports_it(tmp_path: Path, compression: str) -> None:
    parts = sound_parts(compression, is_chunked=True)
    coded = bytearray(McapFile(parts).coded())
    first = parts[0]
    assert isinstance(first, ChunkOf)
    at = coded.index(first.coded())
    coded[at + len(first.coded()) // 2] ^= 0x10
    reading = read_coded(tmp_path, coded)

    dropped = {name: account.dropped.total() for name, account in reading.ledger.accounts.items()}
    assert dropped == {"/imu": 9, "/can": 8, "/camera": 8}
    assert reading.count() == 600 - 25
    for loss in reading.ledger.drops():
        assert loss.reason == "damaged chunk"
        assert f"chunk at byte {at}:" in loss.detail
        assert loss.t_ns == 10**9


@pytest.mark.parametrize("compression", ["", "lz4", "zstd"])
@pytest.mark.parametrize("has_summary_crc", [True, False])
def test_damaged_chunk_header_is_repaired_from_index(
    tmp_path: Path, compression: str, has_summary_crc: bool
) -> None:
    parts = sound_parts(compression, is_chunked=True)
    third = parts[2]
    assert isinstance(third, ChunkOf)
    coded = McapFile(parts, summary_crc=has_summary_crc).coded()
    truth = read_coded(tmp_path, coded)
    begin, name = coded.index(third.coded()), len(compression)
    # Kind, length, both times, size, compression and stored size, but not the checksum.
    for at in (*range(37 - 4), *range(37, 49 + name)):
        damaged = bytearray(coded)
        damaged[begin + at] ^= 0x41

        reading = read_coded(tmp_path, damaged)

        assert messages_of(reading) == messages_of(truth), at
        assert reading.adds_up(), at
        assert any(f"chunk at byte {begin}" in notice for notice in reading.ledger.notices), at


BOMBS = {
    "declares 2^40": stored_chunk(b"x" * 20, 1 << 40, "zstd", 1 << 40),
    "declares 2^40 in a sound record": stored_chunk(b"x" * 20, 1 << 40, "zstd"),
    "decompresses to more than declared": stored_chunk(
        zstandard.ZstdCompressor(write_content_size=False).compress(bytes(64 << 20)), 100, "zstd"
    ),
    "frame declares more than chunk": stored_chunk(zstandard.compress(bytes(1 << 26)), 100, "zstd"),
    "millions of empty records": stored_chunk(
        zstandard.compress(record(0x42, b"") * 1_000_000), 9_000_000, "zstd"
    ),
    "unknown compression": stored_chunk(b"x" * 20, 20, "brotli"),
    "a record of 2^63 bytes": struct.pack("<BQ", 5, 1 << 63) + bytes(50),
    "a name of 4 GB": record(4, struct.pack("<HHI", 1, 1, 0xFFFFFFFF)),
}


@pytest.mark.parametrize("bomb", list(BOMBS), ids=lambda name: name.replace(" ", "-"))
def test_malicious_chunk_is_reported_quickly(tmp_path: Path, bomb: str) -> None:
    sound = ChunkOf([*DEFINITIONS, *messages_on_both_channels(10)])
    coded = MAGIC + header() + sound.coded() + BOMBS[bomb]
    limits = Limits(chunk_bytes=32 << 20, records_per_chunk=100_000)

    begin = time.process_time()
    reading = read_coded(tmp_path, coded, limits=limits)

    assert time.process_time() - begin < 5.0
    assert reading.count() == 10
    assert not reading.ledger.is_whole


@pytest.mark.parametrize("is_chunked", [True, False])
def test_message_over_size_limit_is_skipped_with_its_size(tmp_path: Path, is_chunked: bool) -> None:
    records = [*DEFINITIONS, message(1, 1), message(1, 2, bytes(3 << 20)), message(1, 3)]
    file = McapFile([ChunkOf(records)]) if is_chunked else McapFile(records)

    reading = read_coded(tmp_path, file, limits=Limits(message_bytes=2 << 20))

    assert [log for log, *_ in reading.messages["/a"]] == [1, 3]
    assert dict(reading.ledger.accounts["/a"].skipped) == {"message over the size limit": 1}
    assert str(3 << 20) in reading.ledger.details[0].detail
    assert reading.adds_up()


def test_schema_over_size_limit_is_omitted(tmp_path: Path) -> None:
    records = [schema(1, body=bytes(5_000)), channel(1, 1, "/a"), message(1, 1, b"x")]
    limits = Limits(schema_bytes=1_000)

    reading = read_coded(tmp_path, McapFile([ChunkOf(records)]), limits=limits)

    with McapLog(tmp_path / "log.mcap", limits) as log:
        (topic,) = log.topics
    assert topic.schema == b""
    assert reading.count() == 1
    assert any("its schema has 5000 bytes" in notice for notice in reading.ledger.notices)


@pytest.mark.parametrize("kind", [3, 4, 0x85])
@pytest.mark.parametrize("is_padded", [True, False])
def test_message_whose_kind_was_damaged_is_lost_and_reported(
    kind: int, is_padded: bool, tmp_path: Path
) -> None:
    named = [schema(1), channel(1, 1, "/a"), schema(2, ""), channel(2, 2, "/b", "")]
    if is_padded:
        named = [record(one[0], one[9:] + b"\x01\xff\xff") for one in DEFINITIONS]
    for sequence in (0, 1, 8, 20, 300, 70_000):
        records = list(named)
        for one in messages_on_both_channels(30, 1_790_000_000_000_000_000):
            records.append(one[:11] + struct.pack("<I", sequence) + one[15:])
        coded = bytearray(McapFile(records, summary=False).coded())
        sound = read_coded(tmp_path, coded)
        assert sound.count() == 30
        assert sound.ledger.is_whole

        coded[coded.index(records[20])] = kind

        reading = read_coded(tmp_path, coded)

        assert 1 <= (messages_of(sound) - messages_of(reading)).total() <= 2, sequence
        assert not reading.ledger.is_whole, sequence


def test_records_inside_payload_are_not_read_as_messages(tmp_path: Path) -> None:
    inner = b"".join(message(1, 10**9 + i, b"inner %d" % i) for i in range(20))
    records = [*DEFINITIONS, *(message(1, 10**9 + i, b"outer" + inner + b"!") for i in range(30))]
    coded = bytearray(McapFile(records, data_crc=True).coded())
    coded[coded.index(records[8])] = 0x55
    reading = read_coded(tmp_path, coded)

    assert all(payload.startswith(b"outer") for *_, payload in reading.messages["/a"])
    assert reading.count() >= 28


@pytest.mark.parametrize("compression", ["", "lz4", "zstd"])
def test_chunks_without_checksum_are_read_after_damaged_one(
    tmp_path: Path, compression: str
) -> None:
    parts = [
        replace(part, crc=0)
        for part in sound_parts(compression, is_chunked=True)
        if isinstance(part, ChunkOf)
    ]
    coded = bytearray(McapFile(parts, summary=False).coded())
    at = coded.index(parts[4].coded())
    coded[at + 1 : at + 9] = b"\xff" * 8
    reading = read_coded(tmp_path, coded)

    assert reading.count() == 575
    assert any(f"bytes {at} to " in drop.detail for drop in reading.ledger.drops())


def test_chunk_with_zeroed_header_and_checksum_is_reported(tmp_path: Path) -> None:
    parts = sound_parts("zstd", is_chunked=True)
    third = parts[2]
    assert isinstance(third, ChunkOf)
    coded = bytearray(McapFile(parts).coded())
    at = coded.index(third.coded())
    coded[at + 9 : at + 9 + 40 + 4] = bytes(44)
    reading = read_coded(tmp_path, coded)

    assert reading.count() == 575
    assert not reading.ledger.is_whole


def test_file_truncated_while_open_is_reported(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    coded = McapFile(sound_parts("zstd", is_chunked=True)).coded()
    path.write_bytes(coded)
    ledger = Ledger(str(path))
    with McapLog(path, DEFAULT_LIMITS) as log:
        with path.open("r+b") as stream:
            stream.truncate(len(coded) // 2)
        given = sum(len(block) for block in log.read(ledger))

    assert 200 < given < 400
    assert sum(a.dropped.total() for a in ledger.accounts.values()) == 600 - given


def test_recording_after_truncated_one_is_read(tmp_path: Path) -> None:
    first = McapFile(sound_parts("zstd", is_chunked=True)).coded()
    other = [schema(1, "c/D"), channel(1, 1, "/other"), *(message(1, i, b"o") for i in range(9))]
    reading = read_coded(tmp_path, first[: len(first) // 2] + McapFile([ChunkOf(other)]).coded())

    assert len(reading.messages["/other"]) == 9
    assert 200 < reading.count() < 400
    assert not reading.ledger.is_whole


@pytest.mark.parametrize("compression", ["zstd", "lz4"])
def test_cut_chunk_whose_frame_declares_more_than_the_chunk_has_no_message(
    compression: str,
) -> None:
    """A sound chunk that is cut yields what precedes the cut."""
    records = np.random.default_rng(0).bytes(1 << 16)
    whole = zstandard.compress(records)
    if compression == "lz4":
        whole = lz4.frame.compress(records, store_size=True)
    body = np.frombuffer(whole, np.uint8)[: len(whole) // 2]

    def found(size: int) -> int:
        return len(inflate_prefix(body, ChunkHead(0, 0, size, 0, compression, 0, len(whole))))

    assert found(len(records)) > 0
    assert found(len(records) - 1) == 0


@pytest.mark.parametrize("is_linked", [True, False])
@pytest.mark.parametrize("is_checked", [True, False])
@pytest.mark.parametrize("block_size", [4, 5, 7])
def test_lz4_frames_of_all_kinds_are_read_as_by_the_lz4_library(
    is_linked: bool, is_checked: bool, block_size: int
) -> None:
    """Flipped bits and cuts too, without a checksum of the chunk."""
    rng = np.random.default_rng(block_size)
    parts = [rng.bytes(90_000), bytes(150_000), rng.bytes(50) * 2000, rng.bytes(200_000)]
    records = b"".join(parts)
    options = {"block_linked": is_linked, "content_checksum": is_checked}
    options["block_checksum"] = block_size == 5
    whole = lz4.frame.compress(records, block_size=block_size, **options)
    read = 0
    for at in [0, *rng.integers(0, len(whole), 100).tolist(), *range(16)]:
        body = bytearray(whole)
        body[at] ^= int(rng.integers(0, 2)) << int(rng.integers(0, 8))
        del body[len(body) if at % 3 else at :]
        try:
            wanted = lz4.frame.decompress(bytes(body))
        except (RuntimeError, ValueError):
            wanted = b""
        head = ChunkHead(0, 0, len(records), 0, "lz4", 0, len(body))
        room = np.empty(len(records) + 1, np.uint8)
        try:
            found = inflate_chunk(np.frombuffer(body, np.uint8), head, room).tobytes()
        except BrokenRecordError:
            found = b""
        assert found == (wanted if len(wanted) == len(records) else b"")
        read += len(found) > 0
    assert read > 10
