"""Random ROS types and messages, encoded by rosbags, as an independent check of our decoder."""

from collections.abc import Callable, Iterator, Sequence
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from crosscue.replay.columns import Block, Messages, Topic
from crosscue.replay.decode import Decoder, decoder_for

_INTEGERS = ("int8", "uint8", "int16", "uint16", "int32", "uint32", "int64", "uint64")
PRIMITIVES = ("bool", "byte", "char", *_INTEGERS, "float32", "float64")
NUMPY = {"bool": "bool", "byte": "i1", "char": "u1", "float32": "f4", "float64": "f8"}

TIME = "builtin_interfaces/msg/Time"
DURATION = "builtin_interfaces/msg/Duration"
HEADER = "std_msgs/msg/Header"
CAN_FRAME = """\
std_msgs/Header header
uint32 id
bool is_rtr
bool is_extended
bool is_error
uint8 dlc
uint8[8] data
"""


@cache
def ros2_store() -> Typestore:
    """ROS 2 Humble's types and ``can_msgs/msg/Frame``."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg(CAN_FRAME, "can_msgs/msg/Frame"))
    return store


@cache
def ros1_store() -> Typestore:
    """ROS 1 Noetic's types and ``can_msgs/Frame``."""
    store = get_typestore(Stores.ROS1_NOETIC)
    store.register(get_types_from_msg(CAN_FRAME, "can_msgs/msg/Frame"))
    return store


def random_definition(rng: np.random.Generator, name: str, depth: int = 2) -> str:
    """Text of a random type with all its dependencies, as a log stores it."""
    parts: list[str] = []
    _describe(rng, name, depth, parts)
    separator = "=" * 80 + "\n"
    head, *rest = parts[::-1]
    return head + "".join(separator + each for each in rest)


def _describe(rng: np.random.Generator, name: str, depth: int, parts: list[str]) -> None:
    lines = []
    for k in range(int(rng.integers(1, 6))):
        choice = rng.random()
        if depth and choice < 0.3:
            inner = f"{name.split('/')[-1]}{k}"
            _describe(rng, f"made_msgs/{inner}", depth - 1, parts)
            kind = inner
        elif choice < 0.45:
            kind = "string"
        elif choice < 0.52:
            kind = "time" if rng.random() < 0.5 else "duration"
            kind = f"builtin_interfaces/{kind.title()}"
        else:
            kind = str(rng.choice(PRIMITIVES))
        suffix = str(rng.choice(["", "", f"[{rng.integers(1, 5)}]", "[]"]))
        lines.append(f"{kind}{suffix} f{k}")
    body = "\n".join(lines) + "\n"
    parts.append(f"MSG: {name}\n{body}" if depth < 2 else body)


def random_message(rng: np.random.Generator, store: Typestore, name: str) -> object:
    """One message of the type with random values, including NaN and infinities."""
    fields = store.fielddefs[name][1]
    return store.types[name](*(_value(rng, store, desc) for _, desc in fields))


def _value(rng: np.random.Generator, store: Typestore, desc: Any) -> Any:
    node, inner = desc
    if node == Nodetype.BASE:
        return _scalar(rng, inner[0])
    if node == Nodetype.NAME:
        return random_message(rng, store, inner)
    item, size = inner
    count = size if node == Nodetype.ARRAY else int(rng.integers(0, 4))
    if item[0] == Nodetype.BASE and item[1][0] != "string":
        values = [_scalar(rng, item[1][0]) for _ in range(count)]
        return np.array(values, NUMPY.get(item[1][0], item[1][0]))
    return [_value(rng, store, item) for _ in range(count)]


def _scalar(rng: np.random.Generator, name: str) -> object:
    if name == "string":
        return "".join(rng.choice(list("ab é€/_\U0001f697"), int(rng.integers(0, 7))))
    if name == "bool":
        return bool(rng.integers(0, 2))
    if name.startswith("float"):
        special = [np.nan, np.inf, -0.0, 1.5]
        value = rng.normal() if rng.random() < 0.8 else float(rng.choice(special))
        return float(np.dtype(NUMPY[name]).type(value))
    bounds = np.iinfo(NUMPY.get(name, name))
    return int(rng.integers(bounds.min, bounds.max, endpoint=True, dtype=bounds.dtype))


def numbers_in(
    message: object, store: Typestore, name: str, prefix: str = ""
) -> Iterator[tuple[str, object]]:
    """Yield the numbers and sequence lengths of a message with our dotted names."""
    for field, (node, inner) in store.fielddefs[name][1]:
        if field == "structure_needs_at_least_one_member":
            continue
        value = getattr(message, field)
        path = f"{prefix}.{field}" if prefix else field
        if node == Nodetype.NAME and inner in (TIME, DURATION):
            yield path, _nanoseconds(value, inner, is_ros1="seq" in str(store.fielddefs[HEADER]))
        elif node == Nodetype.NAME:
            yield from numbers_in(value, store, str(inner), path)
        elif node == Nodetype.SEQUENCE:
            yield f"{path}.length", len(value)
        elif (node == Nodetype.BASE and inner[0] != "string") or (
            node == Nodetype.ARRAY and inner[0][0] == Nodetype.BASE and inner[0][1][0] != "string"
        ):
            yield path, value


def _nanoseconds(value: Any, name: str, *, is_ros1: bool) -> int:
    """Nanoseconds of a time or duration.

    In ROS 1 both parts of a time are unsigned, and both parts of a duration are signed. rosbags
    reads them as those of ROS 2.
    """
    seconds, rest = int(value.sec), int(value.nanosec)
    if is_ros1 and name == TIME:
        seconds %= 1 << 32
    if is_ros1 and name == DURATION and rest >= 1 << 31:
        rest -= 1 << 32
    return seconds * 10**9 + rest


def messages_of(payloads: Sequence[bytes], gap: int = 0) -> Messages:
    """Payloads in one buffer, with ``gap`` unrelated bytes before each."""
    joined, start, stop = bytearray(), [], []
    for payload in payloads:
        joined += b"\xa5" * gap
        start.append(len(joined))
        joined += payload
        stop.append(len(joined))
    buffer: NDArray[np.uint8] = np.frombuffer(bytes(joined), np.uint8)
    return Messages(buffer, np.array(start, np.int64), np.array(stop, np.int64))


def block_of(topic: str, payloads: Sequence[bytes], gap: int = 3) -> Block:
    """A block of messages, a millisecond apart."""
    log_ns = np.arange(len(payloads), dtype=np.int64) * 1_000_000
    return Block(topic, log_ns, messages_of(payloads, gap))


def ros(is_cdr: bool) -> tuple[Typestore, Callable[[str, str], Topic]]:
    """The types of ROS 2 or ROS 1, and what makes a topic of one."""
    return (ros2_store(), ros2_topic) if is_cdr else (ros1_store(), ros1_topic)


def serialized(
    store: Typestore, message: object, name: str, is_cdr: bool = True, *, little: bool = True
) -> bytes:
    if is_cdr:
        return bytes(store.serialize_cdr(message, name, little_endian=little))
    return bytes(store.serialize_ros1(message, name))


def ros2_topic(name: str, type_name: str, text: str | None = None) -> Topic:
    """A CDR topic; without ``text``, the definition is from the store of rosbags."""
    if text is None:
        text, _ = ros2_store().generate_msgdef(type_name, ros_version=2)
    return Topic(name, type_name, "cdr", text.encode(), "ros2msg")


def ros1_topic(name: str, type_name: str, text: str | None = None) -> Topic:
    """A ROS 1 topic; without ``text``, the definition is from the store of rosbags."""
    if text is None:
        text, _ = ros1_store().generate_msgdef(type_name)
    return Topic(name, type_name, "ros1", text.encode(), "ros1msg")


def decoder_of(topic: Topic) -> Decoder:
    decoder = decoder_for(topic)
    assert decoder is not None
    return decoder
