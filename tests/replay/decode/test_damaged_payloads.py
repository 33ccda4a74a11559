"""Only damaged messages are dropped; messages of unknown types are skipped."""

import json
from base64 import b64encode
from collections.abc import Callable
from typing import Any, Final

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crosscue.replay.columns import Topic
from crosscue.replay.ledger import Ledger
from support.protobuf_types import F, proto_topic
from support.ros_messages import (
    block_of,
    decoder_of,
    random_message,
    ros,
    ros2_store,
    ros2_topic,
    serialized,
)

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
