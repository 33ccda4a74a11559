"""Peak memory of `convert` and `replay`, each in a separate process, by format and length.

    python benchmarks/memory.py [megabytes]

Every log contains 500 vectors and 500 CAN frames per second and, if the format supports them, 15
pictures of 145 kB of noise. The short log is a tenth as long as the long one. Peaks are Linux's
``VmHWM``, imports included. The replay uses wheel speeds, yaw rates and pictures, with the tests'
detector of bright spots.
"""

from __future__ import annotations

import sqlite3
import sys
import tempfile
from collections.abc import Callable, Iterator
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from mcap.writer import Writer
from rosbags.rosbag1 import Writer as BagWriter
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from crosscue.replay.columns import Block, Images, Messages, Topic
from crosscue.replay.ledger import Ledger
from crosscue.replay.write.convert import LogWriter

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
# Python imports from the folder of the script first.
window = import_module("window_reading")
PICTURE_BYTES = 145_000
DETECTOR = "support.detecting:build"
BYTES_A_SECOND = 500 * (60 + 65) + 15 * PICTURE_BYTES
TYPES = {
    "/speed": ("geometry_msgs/msg/Vector3Stamped", window.VECTOR_TEXT),
    "/can": ("can_msgs/msg/Frame", window.FRAME_TEXT),
    "/camera": ("sensor_msgs/msg/CompressedImage", window.PICTURE_TEXT),
}


def messages(megabytes: int) -> Iterator[tuple[int, str, bytes]]:
    """Yield time, topic and CDR message in time order, up to about this size."""
    left = megabytes * 1e6
    minutes = 1 + int(left / BYTES_A_SECOND / 60)
    for t_ns, k, message in window._messages(minutes, PICTURE_BYTES):
        left -= len(message)
        if left < 0:
            return
        yield t_ns, tuple(TYPES)[k], message


def write_mcap(path: Path, megabytes: int, *, chunked: bool) -> None:
    """Write messages in chunks or, without chunks, vectors and frames only, up to this size."""
    with path.open("wb") as stream:
        writer = Writer(stream, use_chunking=chunked)
        writer.start(profile="ros2")
        known = {
            topic: writer.register_channel(
                topic, "cdr", writer.register_schema(name, "ros2msg", text.encode())
            )
            for topic, (name, text) in TYPES.items()
        }
        for t_ns, topic, message in messages(megabytes * (1 if chunked else 20)):
            if chunked or topic != "/camera":
                writer.add_message(known[topic], t_ns, message, t_ns)
            if not chunked and stream.tell() > megabytes * 1e6:
                break
        writer.finish()  # type: ignore[no-untyped-call]


def write_bag(path: Path, megabytes: int, compression: Literal["none", "lz4", "bz2"]) -> None:
    store = get_typestore(Stores.ROS1_NOETIC)
    store.register(get_types_from_msg(import_module("conversion").FRAME, "can_msgs/msg/Frame"))
    writer = BagWriter(path)
    if compression != "none":
        writer.set_compression(BagWriter.CompressionFormat[compression.upper()])
    with writer:
        known = {
            topic: writer.add_connection(topic, name, typestore=store)
            for topic, (name, _) in TYPES.items()
        }
        for t_ns, topic, cdr in messages(megabytes):
            # ROS 1 headers begin with a number, strings have no final zero, nothing is padded.
            body = cdr[20:] if topic != "/camera" else b"\4\0\0\0jpeg" + cdr[32:]
            writer.write(known[topic], t_ns, bytes(4) + cdr[4:12] + b"\3\0\0\0car" + body)


def write_db3(path: Path, megabytes: int) -> None:
    with sqlite3.connect(path) as base:
        base.executescript(
            "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL,"
            " serialization_format TEXT NOT NULL, offered_qos_profiles TEXT NOT NULL);"
            "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL,"
            " timestamp INTEGER NOT NULL, data BLOB NOT NULL);"
            "CREATE INDEX timestamp_idx ON messages (timestamp ASC);"
        )
        kept = [topic for topic in TYPES if topic != "/can"]  # not a standard type
        rows = [(i, topic, TYPES[topic][0], "cdr", "") for i, topic in enumerate(kept, 1)]
        base.executemany("INSERT INTO topics VALUES (?, ?, ?, ?, ?)", rows)
        base.executemany(
            "INSERT INTO messages(topic_id, timestamp, data) VALUES (?, ?, ?)",
            (
                (kept.index(topic) + 1, t_ns, message)
                for t_ns, topic, message in messages(megabytes)
                if topic in kept
            ),
        )
    base.close()


def write_candump(path: Path, megabytes: int) -> None:
    rng = np.random.default_rng(1)
    line = "({:.6f}) can{} {:03X}#{}\n"
    with path.open("w") as stream:
        t_s = 1.7e9
        while stream.tell() < megabytes * 1e6:
            payloads = rng.bytes(8 * 10_000).hex().upper()
            for i, number in enumerate(rng.integers(0, 2048, 10_000)):
                stream.write(line.format(t_s, i % 2, number, payloads[16 * i : 16 * i + 16]))
                t_s += 0.001


def write_drive(path: Path, megabytes: int) -> None:
    """Write wheel speeds, yaw rates and pictures for a replay."""
    support = import_module("support.memory_log")
    camera = Topic("camera", "crosscue/Images", "columns")
    rng = np.random.default_rng(2)
    scenes = [
        cv2.imencode(".png", rng.integers(0, 256, (220, 220, 3), np.uint8))[1].tobytes()
        for _ in range(15)
    ]
    stop = np.cumsum([len(scene) for scene in scenes])
    start = np.concatenate([[0], stop[:-1]])
    content = np.frombuffer(b"".join(scenes), np.uint8)
    with LogWriter(path, Ledger("made")) as writer:
        for topic in (support.WHEELS, support.GYRO, camera):
            writer.add_topic(topic)
        for second in range(max(5, round(megabytes * 1e6 / len(content)))):
            t_ns = window.START_NS + second * 10**9 + np.arange(100) * 10**7
            writer.write(support.wheel_block(t_ns, [10.0] * 100))
            writer.write(support.gyro_block(t_ns, [0.01] * 100))
            images = Images(Messages(content, start, stop), ("png",) * 15)
            writer.write(Block("camera", t_ns[::7].copy(), images))


CASES: dict[str, tuple[str, Callable[[Path, int], None]]] = {
    "convert chunked.mcap": ("convert", partial(write_mcap, chunked=True)),
    "convert unchunked.mcap": ("convert", partial(write_mcap, chunked=False)),
    "convert candump.log": ("convert", write_candump),
    "convert log.db3": ("convert", write_db3),
    "convert none.bag": ("convert", partial(write_bag, compression="none")),
    "convert lz4.bag": ("convert", partial(write_bag, compression="lz4")),
    "convert bz2.bag": ("convert", partial(write_bag, compression="bz2")),
    "replay drive.mcap": ("replay", write_drive),
}


def main(megabytes: int) -> None:
    measured = import_module("support.measured").measured
    for name, (command, write) in CASES.items():
        for size in (megabytes // 10, megabytes):
            with tempfile.TemporaryDirectory() as folder:
                log = Path(folder) / name.split()[1]
                write(log, size)
                out = Path(folder) / ("out.mcap" if command == "convert" else "run")
                extra = [] if command == "convert" else ["--detectors", DETECTOR, "--no-cache"]
                status, said, peak_mib = measured([command, str(log), "-o", str(out), "-q", *extra])
                if status:
                    raise SystemExit(f"{name} ended with status {status}: {said}")
                print(
                    f"{name:24} {log.stat().st_size / 1e6:6.0f} MB: "
                    f"peak {peak_mib * 1.048576:4.0f} MB",
                    flush=True,
                )


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 500)
