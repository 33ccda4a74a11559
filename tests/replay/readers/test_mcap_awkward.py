"""MCAP files that are unusual but valid: exactly their messages are read."""

from __future__ import annotations

from pathlib import Path

import pytest

from crosscue.replay.ledger import Ledger
from crosscue.replay.limits import Limits
from crosscue.replay.readers.mcap.reader import McapLog
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

    with McapLog(path, Limits()) as log:
        types = {topic.name: (topic.type_name, topic.declared) for topic in log.topics}
    reading = read_back(path)

    assert types == {"/x": ("a/B", 2), "/x#2": ("c/D", 1), "/x#3": ("a/B", 1)}
    assert [payload for *_, payload in reading.messages["/x"]] == [b"1", b"3"]
    assert any("/x#2" in notice for notice in reading.ledger.notices)


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


@pytest.mark.parametrize("last", [message(2, 3, b"end"), record(0x80, b"private")])
def test_record_that_extends_into_the_next_chunk_drops_its_own_chunk_only(
    tmp_path: Path, last: bytes
) -> None:
    # Chunks are parsed together; the next one begins with a record that no index names.
    between = record(0x80, b"private of the next chunk")
    longer = (int.from_bytes(last[1:9], "little") + len(between)).to_bytes(8, "little")
    chunks = [
        ChunkOf([message(1, 1, b"first")]),
        ChunkOf([message(1, 2, b"second"), last[:1] + longer + last[9:]]),
        ChunkOf([between, message(1, 4, b"fourth"), message(2, 5, b"fifth")]),
    ]
    reading = read_back(stored(tmp_path / "x.mcap", McapFile([*DEFINITIONS, *chunks])))

    assert reading.messages == {
        "/a": [message_read(1, b"first"), message_read(4, b"fourth")],
        "/b": [message_read(5, b"fifth")],
    }
    assert not reading.ledger.is_whole
    assert reading.ledger.topic("/a").dropped == {"damaged chunk": 1}


def test_consecutive_chunks_are_parsed_together(tmp_path: Path) -> None:
    chunks = [
        ChunkOf([message(2, 10 * k, b"b%d" % k), message(1, 10 * k + 1, b"a%d" % k)])
        for k in range(5)
    ]
    path = stored(tmp_path / "x.mcap", McapFile([*DEFINITIONS, *chunks]))

    with McapLog(path, Limits()) as log:
        blocks = list(log.read(Ledger(str(path))))

    assert [(block.topic, len(block)) for block in blocks] == [("/b", 5), ("/a", 5)]
    assert read_back(path).messages["/a"][3] == message_read(31, b"a3")
