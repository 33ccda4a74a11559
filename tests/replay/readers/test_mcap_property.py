"""Files of random contents: the reader and the mcap package read the same messages."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory

from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import NonSeekingReader
from mcap.writer import CompressionType, IndexType, Writer

from support.mcap_files import Message, read_back

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
    for _, channel, found in NonSeekingReader(stream).iter_messages(log_time_order=False):
        one = (found.log_time, found.publish_time, found.data)
        theirs.setdefault(channel.topic, []).append(one)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "log.mcap"
        path.write_bytes(stream.getvalue())
        ours = read_back(path)

    assert ours.messages == theirs
    assert ours.ledger.is_whole
    assert ours.adds_up()
