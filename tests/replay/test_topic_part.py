"""One topic over a time range: the same rows as when the complete log is read."""

from pathlib import Path

import numpy as np
from mcap.writer import Writer

from crosscue.replay.columns import Messages
from crosscue.replay.logs.opening import open_log
from crosscue.replay.logs.topic_part import read_topic


def two_topic_log(path: Path) -> Path:
    """Write 200 vectors on /speed and 200 messages of an unknown type, in chunks of 1200 bytes."""
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=1200)
        writer.start(profile="ros2")
        schema = writer.register_schema(
            "geometry_msgs/msg/Vector3", "ros2msg", b"float64 x\nfloat64 y\nfloat64 z"
        )
        speed = writer.register_channel("/speed", "cdr", schema)
        other = writer.register_channel("/other", "secret", 0)
        for i in range(200):
            head = b"\x00\x01\x00\x00"
            writer.add_message(speed, i, head + np.array([i, 0, 0], "<f8").tobytes(), i)
            writer.add_message(other, i, b"%d" % i, i)
        writer.finish()  # type: ignore[no-untyped-call]
    return path


def test_unknown_type_is_read_as_messages(tmp_path: Path) -> None:
    with open_log(two_topic_log(tmp_path / "x.mcap")) as log:
        part = read_topic(log, "/other", end_ns=3)

    found = [
        bytes(block.rows.payload(i))
        for block in part.blocks
        if isinstance(block.rows, Messages)
        for i in range(len(block))
    ]
    assert found == [b"0", b"1", b"2"]
