"""MCAP files of other writers: awkward, by the conformance suite, and random."""

import struct
from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import Any

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
    Reading,
    attachment,
    channel,
    message,
    read_coded,
    record,
    schema,
)

DEFINITIONS = [schema(1), channel(1, 1, "/a"), channel(2, 1, "/b")]


@pytest.mark.parametrize("is_chunked", [True, False])
@pytest.mark.parametrize("summary", [True, False])
def test_message_uses_latest_preceding_channel_definition(
    tmp_path: Path, is_chunked: bool, summary: bool
) -> None:
    renamed, named_again = channel(1, 1, "/other"), channel(1, 1, "/a")
    records = [
        *(*DEFINITIONS, message(1, 1, b"p")),
        *(renamed, message(1, 2, b"q"), message(2, 3, b"r")),
        *(named_again, message(1, 4, b"s")),
    ]
    parts = [ChunkOf(records)] if is_chunked else records

    reading = read_coded(tmp_path, McapFile(parts, summary=summary))

    assert reading.messages == {
        "/a": [(1, 1, b"p"), (4, 4, b"s")],
        "/other": [(2, 2, b"q")],
        "/b": [(3, 3, b"r")],
    }
    assert reading.ledger.is_whole


def test_one_name_with_two_types_becomes_separate_topics_with_notice(tmp_path: Path) -> None:
    channels = [channel(1, 1, "/x"), channel(2, 2, "/x"), channel(3, 1, "/x")]
    messages = (message(number, number, b"%d" % number) for number in (1, 2, 3, 4))
    records = [schema(1, "a/B"), schema(2, "c/D"), *channels, channel(4, 1, "/x", "json")]

    reading = read_coded(tmp_path, McapFile([ChunkOf([*records, *messages])]))

    with McapLog(tmp_path / "log.mcap", Limits()) as log:
        types = {topic.name: (topic.type_name, topic.declared) for topic in log.topics}
    assert types == {"/x": ("a/B", 2), "/x#2": ("c/D", 1), "/x#3": ("a/B", 1)}
    assert [payload for *_, payload in reading.messages["/x"]] == [b"1", b"3"]
    assert any("/x#2" in notice for notice in reading.ledger.notices)


def test_chunks_are_read_together_though_the_first_one_repeats_definitions(tmp_path: Path) -> None:
    """Writers put schemas and channels into a chunk; each block of its own costs time."""
    chunks = [ChunkOf([message(1, at, b"x"), message(2, at, b"y")]) for at in (2, 3)]
    first = ChunkOf([*DEFINITIONS, message(1, 1, b"x"), message(2, 1, b"y")])
    path = tmp_path / "x.mcap"
    path.write_bytes(McapFile([first, *chunks]).coded())

    with McapLog(path, Limits()) as log:
        sizes = [(block.topic, len(block)) for block in log.read(Ledger(str(path)))]

    assert sizes == [("/a", 3), ("/b", 3)]


@pytest.mark.parametrize("pairs", [1, 10])
@pytest.mark.parametrize("is_chunked", [True, False])
def test_unknown_record_kinds_are_ignored_with_notice(
    tmp_path: Path, is_chunked: bool, pairs: int
) -> None:
    odd = [record(0x99, b"a private record of its application"), record(0x42, bytes(50))] * pairs
    records = [*odd, *DEFINITIONS, *odd, message(1, 1, b"x"), *odd, message(1, 2, b"y")]
    parts = [ChunkOf(records)] if is_chunked else records

    file = McapFile([*odd, *parts, *odd, message(2, 3, b"z"), *odd], summary=is_chunked)
    reading = read_coded(tmp_path, file)

    assert reading.messages == {"/a": [(1, 1, b"x"), (2, 2, b"y")], "/b": [(3, 3, b"z")]}
    assert any("unknown kinds" in notice for notice in reading.ledger.notices)
    assert reading.ledger.is_whole


def test_attachment_checksums_are_verified(tmp_path: Path) -> None:
    good, bad = attachment("a.txt", b"text"), attachment("b.txt", b"text", crc=7)
    file = McapFile([good, ChunkOf([*DEFINITIONS, message(1, 1)]), bad])

    reading = read_coded(tmp_path, file)

    assert "1 of 2 attachments" in reading.ledger.integrity
    assert any("attachments" in notice for notice in reading.ledger.notices)
    assert reading.count() == 1


def test_chunk_without_checksum_among_others_is_reported(tmp_path: Path) -> None:
    chunks = [ChunkOf([*DEFINITIONS, message(1, 1)]), ChunkOf([message(1, 2)], crc=0)]

    reading = read_coded(tmp_path, McapFile(chunks))

    assert reading.count() == 2
    assert any("1 of 2 chunks have no checksum" in notice for notice in reading.ledger.notices)


# The only notice about a valid file, and only about one without a summary.
ALLOWED = "it has no usable summary; topics were found by reading"


@pytest.fixture(scope="module")
def files() -> list[Conformance]:
    return list(suite())


def cut_off(coded: bytes) -> bytes:
    """Return the file up to its data end record."""
    footer_at = len(coded) - 8 - 29
    (summary_at,) = struct.unpack_from("<Q", coded, footer_at + 9)
    return coded[: summary_at or footer_at]


def without_summary(coded: bytes) -> bytes:
    return cut_off(coded) + record(2, bytes(20)) + MAGIC


def _fault(file: Conformance, reading: Reading, is_cut: bool) -> str:
    """Return what was read wrong, or an empty string."""
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


@pytest.mark.parametrize("form", [bytes, without_summary, cut_off])
def test_every_file_yields_exactly_its_topics_and_messages(
    files: list[Conformance], form: Callable[[bytes], bytes], tmp_path: Path
) -> None:
    faults = {}
    for file in files:
        reading = read_coded(tmp_path, form(file.coded))
        fault = _fault(file, reading, is_cut=form is cut_off)
        if fault:
            faults[file.name] = fault

    assert faults == {}, f"{len(faults)} of {len(files)}"


TIMES_NS = st.integers(0, 2**63 - 1)
MESSAGES = st.lists(
    st.tuples(st.integers(0, 4), TIMES_NS | st.integers(0, 50), TIMES_NS, st.binary(max_size=120)),
    max_size=60,
)


OPTIONS = st.fixed_dictionaries(
    {
        "chunk_size": st.sampled_from([1, 200, 2_000, 1 << 20]),
        "compression": st.sampled_from(list(CompressionType)),
        "index_types": st.sampled_from(
            [IndexType.NONE, IndexType.CHUNK, IndexType.MESSAGE, IndexType.ALL]
        ),
        **dict.fromkeys(("repeat_channels", "use_chunking", "use_statistics"), st.booleans()),
        "enable_data_crcs": st.booleans(),
    }
)


@given(messages=MESSAGES, options=OPTIONS)
@settings(max_examples=60)
def test_messages_match_mcap_package(
    tmp_path: Path, messages: list[tuple[int, int, int, bytes]], options: dict[str, Any]
) -> None:
    stream = BytesIO()
    writer = Writer(stream, repeat_schemas=options["repeat_channels"], **options)
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
    ours = read_coded(tmp_path, stream.getvalue())

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
    reading = read_coded(tmp_path, McapFile([*DEFINITIONS, *chunks]))

    assert reading.messages == {
        "/a": [(1, 1, b"first"), (4, 4, b"fourth")],
        "/b": [(5, 5, b"fifth")],
    }
    assert not reading.ledger.is_whole
    assert reading.ledger.topic("/a").dropped == {"damaged chunk": 1}
