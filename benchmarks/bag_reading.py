"""Read a drive from ROS 1 bags and ROS 2 SQLite bags: our readers next to rosbags, in one run.

    python benchmarks/bag_reading.py [rounds] [seconds of drive]
    python benchmarks/bag_reading.py memory [megabytes]    # peak memory of two sizes

The drive has 15 camera pictures of 150 kB, 2,258 CAN frames and 100 IMU messages per second. The
pictures are noise, which is as incompressible as JPEG. The cases alternate in one process, and
their CPU times are compared round by round. "blocks" is our reader alone, with every message
accounted for; "columns" also decodes CAN and IMU and locates the pictures' bytes. "raw" is rosbags
returning the bytes of each message, "objects" is rosbags deserialising them.
"""

from __future__ import annotations

import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final

import numpy as np
from rosbags.highlevel import AnyReader
from rosbags.interfaces import Connection
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

import crosscue
from crosscue.replay.decode import Decoder, decoder_for
from crosscue.replay.ledger import Ledger
from crosscue.replay.logs.opening import open_log

FRAME: Final = """std_msgs/Header header
uint32 id
bool is_rtr
bool is_extended
bool is_error
uint8 dlc
uint8[8] data
"""
START_NS: Final = 1_700_000_000_000_000_000
PICTURES, FRAMES, IMUS = 15, 2258, 100
BYTES_A_SECOND: Final = 2_500_000
MEASURED: Final = """
import sys
from pathlib import Path
from crosscue.replay.ledger import Ledger
from crosscue.replay.logs.opening import open_log
with open_log(sys.argv[1]) as log:
    for block in log.read(Ledger("a")):
        pass
status = Path("/proc/self/status").read_text().splitlines()
print(next(line.split()[1] for line in status if line.startswith("VmHWM")))
"""
TYPES: Final = {
    "/camera": "sensor_msgs/msg/CompressedImage",
    "/can": "can_msgs/msg/Frame",
    "/imu": "sensor_msgs/msg/Imu",
}


def store_of(which: Stores) -> Typestore:
    """Return a type store with the type of CAN frames."""
    store = get_typestore(which)
    store.register(get_types_from_msg(FRAME, "can_msgs/msg/Frame"))
    return store


def moments(seconds: int) -> list[tuple[int, str]]:
    """Return log time and topic of every message, in time order."""
    made = []
    for topic, rate in (("/camera", PICTURES), ("/can", FRAMES), ("/imu", IMUS)):
        steps = np.arange(seconds * rate) * (1_000_000_000 / rate)
        made += [(START_NS + int(step), topic) for step in steps]
    return sorted(made)


def drive(store: Typestore, is_ros1: bool, seconds: int) -> Iterator[tuple[str, int, bytes]]:
    """Yield topic, time and serialised message of the complete drive."""
    types = store.types
    rng = np.random.default_rng(3)
    for i, (t_ns, topic) in enumerate(moments(seconds)):
        stamp = types["builtin_interfaces/msg/Time"](sec=t_ns // 10**9, nanosec=t_ns % 10**9)
        extra = {"seq": i} if is_ros1 else {}
        header = types["std_msgs/msg/Header"](stamp=stamp, frame_id="car", **extra)
        kind = types[TYPES[topic]]
        if topic == "/camera":
            noise = rng.integers(0, 256, size=150_000, dtype=np.uint8)
            message = kind(header=header, format="jpeg", data=noise)
        elif topic == "/can":
            message = kind(
                header=header,
                id=i % 2048,
                is_rtr=False,
                is_extended=False,
                is_error=False,
                dlc=8,
                data=rng.integers(0, 256, size=8, dtype=np.uint8),
            )
        else:
            vector = types["geometry_msgs/msg/Vector3"](x=0.1, y=0.2, z=9.8)
            turn = types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0)
            nine = np.zeros(9)
            message = kind(header, turn, nine, vector, nine, vector, nine)
        raw = (store.serialize_ros1 if is_ros1 else store.serialize_cdr)(message, TYPES[topic])
        yield topic, t_ns, bytes(raw)


def write_bag(path: Path, compression: str, seconds: int) -> Path:
    store = store_of(Stores.ROS1_NOETIC)
    writer = Writer1(path)
    if compression != "none":
        writer.set_compression(Writer1.CompressionFormat[compression.upper()])
    with writer:
        links: dict[str, Connection] = {
            topic: writer.add_connection(topic, kind, typestore=store)
            for topic, kind in TYPES.items()
        }
        for topic, t_ns, raw in drive(store, True, seconds):
            writer.write(links[topic], t_ns, raw)
    return path


def write_db3(path: Path, seconds: int) -> Path:
    store = store_of(Stores.ROS2_HUMBLE)
    with Writer2(path, version=9) as writer:
        links = {
            topic: writer.add_connection(topic, kind, typestore=store)
            for topic, kind in TYPES.items()
        }
        for topic, t_ns, raw in drive(store, False, seconds):
            writer.write(links[topic], t_ns, raw)
    return path


def ours(path: Path, is_decoded: bool) -> int:
    ledger = Ledger(str(path))
    count = 0
    with open_log(path) as log:
        decoders: dict[str, Decoder | None] = {t.name: decoder_for(t) for t in log.topics}
        for block in log.read(ledger):
            decode = decoders[block.topic]
            if is_decoded and decode is not None:
                block = decode(block, ledger)
            count += len(block)
    assert ledger.is_whole, ledger.details
    return count


def batches(path: Path, is_decoded: bool) -> int:
    """Read by the call that users write, with every column decoded."""
    assert is_decoded
    with crosscue.open(path) as log:
        return sum(rows.num_rows for _, rows in log.batches())


def theirs(path: Path, is_decoded: bool) -> int:
    count = 0
    with AnyReader([path]) as reader:
        for link, _, raw in reader.messages():
            if is_decoded:
                reader.deserialize(raw, link.msgtype)
            count += 1
    return count


def timed(work: Callable[[Path, bool], int], path: Path, is_decoded: bool, want: int) -> float:
    began = time.process_time()
    assert work(path, is_decoded) == want
    return time.process_time() - began


def compare(name: str, path: Path, rounds: int, want: int) -> None:
    """Print one table line per case: median CPU seconds, messages a second, median ratios."""
    cases: dict[str, tuple[Callable[[Path, bool], int], bool]] = {
        "ours, log.batches()": (batches, True),
        "ours, blocks": (ours, False),
        "ours, columns": (ours, True),
        "rosbags, raw": (theirs, False),
        "rosbags, objects": (theirs, True),
    }
    for work, is_decoded in cases.values():
        timed(work, path, is_decoded, want)
    times: dict[str, list[float]] = {case: [] for case in cases}
    for _ in range(rounds):
        for case, (work, is_decoded) in cases.items():
            times[case].append(timed(work, path, is_decoded, want))
    for case, spent in times.items():
        ratios = {
            peer: statistics.median(b / a for a, b in zip(spent, times[peer], strict=True))
            for peer in ("rosbags, raw", "rosbags, objects")
        }
        middle = statistics.median(spent)
        print(
            f"{name:10}{case:20}{middle:9.3f} s [{min(spent):.3f}-{max(spent):.3f}]"
            f"{want / middle / 1e6:9.2f} M/s{ratios['rosbags, raw']:9.1f} x"
            f"{ratios['rosbags, objects']:9.1f} x",
            flush=True,
        )


def show_memory(megabytes: int) -> None:
    """Print the peak memory of reading a log and one ten times as long, in new processes."""
    with tempfile.TemporaryDirectory() as folder:
        for name, suffix in (("bag none", "bag"), ("bag lz4", "bag"), ("db3", "")):
            for size in (megabytes // 10, megabytes):
                path = Path(folder) / f"log.{suffix}" if suffix else Path(folder) / "log"
                seconds = max(1, round(size * 1e6 / BYTES_A_SECOND))
                if suffix:
                    write_bag(path, name.split()[1], seconds)
                else:
                    write_db3(path, seconds)
                command = [sys.executable, "-c", MEASURED, str(path)]
                peak = subprocess.run(command, capture_output=True, text=True, check=True).stdout
                print(f"{name:10}{size:6} MB log: peak {int(peak) / 1024:.0f} MiB", flush=True)
                shutil.rmtree(path) if path.is_dir() else path.unlink()


def main() -> None:
    """Write the drives and compare the readers on them."""
    if sys.argv[1:2] == ["memory"]:
        show_memory(int(sys.argv[2]) if len(sys.argv) > 2 else 2000)
        return
    rounds = int(sys.argv[1]) if len(sys.argv) > 1 else 5
    seconds = int(sys.argv[2]) if len(sys.argv) > 2 else 60
    want = seconds * (PICTURES + FRAMES + IMUS)
    print(f"{want} messages; x: times as fast as rosbags raw, rosbags objects; {rounds} rounds")
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        for compression in ("none", "lz4"):
            path = write_bag(place / f"{compression}.bag", compression, seconds)
            compare(f"bag {compression}", path, rounds, want)
            path.unlink()
        compare("db3", write_db3(place / "db", seconds), rounds, want)


if __name__ == "__main__":
    main()
