"""MCAP files that are unusual but valid: exactly their messages are read."""

from __future__ import annotations

import struct
from pathlib import Path

import pytest

from crosscue.replay.base import Selection
from crosscue.replay.ledger import NOT_ASKED_TIME, NOT_ASKED_TOPIC
from crosscue.replay.limits import Limits
from crosscue.replay.logs.opening import open_log
from crosscue.replay.readers.mcap.reader import open_mcap
from support.mcap_files import (
    ChunkOf,
    McapFile,
    Message,
    attachment,
    channel,
    message,
    read_back,
    record,
    schema,
)

DEFINITIONS = [schema(1), channel(1, 1, "/a"), channel(2, 1, "/b")]


def stored(path: Path, file: McapFile | bytes) -> Path:
    path.write_bytes(file if isinstance(file, bytes) else file.coded())
    return path


def message_read(log: int, payload: bytes) -> Message:
    return (log, log, payload)


def test_messages_outside_chunks_are_read(tmp_path: Path) -> None:
    inside = [message(1, 10 + i, b"in") for i in range(5)]
    outside = [message(2, 100 + i, b"out") for i in range(7)]
    path = stored(tmp_path / "x.mcap", McapFile([ChunkOf([*DEFINITIONS, *inside]), *outside]))

    reading = read_back(path)

    assert {name: len(found) for name, found in reading.messages.items()} == {"/a": 5, "/b": 7}
    assert reading.ledger.is_whole


def test_consecutive_recordings_are_both_read(tmp_path: Path) -> None:
    one = McapFile([ChunkOf([*DEFINITIONS, message(1, 1, b"first")], "zstd")]).coded()
    two = McapFile([ChunkOf([*DEFINITIONS, message(1, 2, b"second")], "lz4")]).coded()

    reading = read_back(stored(tmp_path / "x.mcap", one + two))

    assert reading.messages == {"/a": [message_read(1, b"first"), message_read(2, b"second")]}
    assert any("2 consecutive recordings" in notice for notice in reading.ledger.notices)
    assert reading.ledger.is_whole
    assert reading.ledger.accounts["/a"].declared == 2


@pytest.mark.parametrize("is_chunked", [True, False])
@pytest.mark.parametrize("summary", [True, False])
def test_message_uses_latest_preceding_channel_definition(
    tmp_path: Path, is_chunked: bool, summary: bool
) -> None:
    records = [
        *DEFINITIONS,
        message(1, 1, b"p"),
        channel(1, 1, "/other"),
        message(1, 2, b"q"),
        message(2, 3, b"r"),
        channel(1, 1, "/a"),
        message(1, 4, b"s"),
    ]
    parts = [ChunkOf(records)] if is_chunked else records
    path = stored(tmp_path / "x.mcap", McapFile(parts, summary=summary))

    reading = read_back(path)

    assert reading.messages == {
        "/a": [message_read(1, b"p"), message_read(4, b"s")],
        "/other": [message_read(2, b"q")],
        "/b": [message_read(3, b"r")],
    }
    assert reading.ledger.is_whole


def test_one_name_with_two_types_becomes_separate_topics_with_notice(tmp_path: Path) -> None:
    records = [
        schema(1, "a/B"),
        schema(2, "c/D"),
        channel(1, 1, "/x"),
        channel(2, 2, "/x"),
        channel(3, 1, "/x"),
        channel(4, 1, "/x", "json"),
        *(message(number, number, b"%d" % number) for number in (1, 2, 3, 4)),
    ]
    path = stored(tmp_path / "x.mcap", McapFile([ChunkOf(records)]))

    with open_mcap(path, Limits()) as log:
        types = {topic.name: (topic.type_name, topic.declared) for topic in log.topics}
    reading = read_back(path)

    assert types == {"/x": ("a/B", 2), "/x#2": ("c/D", 1), "/x#3": ("a/B", 1)}
    assert [payload for *_, payload in reading.messages["/x"]] == [b"1", b"3"]
    assert any("/x#2" in notice for notice in reading.ledger.notices)


def test_non_utf8_topic_name_is_escaped(tmp_path: Path) -> None:
    records = [schema(1, b"a/\xff"), channel(1, 1, b"/caf\xe9"), message(1, 1, b"x")]

    reading = read_back(stored(tmp_path / "x.mcap", McapFile([ChunkOf(records)])))

    assert list(reading.messages) == ["/caf\\xe9"]


def test_channel_without_schema_has_no_type(tmp_path: Path) -> None:
    records = [channel(1, 0, "/a", "json"), message(1, 1, b"{}")]
    path = stored(tmp_path / "x.mcap", McapFile([ChunkOf(records)]))

    with open_log(path) as log:
        (topic,) = log.topics

    assert (topic.type_name, topic.encoding, topic.schema) == ("", "json", b"")
    assert read_back(path).count() == 1


def test_times_may_decrease_and_repeat(tmp_path: Path) -> None:
    logs = [5, 6, 7, 1, 1, 9]
    records = [*DEFINITIONS, *(message(1, log) for log in logs)]

    reading = read_back(stored(tmp_path / "x.mcap", McapFile([ChunkOf(records)])))

    assert [log for log, *_ in reading.messages["/a"]] == logs


def test_log_time_beyond_int64_is_skipped_with_reason(tmp_path: Path) -> None:
    records = [
        *DEFINITIONS,
        message(1, 7),
        message(1, (1 << 63) - 1),
        message(1, 1 << 63, publish=1),
    ]
    reading = read_back(stored(tmp_path / "x.mcap", McapFile([ChunkOf(records)])))

    assert [log for log, *_ in reading.messages["/a"]] == [7, (1 << 63) - 1]
    assert dict(reading.ledger.accounts["/a"].skipped) == {
        "log time after the year 2262 (2^63 ns or later)": 1
    }
    assert reading.ledger.is_whole


def test_publish_time_beyond_int64_counts_as_unavailable(tmp_path: Path) -> None:
    records = [*DEFINITIONS, message(1, 7, b"x", publish=(1 << 64) - 1)]
    reading = read_back(stored(tmp_path / "x.mcap", McapFile([ChunkOf(records)])))

    assert reading.messages == {"/a": [message_read(7, b"x")]}
    assert any("publish times" in notice for notice in reading.ledger.notices)


def test_unknown_record_kinds_are_ignored_with_notice(tmp_path: Path) -> None:
    odd = [record(0x99, b"private"), record(0x42, bytes(50))]
    chunk = ChunkOf([*DEFINITIONS, message(1, 1, b"x"), *odd, message(1, 2, b"y")])
    path = stored(tmp_path / "x.mcap", McapFile([*odd, chunk, *odd, message(2, 3, b"z")]))

    reading = read_back(path)

    assert reading.messages == {
        "/a": [message_read(1, b"x"), message_read(2, b"y")],
        "/b": [message_read(3, b"z")],
    }
    assert any("unknown kinds" in notice for notice in reading.ledger.notices)
    assert reading.ledger.is_whole


def test_unknown_record_kinds_are_ignored_in_recording_without_chunks(tmp_path: Path) -> None:
    odd = record(0x99, b"a private record of its application")
    parts = [odd, *DEFINITIONS, odd, message(1, 1, b"x"), odd, message(2, 2, b"y"), odd]
    path = stored(tmp_path / "x.mcap", McapFile(parts, summary=False))

    reading = read_back(path)

    assert reading.messages == {"/a": [message_read(1, b"x")], "/b": [message_read(2, b"y")]}
    assert reading.ledger.is_whole


def test_wrong_message_index_is_ignored_with_notice(tmp_path: Path) -> None:
    chunk = ChunkOf([*DEFINITIONS, *(message(1, i, b"%d" % i) for i in range(20))])
    coded = bytearray(McapFile([chunk]).coded())
    at = coded.index(record(7, struct.pack("<H", 1) + struct.pack("<I", 320))[:1] + b"\x46\x01")
    coded[at + 9 + 6 + 8] ^= 4  # The offset of the first message.

    reading = read_back(stored(tmp_path / "x.mcap", bytes(coded)))

    assert reading.count() == 20
    assert any("message indexes" in notice for notice in reading.ledger.notices)
    assert reading.ledger.is_whole


def test_messages_of_undeclared_channel_are_dropped(tmp_path: Path) -> None:
    chunk = ChunkOf([*DEFINITIONS, message(9, 1), message(9, 2), message(1, 3)])
    reading = read_back(stored(tmp_path / "x.mcap", McapFile([chunk])))

    assert reading.count() == 1
    assert reading.ledger.accounts[""].dropped.total() == 2
    assert not reading.ledger.is_whole


def test_messages_missing_from_statistics_count_are_dropped(tmp_path: Path) -> None:
    chunks = [ChunkOf([*DEFINITIONS, message(1, i)]) for i in range(3)]
    full = McapFile(chunks).coded()
    short = McapFile(chunks[:2]).coded()
    summary_of_full = full[struct.unpack_from("<Q", full, len(full) - 28)[0] :]
    data_of_short = short[: struct.unpack_from("<Q", short, len(short) - 28)[0]]
    shift = struct.pack("<Q", len(data_of_short))
    joined = data_of_short + summary_of_full[:-28] + shift + bytes(12) + summary_of_full[-8:]

    reading = read_back(stored(tmp_path / "x.mcap", joined))

    assert reading.count() == 2
    assert reading.ledger.accounts["/a"].dropped.total() == 1


def test_attachment_checksums_are_verified(tmp_path: Path) -> None:
    good, bad = attachment("a.txt", b"text"), attachment("b.txt", b"text", crc=7)
    file = McapFile([good, ChunkOf([*DEFINITIONS, message(1, 1)]), bad])

    reading = read_back(stored(tmp_path / "x.mcap", file))

    assert "1 of 2 attachments" in reading.ledger.integrity
    assert any("attachments" in notice for notice in reading.ledger.notices)
    assert reading.count() == 1


def test_chunk_without_checksum_among_others_is_reported(tmp_path: Path) -> None:
    chunks = [ChunkOf([*DEFINITIONS, message(1, 1)]), ChunkOf([message(1, 2)], crc=0)]
    reading = read_back(stored(tmp_path / "x.mcap", McapFile(chunks)))

    assert reading.count() == 2
    assert any("1 of 2 chunks have no checksum" in notice for notice in reading.ledger.notices)


def test_file_without_checksums_reports_it(tmp_path: Path) -> None:
    file = McapFile([ChunkOf([*DEFINITIONS, message(1, 1)], crc=0)], summary_crc=False)

    reading = read_back(stored(tmp_path / "x.mcap", file))

    assert reading.count() == 1
    assert reading.ledger.integrity == "no checksum covers 1 chunk"


def indexed_file(tmp_path: Path, is_indexed: bool) -> Path:
    chunks = [
        ChunkOf(
            [*DEFINITIONS, *(message(1 + (k + i) % 2, 100 * k + i, b"%d" % i) for i in range(10))]
            if k % 3
            else [*DEFINITIONS, *(message(1, 100 * k + i, b"%d" % i) for i in range(10))],
            "zstd",
            is_indexed=is_indexed,
        )
        for k in range(9)
    ]
    return stored(tmp_path / f"{is_indexed}.mcap", McapFile(chunks, data_crc=True))


@pytest.mark.parametrize(
    "selection",
    [
        Selection(topics=frozenset({"/b"})),
        Selection(start_ns=205, end_ns=502),
        Selection(topics=frozenset({"/a"}), start_ns=403),
        Selection(topics=frozenset(), end_ns=-5),
        Selection(topics=frozenset({"/b", "/nowhere"}), end_ns=1 << 70),
    ],
)
def test_selection_is_same_with_and_without_index(tmp_path: Path, selection: Selection) -> None:
    everything = read_back(indexed_file(tmp_path, True))
    wanted = {
        topic: kept
        for topic, messages in everything.messages.items()
        if selection.wants(topic)
        and (
            kept := [
                m
                for m in messages
                if (selection.start_ns or 0) <= m[0]
                and (selection.end_ns is None or m[0] < selection.end_ns)
            ]
        )
    }
    with_index = read_back(indexed_file(tmp_path, True), selection)
    without = read_back(indexed_file(tmp_path, False), selection)

    assert with_index.messages == without.messages == wanted
    assert with_index.ledger.accounts == without.ledger.accounts
    assert with_index.ledger.is_whole
    assert with_index.adds_up()
    assert "; the rest was not" in with_index.ledger.integrity
    reasons = {r for a in with_index.ledger.accounts.values() for r in a.skipped}
    assert reasons <= {NOT_ASKED_TIME, NOT_ASKED_TOPIC}


def test_reading_twice_yields_same_result(tmp_path: Path) -> None:
    path = indexed_file(tmp_path, True)

    assert read_back(path) == read_back(path)
