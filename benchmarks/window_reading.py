"""Two seconds of one signal topic of a long log: ours next to the peers, in one run.

    python benchmarks/window_reading.py [rounds]

Three MCAP logs (zstd, 1 MiB chunks), each with a topic of 500 vectors a second, one of 500 CAN
frames a second and 15 pictures of noise a second: 5 minutes with pictures of 145 kB (700 MB), 5 and
50 minutes with pictures of 14.5 kB. Every case opens the file, finds two seconds in its middle,
decodes the vectors and closes the file. The cases run in rotation; CPU seconds of all threads, and
the medians of the ratios to ours and to Rerun, the fastest peer, taken round by round. Ours
verifies the checksums of what it reads; the peers do not. Ours calls ``log[topic].table``.
"""

from __future__ import annotations

import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from mcap_ros2.decoder import DecoderFactory
from rerun.chunk import McapReader
from rosbags.highlevel import AnyReader

import crosscue

HEADER_TEXT = """
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
VECTOR_TEXT = f"""std_msgs/Header header
geometry_msgs/Vector3 vector
================================================================================
MSG: geometry_msgs/Vector3
float64 x
float64 y
float64 z{HEADER_TEXT}"""
FRAME_TEXT = f"""std_msgs/Header header
uint32 id
bool is_rtr
bool is_extended
bool is_error
uint8 dlc
uint8[8] data{HEADER_TEXT}"""
PICTURE_TEXT = f"""std_msgs/Header header
string format
uint8[] data{HEADER_TEXT}"""
START_NS = 1_700_000_000_000_000_000
SECOND_NS = 1_000_000_000
SPAN_S = 2
TOPIC = "/speed"


def _head(t_ns: int) -> bytes:
    stamp = np.array([t_ns // SECOND_NS, t_ns % SECOND_NS, 4], dtype="<u4").tobytes()
    return b"\x00\x01\x00\x00" + stamp + b"car\x00"


def vector(t_ns: int, i: int) -> bytes:
    """Return one vector message."""
    return _head(t_ns) + np.array([i, 0.1, 0.2], dtype="<f8").tobytes()


def _messages(minutes: int, picture_bytes: int) -> Iterator[tuple[int, int, bytes]]:
    """Yield time, topic number and message in time order."""
    rng = np.random.default_rng(1)
    for i in range(minutes * 60 * 500):
        t_ns = START_NS + i * 2_000_000
        head = _head(t_ns)
        yield t_ns, 0, vector(t_ns, i)
        frame = np.array([i % 2048, 0x08_000000], dtype="<u4").tobytes()
        yield t_ns + 1000, 1, head + frame + i.to_bytes(8, "little")
        if not i % 33:
            coded = rng.bytes(picture_bytes)
            size = np.array([len(coded)], dtype="<u4").tobytes()
            jpeg = np.array([5], dtype="<u4").tobytes() + b"jpeg\x00\x00\x00\x00"
            yield t_ns + 2000, 2, head + jpeg + size + coded


def write_log(path: Path, minutes: int, picture_bytes: int) -> None:
    """Write the log described above."""
    with path.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.ZSTD)
        writer.start(profile="ros2")
        channels = [
            writer.register_channel(
                topic, "cdr", writer.register_schema(name, "ros2msg", text.encode())
            )
            for topic, name, text in (
                (TOPIC, "geometry_msgs/msg/Vector3Stamped", VECTOR_TEXT),
                ("/can", "can_msgs/msg/Frame", FRAME_TEXT),
                ("/camera", "sensor_msgs/msg/CompressedImage", PICTURE_TEXT),
            )
        ]
        for sequence, (t_ns, k, message) in enumerate(_messages(minutes, picture_bytes)):
            writer.add_message(channels[k], t_ns, message, t_ns, sequence)
        writer.finish()  # type: ignore[no-untyped-call]


def ours(path: Path, begin: int, end: int) -> int:
    with crosscue.open(path) as log:
        start_s = (begin - START_NS) / SECOND_NS
        return len(log[TOPIC].table(start_s, start_s + (end - begin) / SECOND_NS))


def small_mcap(path: Path, begin: int, end: int) -> int:
    decoder = import_module("mcap_ros2_support_fast.decoder").DecoderFactory()
    with path.open("rb") as stream:
        found = import_module("small_mcap").read_message_decoded(
            stream,
            lambda channel, _: channel.topic == TOPIC,
            begin,
            end,
            decoder_factories=[decoder],
        )
        return sum(1 for one in found if one.decoded_message is not None)


def mcap_package(path: Path, begin: int, end: int) -> int:
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        return sum(1 for _ in reader.iter_decoded_messages(TOPIC, begin, end))


def rosbags(path: Path, begin: int, end: int) -> int:
    with AnyReader([path]) as reader:
        wanted = [one for one in reader.connections if one.topic == TOPIC]
        count = 0
        for connection, _, raw in reader.messages(wanted, begin, end):
            reader.deserialize(raw, connection.msgtype)
            count += 1
        return count


def rerun(path: Path, begin: int, end: int) -> int:
    reader = McapReader(
        path,
        decoders=["ros2msg", "ros2_reflection"],
        include_topic_regex=[f"^{TOPIC}$"],
        start_time_ns=begin,
        end_time_ns=end,
    )
    return sum(chunk.num_rows for chunk in reader.stream())


STRONGEST = "Rerun McapReader"
CASES: dict[str, Callable[[Path, int, int], int]] = {
    STRONGEST: rerun,
    "small-mcap, decoded": small_mcap,
    "mcap, decoded": mcap_package,
    "rosbags, deserialised": rosbags,
    "ours": ours,
}
LOGS = {"5 min, 145 kB": (5, 145_000), "5 min, 14.5 kB": (5, 14_500), "50 min": (50, 14_500)}


def measure(path: Path, minutes: int, rounds: int) -> dict[str, list[float]]:
    """Return the CPU seconds of each case in each round, after one warm-up round."""
    begin = START_NS + minutes * 30 * SECOND_NS
    window = (begin, begin + SPAN_S * SECOND_NS)
    counts = {name: case(path, *window) for name, case in CASES.items()}
    if set(counts.values()) != {SPAN_S * 500}:
        raise SystemExit(f"expected {SPAN_S * 500} vectors: {counts}")
    print(f"vectors found: {counts}")
    taken: dict[str, list[float]] = {name: [] for name in CASES}
    for _ in range(rounds):
        for name, case in CASES.items():
            before = time.process_time()
            case(path, *window)
            taken[name].append(time.process_time() - before)
    return taken


def main() -> None:
    rounds = int(sys.argv[1]) if len(sys.argv) > 1 else 15
    if not (find_spec("small_mcap") and find_spec("mcap_ros2_support_fast")):
        # Licensed under the GPL, so not a dependency of this project.
        print("without small-mcap; to have it: pip install small-mcap mcap-ros2-support-fast")
        del CASES["small-mcap, decoded"]
    ours_s: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as folder:
        for label, (minutes, picture_bytes) in LOGS.items():
            path = Path(folder) / "log.mcap"
            write_log(path, minutes, picture_bytes)
            taken = measure(path, minutes, rounds)
            print(f"{label}: {path.stat().st_size / 1e6:.0f} MB, {rounds} rounds")
            for name, seconds in taken.items():
                ratios = "".join(
                    f"   x{statistics.median(a / b for a, b in pairs):.2f} of {against}"
                    for against in ("ours", STRONGEST)
                    for pairs in (zip(seconds, taken[against], strict=True),)
                )
                print(
                    f"  {name:22} {1e3 * statistics.median(seconds):7.2f} ms CPU "
                    f"[{1e3 * min(seconds):.2f}-{1e3 * max(seconds):.2f}]{ratios}"
                )
            ours_s[label] = statistics.median(taken["ours"])
            path.unlink()
    print(
        f"50 minutes / 5 minutes, same pictures: {ours_s['50 min'] / ours_s['5 min, 14.5 kB']:.2f}"
    )


if __name__ == "__main__":
    main()
