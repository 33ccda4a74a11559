"""Converted messages, salvaged logs and the memory of both."""

import json
import re
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from crosscue.eval import cli
from crosscue.eval.cli import run as crosscue
from crosscue.replay.columns import Block, CanFrames, Images, Messages, Rows, Table, Topic
from crosscue.replay.decode import decoder_for
from crosscue.replay.decode.refuse import MISFIT
from crosscue.replay.encode.outgoing import TIME_MISFIT, Outgoing
from crosscue.replay.encode.tables import OwnTypes
from crosscue.replay.ledger import Ledger
from crosscue.replay.write.convert import encoder_for
from support.data import shared
from support.mcap_damage import sound_parts
from support.mcap_files import McapFile, channel, message, read_back, schema
from support.measured import measured
from support.ros_messages import (
    block_of,
    messages_of,
    random_definition,
    random_message,
    ros1_store,
    ros1_topic,
    ros2_store,
)
from support.rosbag_files import read_rows, rows_of, write_bag
from support.trees import written

QUICK = settings(max_examples=40, deadline=None)


def encoded(topic: Topic, block: Block, ledger: Ledger | None = None) -> list[Outgoing]:
    encoder = encoder_for(topic, OwnTypes())
    assert encoder is not None
    return encoder(block, ledger or Ledger("made"))


def columns_block(topic: str, rows: Rows) -> Block:
    log_ns = np.arange(len(rows), dtype=np.int64) * 1_000_003 + 5_000_000_000
    return Block(topic, log_ns, rows, header_ns=log_ns - 7)


def round_trip(topic: str, rows: Rows, ledger: Ledger | None = None) -> list[Block]:
    block = columns_block(topic, rows)
    decoded: list[Block] = []
    for outgoing in encoded(Topic(topic, "crosscue/Any", "columns"), block, ledger):
        stored = Topic(
            outgoing.block.topic, outgoing.type.name, "cdr", outgoing.type.schema, "ros2msg"
        )
        decoder = decoder_for(stored)
        assert decoder is not None
        reported = Ledger("decoded")
        decoded.append(decoder(outgoing.block, reported))
        assert not reported.details
        _read_with_rosbags(outgoing)
    return decoded


def _read_with_rosbags(outgoing: Outgoing) -> list[Any]:
    """Return all messages, read by rosbags with the stored definition."""
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(outgoing.type.schema.decode(), outgoing.type.name))
    rows = outgoing.block.rows
    assert isinstance(rows, Messages)
    return [store.deserialize_cdr(rows.payload(i), outgoing.type.name) for i in range(len(rows))]


@pytest.mark.slow
@given(seed=st.integers(0, 2**32 - 1))
@QUICK
def test_ros1_messages_of_random_types_convert_like_rosbags(seed: int) -> None:
    rng = np.random.default_rng(seed)
    name = "made_msgs/msg/Root"
    text = random_definition(rng, "made_msgs/Root")
    store = get_typestore(Stores.ROS1_NOETIC)
    store.register(get_types_from_msg(text, name))
    payloads = [
        bytes(store.serialize_ros1(random_message(rng, store, name), name)) for _ in range(5)
    ]

    out = encoded(ros1_topic("/t", name, text), block_of("/t", payloads))

    rows = out[0].block.rows
    assert isinstance(rows, Messages)
    expected = [bytes(store.ros1_to_cdr(each, name)) for each in payloads]
    assert [bytes(rows.payload(i)) for i in range(len(rows))] == expected
    _read_with_rosbags(out[0])


@given(seed=st.integers(0, 2**32 - 1))
@QUICK
def test_only_damaged_ros1_messages_are_dropped(seed: int) -> None:
    rng = np.random.default_rng(seed)
    store, name = ros1_store(), "diagnostic_msgs/msg/DiagnosticArray"
    good = [bytes(store.serialize_ros1(random_message(rng, store, name), name)) for _ in range(8)]
    bad = [each[: int(rng.integers(0, len(each)))] for each in good]
    payloads = [b if rng.random() < 0.4 else g for g, b in zip(good, bad, strict=True)]
    kept = [p for p, g in zip(payloads, good, strict=True) if p is g]
    ledger = Ledger("made")

    out = encoded(ros1_topic("/d", name), block_of("/d", payloads), ledger)

    converted = []
    if out:
        rows = out[0].block.rows
        assert isinstance(rows, Messages)
        converted = [bytes(rows.payload(i)) for i in range(len(rows))]
    assert converted == [bytes(ros2_store().ros1_to_cdr(each, name)) for each in kept]
    assert ledger.topic("/d").dropped.total() == len(payloads) - len(kept)
    assert set(ledger.topic("/d").dropped) <= {MISFIT}
    assert not ledger.topic("/d").skipped


def can_frames(n: int, width: int, seed: int = 0) -> CanFrames:
    rng = np.random.default_rng(seed)
    extended = rng.random(n) < 0.5
    kind = rng.choice([0, 0, 0, 1, 2], n).astype(np.uint8)
    fd = rng.random(n) < 0.5 if width == 64 else np.zeros(n, np.bool_)
    max_count = np.where(fd, 64, 8)
    length = np.where(kind == 1, 0, rng.integers(0, max_count + 1)).astype(np.uint8)
    data = rng.integers(0, 256, (n, width), dtype=np.uint8)
    data[np.arange(width) >= length[:, None]] = 0
    identifier = np.where(extended, rng.integers(0, 1 << 29, n), rng.integers(0, 1 << 11, n))
    return CanFrames(identifier.astype(np.uint32), extended, kind, length, data, fd)


def test_can_frames_round_trip() -> None:
    frames = can_frames(500, 8)

    (decoded,) = round_trip("can0", frames)

    assert isinstance(decoded.rows, CanFrames)
    for name in ("arbitration_id", "is_extended", "kind", "length", "data", "is_fd"):
        np.testing.assert_array_equal(getattr(decoded.rows, name), getattr(frames, name))
    assert decoded.header_ns is not None
    np.testing.assert_array_equal(decoded.header_ns, decoded.log_ns - 7)


@pytest.mark.slow
def test_can_fd_frames_get_separate_topic_and_notice() -> None:
    frames, ledger = can_frames(300, 64), Ledger("made")

    decoded = round_trip("can0", frames, ledger)

    classic, fd = decoded[0], [each for each in decoded if each.topic == "can0/fd"]
    assert isinstance(classic.rows, CanFrames)
    np.testing.assert_array_equal(classic.rows.arbitration_id, frames.arbitration_id[~frames.is_fd])
    assert sum(map(len, decoded)) == len(frames)
    log_ns = columns_block("can0", frames).log_ns
    for block in fd:
        assert isinstance(block.rows, CanFrames)
        index = np.searchsorted(log_ns, block.log_ns)
        np.testing.assert_array_equal(block.rows.data, frames.data[index])
        np.testing.assert_array_equal(block.rows.length, frames.length[index])
        assert block.rows.is_fd.all()
    assert any("CAN FD" in notice for notice in ledger.notices)


def images(codings: tuple[str, ...], raw: bool = False) -> Images:
    rng = np.random.default_rng(1)
    magic = {"jpeg": b"\xff\xd8", "png": b"\x89PNG\r\n\x1a\n"}
    payloads = [
        magic.get(coding, b"") + rng.bytes(24 if raw else int(rng.integers(1, 900)))
        for coding in codings
    ]
    n = len(codings)
    sizes = {
        "width_px": np.full(n, 4, np.int32),
        "height_px": np.full(n, 2, np.int32),
        "step_bytes": np.full(n, 12, np.int32),
        "pixel_format": ("rgb8",) * n,
    }
    return Images(messages_of(payloads, 5), codings, **(sizes if raw else {}))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("pictures", "type_name"),
    [
        (images(("jpeg", "png", "jpeg")), "sensor_msgs/msg/CompressedImage"),
        (images(("h264", "h264", "h265")), "foxglove_msgs/msg/CompressedVideo"),
        (images(("raw", "raw"), raw=True), "sensor_msgs/msg/Image"),
    ],
    ids=["compressed", "video", "raw"],
)
def test_images_round_trip_byte_for_byte(pictures: Images, type_name: str) -> None:
    topic = Topic("/front", "crosscue/Images", "columns")
    (out,) = encoded(topic, columns_block("/front", pictures))

    (decoded,) = round_trip("/front", pictures)

    assert out.type.name == type_name
    assert isinstance(decoded.rows, Images)
    assert decoded.rows.coding == pictures.coding
    for i in range(len(pictures)):
        assert decoded.rows.bytes_.payload(i) == pictures.bytes_.payload(i)
    if type_name == "sensor_msgs/msg/Image":
        assert decoded.rows.pixel_format == pictures.pixel_format


def test_other_tables_round_trip_in_generated_type() -> None:
    table = Table(
        {
            "speed_mps": np.array([1.5, np.nan]),
            "count": np.array([1, 2**40]),
            "Wheel FL!": np.array([1, 2], np.float32),
            "wheel_fl": np.array([3, 4], np.uint8),
            "matrix": np.arange(6.0).reshape(2, 3),
            "is_on": np.array([True, False]),
            "0x1F": np.array([-1, 1], np.int16),
            "words": np.array(["a", "b"]),
        }
    )
    ledger = Ledger("made")

    (decoded,) = round_trip("/car/wheel speeds", table, ledger)

    assert isinstance(decoded.rows, Table)
    names = "speed_mps count wheel_fl wheel_fl2 matrix is_on c_0x1f"
    assert list(decoded.rows.columns) == names.split()
    for ours, theirs in zip(list(table.columns)[:-1], decoded.rows.columns, strict=True):
        np.testing.assert_array_equal(decoded.rows[theirs], table[ours])
    assert "words" in ledger.notices[0]


def test_stamps_out_of_ros2_range_are_skipped() -> None:
    out_of_range = np.array([0, 2**31 * 1_000_000_000, -(2**31) * 1_000_000_000 - 1], np.int64)
    block = Block(
        "/t", np.arange(3, dtype=np.int64), Table({"a": np.zeros(3)}), header_ns=out_of_range
    )
    ledger = Ledger("made")

    (out,) = encoded(Topic("/t", "crosscue/Table", "columns"), block, ledger)

    assert len(out.block) == 1
    assert ledger.topic("/t").skipped == {TIME_MISFIT: 2}


def cdr(i: int) -> bytes:
    """Return a CDR message of the definition ``int32 x``."""
    return b"\x00\x01\x00\x00" + struct.pack("<i", i)


@pytest.fixture
def damaged(tmp_path: Path) -> tuple[Path, int]:
    """Return an unchunked log with one of 600 records damaged, and that record's position."""
    records = [schema(1), channel(1, 1, "/a")]
    records += [message(1, 10**18 + i * 10**6, cdr(i)) for i in range(600)]
    coded = bytearray(McapFile(records, data_crc=True).coded())
    at = coded.index(records[300])
    coded[at : at + 30] = bytes(30)
    path = written(tmp_path / "damaged.mcap", coded)
    return path, at


@pytest.mark.parametrize("flags", [[], ["--salvage"]])
def test_convert_writes_readable_messages_and_exits_with_3(
    damaged: tuple[Path, int], tmp_path: Path, capsys: pytest.CaptureFixture[str], flags: list[str]
) -> None:
    path, at = damaged

    status = crosscue(["convert", str(path), "-o", str(tmp_path / "out.mcap"), *flags])

    printed = capsys.readouterr()
    assert status == 3
    spans = re.findall(r"bytes (\d+) to (\d+)", " ".join(printed.err.split()))
    assert any(at - 39 <= int(a) <= at and int(b) == at + 39 for a, b in spans)
    assert ("--salvage" in printed.err) == (not flags)
    read = read_back(path)
    assert read_back(tmp_path / "out.mcap").messages == read.messages
    assert read.count() == 598


def test_damaged_rosbag1_is_salvaged(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write_bag(tmp_path / "a.bag", rows_of(600), "bz2")
    content = bytearray(path.read_bytes())
    middle = len(content) // 2
    content[middle : middle + 40] = bytes(40)
    path.write_bytes(content)
    readable = len(read_rows(path).rows)
    out = str(tmp_path / "out.mcap")

    assert crosscue(["convert", str(path), "-o", out, "--salvage", "--json"]) == 3

    topics = json.loads(capsys.readouterr().out)["topics"].values()
    assert 0 < readable < 600
    # The random payloads fit no schema, so each message read is found and then dropped.
    dropped = (one["dropped"].get("does not fit its schema", 0) for one in topics)
    assert sum(one["found"] for one in topics) + sum(dropped) == readable


@pytest.mark.parametrize("command", ["info", "convert"])
def test_chunk_over_max_chunk_is_refused_with_limit(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], command: str
) -> None:
    path = written(tmp_path / "log.mcap", McapFile(sound_parts("zstd", is_chunked=True)).coded())
    out = [] if command == "info" else ["-o", str(tmp_path / "o.mcap")]

    status = crosscue([command, str(path), "--max-chunk", "0.001", *out])

    printed = capsys.readouterr()
    text = " ".join((printed.out + printed.err).split())
    # A log with no chunk below the limit has nothing to convert.
    assert status == (3 if command == "info" else 4)
    assert "the limit is 1048" in text


RECORDS = 400_000


@pytest.mark.slow
def test_unchunked_log_is_converted_within_memory_limit(tmp_path: Path) -> None:
    vector = schema(1, "geometry_msgs/msg/Vector3", body=b"float64 x\nfloat64 y\nfloat64 z")
    payload = b"\0\1\0\0" + bytes(24)
    messages = (message(1, 10**18 + 1000 * i, payload) for i in range(RECORDS))
    file = McapFile([vector, channel(1, 1, "/v"), *messages], summary=False)
    log = written(tmp_path / "log.mcap", file.coded())

    out = str(tmp_path / "out.mcap")
    status, output, peak_mb = measured(["convert", str(log), "-o", out, "--json"])

    assert status == 0, output
    assert str(RECORDS) in output
    assert peak_mb < 200


def _tables(log: Path, run: Path) -> dict[str, object]:
    assert cli.run(["replay", str(log), "-o", str(run)]) in (0, 3)
    names = ("pose", "measurements")
    return {name: pq.read_table(run / f"{name}.parquet").to_pydict() for name in names}


@pytest.mark.slow
def test_converted_real_segment_replays_like_original(tmp_path: Path) -> None:
    (log,) = shared("comma2k19/Example_1").glob("*/40")

    copy = tmp_path / "log.mcap"
    assert cli.run(["convert", str(log), "-o", str(copy)]) in (0, 3)

    assert _tables(copy, tmp_path / "b") == _tables(log, tmp_path / "a")
