"""Protobuf, JSON and packets of a video: the same columns as ROS types; only damage is dropped."""

import json
from base64 import b64encode
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import crosscue
from crosscue.replay.columns import Block, Images, Table, Topic
from crosscue.replay.decode import decoder_for
from crosscue.replay.decode.packets import NO_PICTURE, NOT_DECODED
from crosscue.replay.decode.refuse import MISFIT
from crosscue.replay.errors import SchemaError
from crosscue.replay.ledger import Ledger
from crosscue.replay.logs.opening import open_log
from crosscue.replay.signals.extractor import SampleExtractor
from crosscue.replay.signals.kinds import SignalPlan, SignalSource
from crosscue.replay.vehicle.vehicle import Vehicle
from support.protobuf_types import F, proto_topic, schema_of
from support.ros_messages import block_of, decoder_of
from support.videos import SIZE_PX, number_of, video

QUICK = settings(max_examples=60, deadline=None)
STAMP = ("timestamp", 1, F.TYPE_MESSAGE, ".google.protobuf.Timestamp")
IMAGE = (
    STAMP,
    ("frame_id", 4, F.TYPE_STRING),
    ("data", 2, F.TYPE_BYTES),
    ("format", 3, F.TYPE_STRING),
)
RAW = (
    STAMP,
    ("frame_id", 7, F.TYPE_STRING),
    ("width", 2, F.TYPE_FIXED32),
    ("height", 3, F.TYPE_FIXED32),
    ("encoding", 4, F.TYPE_STRING),
    ("step", 5, F.TYPE_FIXED32),
    ("data", 6, F.TYPE_BYTES),
)
FIX = (
    ("timestamp", 6, F.TYPE_MESSAGE, ".google.protobuf.Timestamp"),
    ("latitude", 1, F.TYPE_DOUBLE),
    ("longitude", 2, F.TYPE_DOUBLE),
    ("altitude", 3, F.TYPE_DOUBLE),
    ("position_covariance", 4, F.TYPE_DOUBLE, "", True),
    ("position_covariance_type", 5, F.TYPE_INT32),
)


def stamped(cls: Any, seconds: int, nanos: int) -> Any:
    """Return a message of the class with its timestamp set."""
    message = cls()
    message.timestamp.seconds, message.timestamp.nanos = seconds, nanos
    return message


def test_raw_images_keep_size_and_pixel_format() -> None:
    topic, cls = proto_topic("RawImage", RAW)
    message = stamped(cls, 1, 0)
    message.width, message.height, message.step, message.encoding = 4, 2, 12, "rgb8"
    message.data = bytes(24)
    short = cls()
    short.CopyFrom(message)
    short.data = bytes(23)
    ledger = Ledger("made")

    images = decoder_of(topic)(
        block_of("/t", [message.SerializeToString(), short.SerializeToString()]), ledger
    ).rows

    assert isinstance(images, Images)
    assert len(images) == 1
    assert images.pixel_format == ("rgb8",)
    assert images.step_bytes is not None
    assert images.step_bytes.tolist() == [12]
    assert ledger.topic("/t").dropped == {"picture has fewer bytes than its size needs": 1}


@pytest.mark.parametrize(
    ("schema", "complaint"),
    [
        (b"\xff\xff\xff", "cannot be used"),
        (b"", None),
        (schema_of("Other", IMAGE), "cannot be used"),
        (schema_of("CompressedImage", (STAMP, ("data", 2, F.TYPE_STRING))), "lacks the field data"),
        (schema_of("CompressedImage", IMAGE)[:-300], "cannot be used"),
        (bytes(2 << 20), "over the limit"),
    ],
)
def test_invalid_descriptor_is_refused_in_one_line(schema: bytes, complaint: str | None) -> None:
    topic = Topic("/cam", "foxglove.CompressedImage", "protobuf", schema, "protobuf")
    if complaint is None:
        assert decoder_for(topic) is None
        return
    with pytest.raises(SchemaError, match=complaint) as caught:
        decoder_for(topic)
    assert "\n" not in str(caught.value)
    assert "/cam" in str(caught.value)


@given(raw=st.binary(max_size=80), name=st.sampled_from(["CompressedImage", "LocationFix"]))
@QUICK
def test_arbitrary_bytes_are_decoded_or_dropped(raw: bytes, name: str) -> None:
    topic, _ = proto_topic(name, IMAGE if name == "CompressedImage" else FIX)
    ledger = Ledger("made")
    ledger.find("/t", 1)

    block = decoder_of(topic)(block_of("/t", [raw]), ledger)

    assert len(block) == ledger.topic("/t").used
    if isinstance(block.rows, Images):
        for i in range(len(block)):
            assert block.rows.bytes_.payload(i).tobytes() in raw


def json_block(*values: Any) -> Block:
    return block_of("/t", [v if isinstance(v, bytes) else json.dumps(v).encode() for v in values])


def test_json_images_and_fixes_are_decoded() -> None:
    when = {"sec": 5, "nsec": 7}
    picture = b"\xff\xd8" + bytes(40)
    image = {"timestamp": when, "data": b64encode(picture).decode(), "format": "jpeg"}
    fix = {
        "timestamp": when,
        "latitude": 1,
        "longitude": 2.5,
        "altitude": 3,
        "position_covariance": list(range(9)),
        "position_covariance_type": 2,
    }
    ledger = Ledger("made")
    images = decoder_of(Topic("/t", "foxglove.CompressedImage", "json"))(
        json_block(image, image | {"data": "not base64!"}), ledger
    )
    fixes = decoder_of(Topic("/t", "foxglove.LocationFix", "json"))(
        json_block(fix, fix | {"latitude": "north"}, {"timestamp": when}), ledger
    )

    assert isinstance(images.rows, Images)
    assert images.rows.bytes_.payload(0).tobytes() == picture
    assert images.header_ns is not None
    assert images.header_ns.tolist() == [5_000_000_007]
    assert isinstance(fixes.rows, Table)
    assert fixes.rows["latitude_deg"].tolist() == [1]
    assert fixes.rows["covariance_m2"].shape == (1, 9)
    assert ledger.topic("/t").dropped == {MISFIT: 3}


@pytest.mark.parametrize(
    "raw",
    [
        b'{"a": NaN}',
        b'{"a": Infinity}',
        b'{"a": 1, "a": 2}',
        b"[1]",
        b"\xff{}",
        b'{"a": ' + b"[" * 100_000,
        b'{"a":' * 30 + b"1" + b"}" * 30,
        b'{"timestamp": {"sec": 1, "nsec": 1000000000}}',
        b'{"timestamp": {"sec": 99999999999999999999, "nsec": 0}}',
        b'{"a": ' + b"9" * 5000 + b"}",
    ],
)
def test_invalid_json_message_is_dropped_alone(raw: bytes) -> None:
    ledger = Ledger("made")

    block = decoder_of(Topic("/t", "made.Thing", "json"))(json_block({"a": 1}, raw), ledger)

    assert len(block) == 1
    assert ledger.topic("/t").dropped == {MISFIT: 1}


def test_json_schema_that_is_not_an_object_is_refused() -> None:
    with pytest.raises(SchemaError, match="not a JSON object"):
        decoder_for(Topic("/t", "made.Thing", "json", b"[1, 2", "jsonschema"))


def test_json_values_keep_dtype_and_missing_values_are_nan() -> None:
    rows: list[Mapping[str, Any]] = [
        {"n": 2**53 + 1, "b": True, "in": {"x": 1}},
        {"n": 2, "b": False, "in": {"x": 0.5, "y": 2}, "s": "text", "l": [1, 2]},
    ]
    table = decoder_of(Topic("/t", "made.Thing", "json"))(json_block(*rows), Ledger("x")).rows

    assert isinstance(table, Table)
    assert table["n"].tolist() == [2**53 + 1, 2]
    assert table["b"].dtype == np.bool_
    np.testing.assert_array_equal(table["in.y"], [np.nan, 2.0])
    np.testing.assert_array_equal(table["l.length"], [np.nan, 2.0])


def test_compressed_images_are_byte_ranges_of_payloads() -> None:
    topic, cls = proto_topic("CompressedImage", IMAGE)
    pictures = [b"\xff\xd8" + bytes(300), b"\x89PNG\r\n\x1a\n" + bytes(9)]
    payloads = []
    for i, picture in enumerate(pictures):
        message = stamped(cls, 5 + i, 7)
        message.data, message.format, message.frame_id = picture, "jpeg", "front"
        payloads.append(message.SerializeToString())
    ledger = Ledger("made")

    block = decoder_of(topic)(block_of("/t", [payloads[0], payloads[1], b""]), ledger)

    assert isinstance(block.rows, Images)
    assert block.rows.coding == ("jpeg", "png")
    assert [block.rows.bytes_.payload(i).tobytes() for i in range(2)] == pictures
    assert block.header_ns is not None
    assert block.header_ns.tolist() == [5_000_000_007, 6_000_000_007]
    assert ledger.topic("/t").skipped == {"empty picture": 1}


def test_unknown_protobuf_type_has_dotted_columns() -> None:
    fields = (
        STAMP,
        ("count", 2, F.TYPE_UINT64),
        ("gain", 3, F.TYPE_FLOAT),
        ("on", 4, F.TYPE_BOOL),
        ("list", 5, F.TYPE_INT32, "", True),
        ("again", 6, F.TYPE_MESSAGE, ".foxglove.Made"),
        ("name", 7, F.TYPE_STRING),
    )
    topic, cls = proto_topic("Made", fields)
    message = stamped(cls, 9, 1)
    message.count, message.gain, message.on = 2**64 - 1, 0.5, True
    message.list.extend([1, 2, 3])
    message.again.count = 5
    ledger = Ledger("made")

    block = decoder_of(topic)(block_of("/t", [message.SerializeToString()]), ledger)

    assert isinstance(block.rows, Table)
    assert {name: column.tolist() for name, column in block.rows.columns.items()} == {
        "count": [2**64 - 1],
        "gain": [0.5],
        "on": [True],
        "list.length": [3],
    }
    assert block.header_ns is not None
    assert block.header_ns.tolist() == [9_000_000_001]


STEP_NS = 50_000_000
CODECS = ["libx264", "libx265", "libsvtav1"]


def packets(path: Path) -> tuple[Topic, list[Block]]:
    with open_log(path) as log:
        return log.topics[0], list(log.read(Ledger("video")))


def numbers_shown(topic: Topic, blocks: list[Block]) -> tuple[dict[int, int], Ledger]:
    """Return the number shown in each picture, keyed by time, and the ledger of the extractor."""
    found: dict[int, int] = {}

    def read_numbers(block: Block) -> None:
        assert isinstance(block.rows, Images)
        for i, t_ns in enumerate(block.log_ns.tolist()):
            pixels = np.frombuffer(block.rows.bytes_.payload(i), np.uint8)
            found[t_ns] = number_of(pixels.reshape(SIZE_PX[1], SIZE_PX[0], 3))

    ledger = Ledger("video")
    planned = SignalPlan((SignalSource(0, topic, ()),), {})
    extractor = SampleExtractor(planned, Vehicle(version=1), 0, ledger, on_pictures=read_numbers)
    for block in blocks:
        for _ in extractor(block):
            pass
    for _ in extractor.finish():
        pass
    return found, ledger


@pytest.mark.parametrize("codec", CODECS)
def test_every_packet_is_decoded_to_picture_with_its_time(codec: str, tmp_path: Path) -> None:
    suffix = ".mkv" if codec == "libsvtav1" else ".mp4"
    topic, blocks = packets(video(tmp_path / f"front{suffix}", codec=codec))

    found, ledger = numbers_shown(topic, blocks)

    assert [found[t] for t in sorted(found)] == list(range(24))
    assert sorted(found) == [k * STEP_NS for k in range(24)]
    assert not any(account.skipped for account in ledger.accounts.values())


def test_stream_that_begins_within_a_group_loses_only_that_group(tmp_path: Path) -> None:
    topic, blocks = packets(video(tmp_path / "front.mp4", options={"g": "12", "bf": "0"}))
    (block,) = blocks

    found, ledger = numbers_shown(topic, [block.take(slice(5, None))])

    account = ledger.topic(topic.name)
    skipped = account.skipped + account.dropped
    assert sum(skipped.values()) + len(found) == 19
    assert set(skipped) <= {NO_PICTURE, NOT_DECODED}
    assert sorted(found)[-1] == 23 * STEP_NS
    assert all(found[12 * STEP_NS + k * STEP_NS] == 12 + k for k in range(12))


def test_pixels_of_a_video_are_handed_over_without_a_copy(tmp_path: Path) -> None:
    with crosscue.open(video(tmp_path / "v.mp4")) as log:
        shown = [frame for topic in log.topics.values() for frame in topic.frames()]

    assert [number_of(frame.rgb) for frame in shown] == list(range(24))
    for frame in shown:
        stored = np.frombuffer(frame.encoded, np.uint8)
        assert np.shares_memory(stored, frame.rgb)
        # One picture in each buffer, so that a picture that is kept does not keep others.
        assert isinstance(frame.encoded, memoryview)
        assert frame.encoded.nbytes == memoryview(frame.encoded.obj).nbytes
