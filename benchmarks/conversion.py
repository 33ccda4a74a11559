"""Convert a ROS 1 bag to MCAP: ours next to ``rosbags.convert``, in one run.

    python benchmarks/conversion.py [rounds]

There are two simulated logs: a drive (30 s with 450 pictures of 150 kB of noise, which is as
incompressible as JPEG, 60,000 CAN frames and 3,000 IMU messages) and the same without pictures.
Both write zstd chunks; only ours writes checksums. "and read back" is the complete command, which
reads the new file again with every checksum. The cases alternate after one warm-up round, and
ratios are taken round by round. The messages of both outputs are compared before timing.
"""

from __future__ import annotations

import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.convert.converter import convert as rosbags_convert
from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from crosscue.eval.cli import run as crosscue
from crosscue.replay.ledger import Ledger
from crosscue.replay.logs.opening import open_log
from crosscue.replay.write.convert import LogWriter

FRAME = """std_msgs/Header header
uint32 id
bool is_rtr
bool is_extended
bool is_error
uint8 dlc
uint8[8] data
"""
PICTURES, FRAMES, IMU = 450, 60_000, 3_000
SPAN_NS, START_NS = 30_000_000_000, 1_600_000_000_000_000_000
ROUNDS = 7


def messages(*, with_pictures: bool) -> Iterator[tuple[int, str, str, bytes]]:
    """Yield time, topic, type and ROS 1 bytes of every message, in time order."""
    rng = np.random.default_rng(0)
    store = get_typestore(Stores.ROS1_NOETIC)
    store.register(get_types_from_msg(FRAME, "can_msgs/msg/Frame"))
    types = store.types
    rows: list[tuple[int, str, str, bytes]] = []

    def add(n: int, topic: str, name: str, make: Callable[[Any], object]) -> None:
        for i in range(n):
            t_ns = START_NS + SPAN_NS * i // n
            stamp = types["builtin_interfaces/msg/Time"](t_ns // 10**9, t_ns % 10**9)
            header = types["std_msgs/msg/Header"](i, stamp, topic.strip("/"))
            rows.append((t_ns, topic, name, bytes(store.serialize_ros1(make(header), name))))

    def frame(header: Any) -> object:
        identifier, payload = int(rng.integers(0, 2048)), rng.integers(0, 256, 8, np.uint8)
        return types["can_msgs/msg/Frame"](header, identifier, False, False, False, 8, payload)

    def imu(header: Any) -> object:
        vector = types["geometry_msgs/msg/Vector3"]
        a, b = vector(*rng.normal(size=3)), vector(*rng.normal(size=3))
        turn = types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
        return types["sensor_msgs/msg/Imu"](
            header, turn, np.zeros(9), a, np.zeros(9), b, np.zeros(9)
        )

    def picture(header: Any) -> object:
        pixels = rng.integers(0, 256, 150_000, np.uint8)
        return types["sensor_msgs/msg/CompressedImage"](header, "jpeg", pixels)

    add(FRAMES, "/can", "can_msgs/msg/Frame", frame)
    add(IMU, "/imu", "sensor_msgs/msg/Imu", imu)
    if with_pictures:
        add(PICTURES, "/front", "sensor_msgs/msg/CompressedImage", picture)
    yield from sorted(rows, key=lambda row: row[0])


def make_bag(path: Path, *, with_pictures: bool) -> None:
    store = get_typestore(Stores.ROS1_NOETIC)
    store.register(get_types_from_msg(FRAME, "can_msgs/msg/Frame"))
    with Writer(path) as writer:
        known = {}
        for t_ns, topic, name, raw in messages(with_pictures=with_pictures):
            if topic not in known:
                known[topic] = writer.add_connection(topic, name, typestore=store)
            writer.write(known[topic], t_ns, raw)


def ours(bag: Path, out: Path) -> Path:
    ledger = Ledger(str(bag))
    with open_log(bag) as log, LogWriter(out, ledger, overwrite=True) as writer:
        for topic in log.topics:
            writer.add_topic(topic)
        for block in log.read(ledger):
            writer.write(block)
    return out


def ours_read_back(bag: Path, out: Path) -> Path:
    status = crosscue(["convert", str(bag), "-o", str(out), "--overwrite", "-q"])
    if status:
        raise SystemExit(f"crosscue convert ended with status {status}")
    return out


def peer(bag: Path, out: Path) -> Path:
    folder = Path(tempfile.mkdtemp(dir=out.parent)) / "peer"
    # With a target type store, rosbags converts to ROS 2 serialisation, as ours does.
    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg(FRAME, "can_msgs/msg/Frame"))
    rosbags_convert([bag], folder, "mcap", 9, "zstd", "storage", None, store, (), (), (), ())
    return next(folder.glob("*.mcap"))


CASES: dict[str, Callable[[Path, Path], Path]] = {
    "rosbags.convert": peer,
    "ours": ours,
    "ours and read back": ours_read_back,
}


def held(path: Path) -> list[tuple[str, int, bytes]]:
    source = path if path.suffix == ".mcap" and path.parent.name != "peer" else path.parent
    with AnyReader([source]) as reader:
        return sorted((c.topic, t_ns, bytes(raw)) for c, t_ns, raw in reader.messages())


def measure(name: str, bag: Path, rounds: int) -> None:
    outs = {case: convert(bag, bag.with_suffix(".mcap")) for case, convert in CASES.items()}
    if held(outs["ours"]) != held(outs["rosbags.convert"]):
        raise SystemExit("the two outputs do not hold the same messages")
    seconds: dict[str, list[float]] = {case: [] for case in CASES}
    for _ in range(rounds):
        for case, convert in CASES.items():
            begin = time.perf_counter()
            convert(bag, bag.with_suffix(".mcap"))
            seconds[case].append(time.perf_counter() - begin)
    print(f"\n{name}: {bag.stat().st_size / 1e6:.0f} MB, medians of {rounds} [min-max]")
    for case, taken in seconds.items():
        ratios = [p / t for p, t in zip(seconds["rosbags.convert"], taken, strict=True)]
        print(
            f"  {case:20} {statistics.median(taken):7.3f} s [{min(taken):.3f}-{max(taken):.3f}]"
            f"   x{statistics.median(ratios):.1f} [{min(ratios):.1f}-{max(ratios):.1f}]"
        )


def main() -> None:
    rounds = int(sys.argv[1]) if len(sys.argv) > 1 else ROUNDS
    if rounds < 5:
        raise SystemExit("at least 5 rounds, so that a median means something")
    with tempfile.TemporaryDirectory() as folder:
        for name, with_pictures in (("drive", True), ("CAN and IMU", False)):
            bag = Path(folder) / f"{name.split()[0]}.bag"
            make_bag(bag, with_pictures=with_pictures)
            measure(name, bag, rounds)


if __name__ == "__main__":
    main()
