"""The MCAP reader reads exactly the messages of valid files of any structure."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path

import pytest
from mcap.reader import NonSeekingReader
from mcap.writer import CompressionType, IndexType, Writer

from support.data import shared
from support.mcap_files import Message, read_back

PAYLOADS: Sequence[tuple[int, int, bytes]] = [
    (i % 3, 1_000 + 10 * i, bytes([i % 251]) * (i * 37 % 90)) for i in range(600)
]


def write(path: Path, compression: CompressionType, **options: object) -> None:
    writer = Writer(str(path), chunk_size=4_000, compression=compression, **options)  # type: ignore[arg-type]
    writer.start()
    schema_id = writer.register_schema("a/B", "ros2msg", b"int32 x")
    channels = [writer.register_channel(f"/t{i}", "cdr", schema_id) for i in range(3)]
    for sequence, (k, log, payload) in enumerate(PAYLOADS):
        writer.add_message(channels[k], log, payload, log - 7, sequence)
    writer.finish()  # type: ignore[no-untyped-call]


def read_with_mcap_package(path: Path) -> dict[str, list[Message]]:
    found: dict[str, list[Message]] = {}
    with path.open("rb") as stream:
        for _, channel, message in NonSeekingReader(stream).iter_messages(log_time_order=False):
            found.setdefault(channel.topic, []).append(
                (message.log_time, message.publish_time, message.data)
            )
    return found


STRUCTURES = [
    {
        "use_chunking": chunked,
        "index_types": index,
        "repeat_channels": repeat,
        "repeat_schemas": repeat,
        "use_statistics": statistics,
        "enable_data_crcs": crc,
    }
    for chunked, index, repeat, statistics, crc in itertools.product(
        (True, False),
        (IndexType.NONE, IndexType.CHUNK, IndexType.MESSAGE, IndexType.ALL),
        (True, False),
        (True, False),
        (True, False),
    )
]


@pytest.mark.slow
@pytest.mark.parametrize("compression", list(CompressionType), ids=lambda c: c.name.lower())
def test_all_file_structures_yield_same_messages_as_mcap_package(
    tmp_path: Path, compression: CompressionType
) -> None:
    path = tmp_path / "log.mcap"
    for shape in STRUCTURES:
        write(path, compression, **shape)
        reading = read_back(path)

        assert reading.messages == read_with_mcap_package(path), shape
        assert reading.ledger.is_whole, shape
        assert reading.adds_up(), shape
        assert reading.names == ("/t0", "/t1", "/t2"), shape


@pytest.mark.slow
def test_real_recordings_match_mcap_package() -> None:
    recordings = sorted(shared("bags").rglob("*.mcap"))
    assert recordings
    for path in recordings:
        reading = read_back(path)

        assert reading.messages == read_with_mcap_package(path)
        assert reading.ledger.is_whole
        assert reading.adds_up()
