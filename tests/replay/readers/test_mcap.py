"""MCAP files of other writers: awkward, by the conformance suite, and random."""

import struct
from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import NonSeekingReader
from mcap.writer import CompressionType, IndexType, Writer

from crosscue.replay.ledger import Ledger
from crosscue.replay.limits import Limits
from crosscue.replay.readers.mcap.reader import McapLog
from support.mcap_conformance import Conformance, suite
from support.mcap_files import (
    MAGIC,
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


# The only notice about a valid file, and only about one without a summary.
ALLOWED = "it has no usable summary; topics were found by reading"


@pytest.fixture(scope="module")
def files() -> list[Conformance]:
    return list(suite())


def _summary_at(coded: bytes) -> int:
    footer_at = len(coded) - 8 - 29
    return int(struct.unpack_from("<Q", coded, footer_at + 9)[0]) or footer_at


def without_summary(coded: bytes) -> bytes:
    """Return the file up to its data end record, with an empty summary."""
    empty = record(2, struct.pack("<QQI", 0, 0, 0))
    return coded[: _summary_at(coded)] + empty + MAGIC


def cut_off(coded: bytes) -> bytes:
    """Return the file up to its data end record."""
    return coded[: _summary_at(coded)]


def _fault(file: Conformance, path: Path, is_cut: bool) -> str:
    """Return what was read wrong, or an empty string."""
    reading = read_back(path)
    types = {topic: file.types.get(topic) for topic in reading.names}
    losses = [(one.reason, one.count) for one in reading.ledger.details]
    notices = [one for one in reading.ledger.notices if one != ALLOWED]
    if reading.messages != file.messages:
        return f"{reading.names}: {reading.count()} messages"
    if types != file.types:
        return f"topics {types}"
    if losses != ([("the file does not end as it should", None)] if is_cut else []):
        return f"losses {losses}"
    return "" if not notices and reading.adds_up() else f"notices {notices}"


FORMS: dict[str, Callable[[bytes], bytes]] = {
    "whole": bytes,
    "without summary": without_summary,
    "cut off": cut_off,
}


@pytest.mark.parametrize("form", FORMS)
def test_every_file_yields_exactly_its_topics_and_messages(
    files: list[Conformance], form: str, tmp_path: Path
) -> None:
    change = FORMS[form]
    path = tmp_path / "file.mcap"
    faults = {}
    for file in files:
        path.write_bytes(change(file.coded))
        fault = _fault(file, path, is_cut=form == "cut off")
        if fault:
            faults[file.name] = fault

    assert faults == {}, f"{len(faults)} of {len(files)}"


MESSAGES = st.lists(
    st.tuples(
        st.integers(0, 4),
        st.integers(0, 2**63 - 1) | st.integers(0, 50),
        st.integers(0, 2**63 - 1),
        st.binary(max_size=120),
    ),
    max_size=60,
)


@given(
    messages=MESSAGES,
    compression=st.sampled_from(list(CompressionType)),
    index=st.sampled_from([IndexType.NONE, IndexType.CHUNK, IndexType.MESSAGE, IndexType.ALL]),
    chunk_size=st.sampled_from([1, 200, 2_000, 1 << 20]),
    use_chunking=st.booleans(),
    repeat=st.booleans(),
    statistics=st.booleans(),
    data_crc=st.booleans(),
)
@settings(max_examples=60)
def test_messages_match_mcap_package(
    messages: list[tuple[int, int, int, bytes]],
    compression: CompressionType,
    index: IndexType,
    chunk_size: int,
    use_chunking: bool,
    repeat: bool,
    statistics: bool,
    data_crc: bool,
) -> None:
    stream = BytesIO()
    writer = Writer(
        stream,
        chunk_size,
        compression,
        index,
        repeat,
        repeat,
        use_chunking,
        statistics,
        enable_data_crcs=data_crc,
    )
    writer.start()
    schemas = [writer.register_schema(name, "ros2msg", b"") for name in ("a/B", "c/D")]
    channels = [writer.register_channel(f"/t{i}", "cdr", (0, *schemas)[i % 3]) for i in range(5)]
    for sequence, (k, log, publish, payload) in enumerate(messages):
        writer.add_message(channels[k], log, payload, publish, sequence)
    writer.finish()  # type: ignore[no-untyped-call]

    theirs: dict[str, list[Message]] = {}
    stream.seek(0)
    for _, sent_on, found in NonSeekingReader(stream).iter_messages(log_time_order=False):
        one = (found.log_time, found.publish_time, found.data)
        theirs.setdefault(sent_on.topic, []).append(one)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "log.mcap"
        path.write_bytes(stream.getvalue())
        ours = read_back(path)

    assert ours.messages == theirs
    assert ours.ledger.is_whole
    assert ours.adds_up()


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
