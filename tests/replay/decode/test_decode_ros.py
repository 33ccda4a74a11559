"""ROS messages: agreement with rosbags, also on which are invalid, and damaged messages."""

import json
import pickle
from base64 import b64encode
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Final

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from crosscue.replay.columns import Table, Topic
from crosscue.replay.decode import decoder_for
from crosscue.replay.decode.ros.decoder import RosDecoder
from crosscue.replay.decode.ros.standard import RosConversion, generic
from crosscue.replay.errors import SchemaError
from crosscue.replay.ledger import Ledger
from support.protobuf_types import F, proto_topic
from support.ros_messages import (
    block_of,
    decoder_of,
    messages_of,
    numbers_in,
    random_definition,
    random_message,
    ros,
    ros1_topic,
    ros2_store,
    ros2_topic,
    serialized,
)

MADE = "made_msgs/msg/Root"
SEEDS = st.integers(0, 2**32 - 1)
QUICK = settings(max_examples=40, deadline=None)


def generic_decoder(topic: Topic) -> RosDecoder:
    """Return the generic decoder, even for a type with standard columns."""
    decoder = decoder_of(topic)
    assert isinstance(decoder, RosDecoder)
    return replace(decoder, kind=RosConversion((), generic))


def assert_same_values(table: Table, messages: list[object], store: Typestore, name: str) -> None:
    expected = [dict(numbers_in(message, store, name)) for message in messages]
    for path in expected[0] if expected else ():
        expected_column = np.array([np.asarray(each[path]) for each in expected])
        np.testing.assert_array_equal(table[path], expected_column, err_msg=f"{name}: {path}")


@pytest.mark.slow
@pytest.mark.parametrize("is_cdr", [True, False])
def test_standard_types_decode_like_rosbags(is_cdr: bool) -> None:
    store, topic_of = ros(is_cdr)
    rng = np.random.default_rng(5)
    compared = 0
    for name in sorted(store.fielddefs):
        if "/msg/" not in name or name.startswith(("rcl_interfaces/", "builtin_")):
            continue
        messages = [random_message(rng, store, name) for _ in range(4)]
        payloads = [serialized(store, each, name, is_cdr) for each in messages]
        ledger = Ledger("made")
        table = generic_decoder(topic_of("/t", name))(block_of("/t", payloads), ledger).rows
        assert not ledger.details, name
        assert isinstance(table, Table)
        assert_same_values(table, messages, store, name)
        decoder = decoder_of(topic_of("/t", name))
        twice = [decoder(block_of("/t", payloads[-1:] * 2), Ledger("made")) for _ in range(2)]
        assert pickle.dumps(twice[0].rows) == pickle.dumps(twice[1].rows)
        compared += 1
    assert compared > 100


def made_type(rng: np.random.Generator, is_cdr: bool) -> tuple[Typestore, Topic]:
    """Return a topic of a random type, and a store that has it."""
    text = random_definition(rng, "made_msgs/Root")
    store = get_typestore(Stores.ROS2_HUMBLE if is_cdr else Stores.ROS1_NOETIC)
    store.register(get_types_from_msg(text, MADE))
    return store, (ros2_topic if is_cdr else ros1_topic)("/t", MADE, text)


@pytest.mark.slow
@given(seed=SEEDS, is_cdr=st.booleans())
@QUICK
def test_random_types_decode_like_rosbags(seed: int, is_cdr: bool) -> None:
    rng = np.random.default_rng(seed)
    store, topic = made_type(rng, is_cdr)
    messages = [random_message(rng, store, MADE) for _ in range(6)]
    mixed = is_cdr and rng.random() < 0.3
    payloads = [
        serialized(store, each, MADE, is_cdr, little=not (mixed and rng.random() < 0.5))
        for each in messages
    ]
    ledger = Ledger("made")

    decoded = generic_decoder(topic)(block_of("/t", payloads, gap=int(rng.integers(0, 9))), ledger)

    assert not ledger.details
    assert isinstance(decoded.rows, Table)
    assert_same_values(decoded.rows, messages, store, MADE)


@pytest.mark.slow
@given(seed=SEEDS, is_cdr=st.booleans())
@QUICK
def test_messages_decode_together_as_alone(seed: int, is_cdr: bool) -> None:
    """Positions that all messages share are one number; the others are one for each message."""
    rng = np.random.default_rng(seed)
    store, topic = made_type(rng, is_cdr)
    raw, other = (
        serialized(store, random_message(rng, store, MADE), MADE, is_cdr) for _ in range(2)
    )
    # The first bytes contain lengths more often than the rest.
    for at in {*range(min(8, len(raw))), *rng.integers(0, max(len(raw), 1), 8).tolist()}:
        if at >= len(raw):
            continue
        changed = bytearray(raw)
        changed[at] ^= int(rng.integers(1, 256))
        for payloads in ([raw, bytes(changed), raw], [raw, bytes(changed), other, raw]):
            block = block_of("/t", payloads, gap=1)
            ledgers = Ledger("together"), Ledger("alone")

            together = generic_decoder(topic)(block, ledgers[0])
            alone = [
                generic_decoder(topic)(block.take(np.array([i])), ledgers[1])
                for i in range(len(payloads))
            ]

            assert isinstance(together.rows, Table)
            np.testing.assert_array_equal(
                together.log_ns, np.concatenate([one.log_ns for one in alone])
            )
            for column in together.rows.columns:
                parts = [one.rows[column] for one in alone]  # type: ignore[index]
                assert all(part.dtype == together.rows[column].dtype for part in parts)
                assert together.rows[column].tobytes() == b"".join(p.tobytes() for p in parts)
            assert ledgers[0].details == ledgers[1].details


@given(seed=SEEDS, is_cdr=st.booleans())
@QUICK
def test_damaged_messages_are_dropped_like_rosbags(seed: int, is_cdr: bool) -> None:
    rng = np.random.default_rng(seed)
    sensors = [f"sensor_msgs/msg/{name}" for name in ("JointState", "PointCloud2", "Imu")]
    name = str(rng.choice([*sensors, "diagnostic_msgs/msg/DiagnosticArray", "nav_msgs/msg/Path"]))
    store, topic_of = ros(is_cdr)
    payloads, accepted = [], []
    for _ in range(24):
        raw = bytearray(serialized(store, random_message(rng, store, name), name, is_cdr))
        match int(rng.integers(0, 5)):
            case 0:
                raw = raw[: int(rng.integers(0, len(raw)))]
            case 1:
                raw += bytes(int(rng.integers(1, 9)))
            case 2 | 3:
                for _ in range(int(rng.integers(1, 4))):
                    raw[int(rng.integers(0, len(raw)))] = int(rng.integers(0, 256))
            case _:
                pass
        payloads.append(bytes(raw))
        accepted.append(_decode_with_rosbags(store, bytes(raw), name, is_cdr))
    ledger = Ledger("made")
    ledger.find("/t", len(payloads))

    decoded = generic_decoder(topic_of("/t", name))(block_of("/t", payloads), ledger)

    expected_ns = block_of("/t", payloads).log_ns[np.array([each is not None for each in accepted])]
    np.testing.assert_array_equal(decoded.log_ns, expected_ns)
    assert ledger.topic("/t").used == len(decoded)
    assert isinstance(decoded.rows, Table)
    assert_same_values(decoded.rows, [each for each in accepted if each is not None], store, name)


def _decode_with_rosbags(store: Typestore, raw: bytes, name: str, is_cdr: bool) -> object | None:
    try:
        read = store.deserialize_cdr if is_cdr else store.deserialize_ros1
        return read(memoryview(raw), name)
    except SerdeError:
        return None


def test_taking_rows_of_both_byte_orders_keeps_values() -> None:
    store, name = ros2_store(), "std_msgs/msg/Int32"
    payloads = [serialized(store, store.types[name](i), name, little=i % 2 == 0) for i in range(10)]
    keep = np.array([i % 3 == 0 for i in range(10)])

    decoder = generic_decoder(ros2_topic("/i", name))
    fields, _ = decoder.walked(block_of("/i", payloads), messages_of(payloads), Ledger("made"))

    np.testing.assert_array_equal(fields.number("data"), np.arange(10))
    np.testing.assert_array_equal(fields.take(keep).number("data"), [0, 3, 6, 9])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("float64 x\n\x00\x01 y\n", "cannot read the line"),
        ("Other o\n", "lacks the type made_msgs/msg/Other"),
        ("Root again\n", "nested deeper"),
        ("uint8[20000000000] x\n", "cannot read the line|alone takes"),
        ("uint8[2000000000] x\n", "alone takes 2000000000 bytes"),
        ("A[1000] a\n" + "=" * 80 + "\nMSG: made_msgs/A\nuint8[1000000] x\n", "alone takes"),
        ("wstring w\n", "lacks the type|not supported"),
        ("uint8[0] x\n", "array x of length 0"),
        ("int32 x\n" * 30_000, "expands to over"),
        ("x" * (2 << 20), "over the limit"),
        ("@a(" * 100_000 + "\n", "cannot read the line"),
        ("string<=x y\n", "cannot read the line"),
        ("Header h some value\n", "cannot read the line"),
        ("int32 x\n" + "=" * 80 + "\nint32 y\n", "expected 'MSG: name'"),
        (("=" * 80 + "\n").join(["", "MSG: a/B\nint8 x\n", "MSG: a/B\nint9 x\n"]), "two different"),
    ],
)
def test_invalid_definition_is_refused_in_one_line(text: str, complaint: str) -> None:
    topic = Topic("/t", "made_msgs/msg/Root", "cdr", text.encode(), "ros2msg")

    with pytest.raises(SchemaError, match=complaint) as caught:
        decoder_for(topic)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 400


@pytest.mark.slow
def test_message_with_too_many_nested_items_is_dropped() -> None:
    text = "Row[] rows\n" + "=" * 80 + "\nMSG: made_msgs/Row\nstring s\n"
    count = 1_000_000
    payload = count.to_bytes(4, "little") + bytes(4 * count)
    ledger = Ledger("made")

    decoded = decoder_of(Topic("/t", "made_msgs/Root", "ros1", text.encode(), "ros1msg"))(
        block_of("/t", [payload]), ledger
    )

    assert len(decoded) == 0
    assert "nested items" in ledger.details[0].detail


@pytest.mark.parametrize(
    "idl",
    [
        "module a { module msg { const long X = (((1))); struct T { double x; }; }; };",
        "module a { module msg { const long X = 1 << 99999999999; struct T { long x; }; }; };",
        "module a { module msg { const long X = 9; const long Y = X * X; struct T { char x; }; }; "
        "};",
        "module a { module msg { struct T { "
        + "sequence<" * 300
        + "long"
        + ">" * 300
        + " x; }; }; };",
        "/* never closed " * 3000,
        "module a { module msg { struct T { double x; };",
        "struct T { double x; };\n" * 9000,
    ],
)
def test_costly_idl_definition_is_refused(idl: str) -> None:
    with pytest.raises(SchemaError):
        decoder_for(Topic("/t", "a/msg/T", "cdr", idl.encode(), "ros2idl"))


@given(seed=SEEDS, is_cdr=st.booleans())
@QUICK
def test_damaged_definition_is_used_or_refused_in_one_line(seed: int, is_cdr: bool) -> None:
    rng = np.random.default_rng(seed)
    store, topic_of = ros(is_cdr)
    name = str(rng.choice(["sensor_msgs/msg/Imu", "nav_msgs/msg/Path", "sensor_msgs/msg/Image"]))
    topic = topic_of("/t", name)
    text = bytearray(topic.schema)
    for _ in range(int(rng.integers(1, 4))):
        at = int(rng.integers(0, len(text)))
        if rng.random() < 0.5:
            text[at] = int(rng.choice(list(b"[]<=019 \n/@zZ\xff")))
        else:
            del text[at : at + int(rng.integers(1, 30))]
    payloads = [serialized(store, random_message(rng, store, name), name, is_cdr) for _ in range(4)]
    ledger = Ledger("made")
    ledger.find("/t", 4)

    try:
        decoder = decoder_for(replace(topic, schema=bytes(text)))
    except SchemaError as error:
        assert "\n" not in str(error)  # noqa: PT017
        return
    assert decoder is not None
    assert len(decoder(block_of("/t", payloads), ledger)) == ledger.topic("/t").used


def test_idl_definition_decodes_like_msg_definition() -> None:
    idl = """module geometry_msgs { module msg {
      struct Vector3 { double x; double y; double z; };
      struct Made { geometry_msgs::msg::Vector3 at; sequence<int16> counts; float w[3]; string s; };
    }; };"""
    text = (
        "Vector3 at\nint16[] counts\nfloat32[3] w\nstring s\n"
        + "=" * 80
        + ("\nMSG: geometry_msgs/Vector3\nfloat64 x\nfloat64 y\nfloat64 z\n")
    )
    store = get_typestore(Stores.ROS2_HUMBLE)
    name = "geometry_msgs/msg/Made"
    store.register(get_types_from_msg("Vector3 at\nint16[] counts\nfloat32[3] w\nstring s\n", name))
    rng = np.random.default_rng(4)
    payloads = [serialized(store, random_message(rng, store, name), name) for _ in range(5)]
    tables = []
    for schema, encoding in ((idl, "ros2idl"), (text, "ros2msg")):
        topic = Topic("/m", name, "cdr", schema.encode(), encoding)
        rows = decoder_of(topic)(block_of("/m", payloads), Ledger("x")).rows
        assert isinstance(rows, Table)
        tables.append(rows)

    assert tables[0].columns.keys() == tables[1].columns.keys()
    for column in tables[0].columns:
        np.testing.assert_array_equal(tables[0][column], tables[1][column])


PICTURE: Final = b"\xff\xd8" + bytes(range(64))


def _ros(rng: np.random.Generator, kind: str) -> tuple[Topic, bytes]:
    is_cdr, name = kind == "CDR", "sensor_msgs/msg/Imu"
    store, topic_of = ros(is_cdr)
    return topic_of("/t", name), serialized(store, random_message(rng, store, name), name, is_cdr)


def _camera(rng: np.random.Generator, kind: str) -> tuple[Topic, bytes]:
    store, name = ros2_store(), "sensor_msgs/msg/Image"
    header: Any = random_message(rng, store, "std_msgs/msg/Header")
    pixels = np.zeros(18, np.uint8)
    message = store.types[name](header, 2, 3, "rgb8", 0, 9, pixels)
    return ros2_topic("/t", name), serialized(store, message, name)


def _json(rng: np.random.Generator, kind: str) -> tuple[Topic, bytes]:
    tree = {"timestamp": {"sec": int(rng.integers(1, 99)), "nsec": 7}, "a": float(rng.random())}
    if kind == "JSON picture":
        tree |= {"data": b64encode(PICTURE).decode(), "format": "jpeg"}
    name = "foxglove.CompressedImage" if kind == "JSON picture" else "made.Thing"
    return Topic("/t", name, "json"), json.dumps(tree).encode()


def _protobuf(rng: np.random.Generator, kind: str) -> tuple[Topic, bytes]:
    topic, of = proto_topic("Thing", (("value", 1, F.TYPE_DOUBLE), ("text", 2, F.TYPE_STRING)))
    return topic, of(value=float(rng.random()) + 1.0, text="words").SerializeToString()


KINDS: Final[dict[str, Callable[[np.random.Generator, str], tuple[Topic, bytes]]]] = {
    "CDR": _ros,
    "CDR picture": _camera,
    "ROS 1": _ros,
    "JSON": _json,
    "JSON picture": _json,
    "protobuf": _protobuf,
}


@pytest.mark.parametrize("kind", KINDS)
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(1, 9))
@settings(max_examples=15)
def test_only_the_damaged_message_is_dropped(kind: str, seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    made = [KINDS[kind](rng, kind) for _ in range(count)]
    payloads = [payload for _, payload in made]
    bad = int(rng.integers(count))
    payloads[bad] = payloads[bad][: len(payloads[bad]) - int(rng.integers(4, 6))]
    ledger = Ledger("made")
    ledger.find("/t", count)

    block = decoder_of(made[0][0])(block_of("/t", payloads), ledger)

    account = ledger.topic("/t")
    assert (account.skipped.total(), account.dropped.total()) == (0, 1)
    assert (account.in_file, account.used, len(block)) == (count, count - 1, count - 1)
    assert block.log_ns.tolist() == [t * 1_000_000 for t in range(count) if t != bad]
