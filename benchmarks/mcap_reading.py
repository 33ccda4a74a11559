"""Read a ROS 2 MCAP drive: ours next to Rerun, rosbags, mcap and bare decompression.

    python benchmarks/mcap_reading.py [rounds]            # speed
    python benchmarks/mcap_reading.py memory [megabytes]  # peak memory, 200 MB against 2 GB

The drive has one minute of 900 camera pictures (JPEG of synthetic scenes, 145 kB each), 135,468
real CAN frames (comma2k19) and 30,000 small frames, in 1 MiB chunks. Ours verifies every checksum.
Rerun's ``McapReader`` (which decodes all messages to Arrow), rosbags and bare decompression verify
none. The cases alternate, and ratios are taken round by round, of wall time and of CPU time over
all threads. The recording is in $CROSSCUE_DATA or ../shared/data.
"""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import cv2
import lz4.frame
import numpy as np
import zstandard
from isal.isal_zlib import crc32
from mcap.reader import NonSeekingReader
from mcap.writer import CompressionType, Writer
from rerun.chunk import McapReader
from rosbags.highlevel import AnyReader

import crosscue
from crosscue.replay.ledger import Ledger
from crosscue.replay.limits import DEFAULT_LIMITS
from crosscue.replay.readers.mcap.bytes import ByteFile
from crosscue.replay.readers.mcap.channels import TopicBook
from crosscue.replay.readers.mcap.reader import McapLog
from crosscue.replay.readers.mcap.segments import find_segments
from crosscue.replay.readers.mcap.walk import UnreadChunk, Walk

DATA = Path(os.environ.get("CROSSCUE_DATA", Path(__file__).parents[2] / "shared" / "data"))
RAW_CAN = (
    DATA / "comma2k19/Example_1/b0c9d2329ad1606b_2018-08-02--08-34-47/40/processed_log/CAN/raw_can"
)
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
FRAME_TEXT = f"""std_msgs/Header header
uint32 id
bool is_rtr
bool is_extended
bool is_error
uint8 dlc
uint8[8] data
{HEADER_TEXT.strip()}
"""
PICTURE_TEXT = f"""std_msgs/Header header
string format
uint8[] data
{HEADER_TEXT.strip()}
"""
PICTURES, SMALL, SCENES = 900, 30_000, 40
START_NS = 1_533_200_000_000_000_000
MINUTE_NS = 60_000_000_000


def frames(address: np.ndarray, payload: np.ndarray, t_ns: np.ndarray, frame: bytes) -> list[bytes]:
    """Return can_msgs/Frame messages in CDR, one per row."""
    head = np.zeros(
        len(t_ns),
        dtype=[
            ("cdr", "S4"),
            ("sec", "<i4"),
            ("nanosec", "<u4"),
            ("size", "<u4"),
            ("frame", "S8"),
            ("id", "<u4"),
            ("flags", "u1", 3),
            ("dlc", "u1"),
            ("payload", "u1", 8),
        ],
    )
    head["cdr"], head["frame"], head["size"] = b"\x00\x01\x00\x00", frame, len(frame) + 1
    head["sec"], head["nanosec"] = t_ns // 10**9, t_ns % 10**9
    head["id"], head["dlc"], head["payload"] = address, 8, payload
    head["flags"][:, 1] = address > 0x7FF
    coded, width = head.tobytes(), head.dtype.itemsize
    return [coded[i : i + width] for i in range(0, len(coded), width)]


def pictures(count: int) -> Iterator[bytes]:
    """Yield sensor_msgs/CompressedImage in CDR; scenes repeat after more than two seconds."""
    scenes = [scene(seed) for seed in range(SCENES)]
    for i in range(count):
        head = b"\x00\x01\x00\x00" + np.array([i, 0, 4], dtype="<u4").tobytes() + b"cam\x00"
        head += np.array([5], dtype="<u4").tobytes() + b"jpeg\x00\x00\x00\x00"
        coded = scenes[i % SCENES]
        yield head + np.array([len(coded)], dtype="<u4").tobytes() + coded


def scene(seed: int) -> bytes:
    """Return a JPEG of 1280 x 720 with structure of all sizes and some noise."""
    rng = np.random.default_rng(seed)
    picture = np.full((720, 1280, 3), 128.0, dtype=np.float32)
    for size in (4, 16, 64, 256):
        coarse = rng.normal(size=(720 // size + 2, 1280 // size + 2, 3)).astype(np.float32)
        picture += 6 * size**0.5 * cv2.resize(coarse, (1280, 720), interpolation=cv2.INTER_CUBIC)
    picture += 4 * rng.standard_normal(picture.shape, dtype=np.float32)
    pixels = np.clip(picture, 0, 255).astype(np.uint8)
    return bytes(cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, 80])[1])


def write_log(path: Path, compression: CompressionType, minutes: int = 1) -> None:
    """Write the drive described above, repeated ``minutes`` times."""
    column = {n: np.load(RAW_CAN / n, allow_pickle=False) for n in ("address", "data", "t")}
    payload = np.ascontiguousarray(column["data"]).view(np.uint8).reshape(-1, 8)
    seconds = column["t"] - column["t"][0]
    can_ns = START_NS + np.round(seconds / max(seconds[-1], 1.0) * 0.999 * MINUTE_NS).astype(
        np.int64
    )
    small_ns = START_NS + np.linspace(0, MINUTE_NS, SMALL, endpoint=False).astype(np.int64)
    ids = 0x700 + np.arange(SMALL) % 64
    noise = np.random.default_rng(5).integers(0, 256, (SMALL, 8), dtype=np.uint8)
    picture_ns = START_NS + np.linspace(0, MINUTE_NS, PICTURES, endpoint=False).astype(np.int64)
    with path.open("wb") as stream:
        writer = Writer(stream, compression=compression)
        writer.start(profile="ros2")
        picture = writer.register_schema(
            "sensor_msgs/msg/CompressedImage", "ros2msg", PICTURE_TEXT.encode()
        )
        frame = writer.register_schema("can_msgs/msg/Frame", "ros2msg", FRAME_TEXT.encode())
        channels = [
            writer.register_channel(topic, "cdr", schema)
            for topic, schema in (("/camera", picture), ("/can", frame), ("/mobileye", frame))
        ]
        for minute in range(minutes):
            shift = minute * MINUTE_NS
            rows = [(int(t), 0, one) for t, one in zip(picture_ns, pictures(PICTURES), strict=True)]
            for k, t_ns, coded in (
                (1, can_ns, frames(column["address"], payload, can_ns + shift, b"can0")),
                (2, small_ns, frames(ids, noise, small_ns + shift, b"eye0")),
            ):
                rows += [(int(t), k, one) for t, one in zip(t_ns, coded, strict=True)]
            rows.sort(key=lambda row: row[0])
            for i, (t, k, one) in enumerate(rows):
                writer.add_message(channels[k], t + shift, one, t + shift, i)
        writer.finish()  # type: ignore[no-untyped-call]


def ours(path: Path) -> int:
    with McapLog(path, DEFAULT_LIMITS) as log:
        return sum(len(block) for block in log.read(Ledger(str(path))))


def ours_batches(path: Path) -> int:
    with crosscue.open(path) as log:
        return sum(rows.num_rows for _, rows in log.batches())


def rerun(path: Path) -> int:
    reader = McapReader(path, decoders=["ros2msg", "ros2_reflection"])
    return sum(chunk.num_rows for chunk in reader.stream() if not chunk.is_static)


def rosbags(path: Path) -> int:
    count = 0
    with AnyReader([path]) as reader:
        for connection, _, raw in reader.messages():
            reader.deserialize(raw, connection.msgtype)
            count += 1
    return count


def rosbags_raw(path: Path) -> int:
    with AnyReader([path]) as reader:
        return sum(1 for _ in reader.messages())


def mcap_package(path: Path) -> int:
    with path.open("rb") as stream:
        reader = NonSeekingReader(stream, validate_crcs=True)
        return sum(1 for _ in reader.iter_messages(log_time_order=False))


def bare(path: Path, is_checked: bool = False) -> int:
    """Read and decompress every chunk on one thread, optionally with its checksum."""
    file = ByteFile(path)
    segment = find_segments(file, path, TopicBook(DEFAULT_LIMITS), DEFAULT_LIMITS)[0]
    inflater = zstandard.ZstdDecompressor()
    walk = Walk(
        file, segment.begin, segment.end, segment.known_chunks(file, DEFAULT_LIMITS), DEFAULT_LIMITS
    )
    for item in walk:
        if isinstance(item, UnreadChunk) and item.head is not None:
            body: bytes | memoryview = file.read(item.body_at, item.head.body_size).data
            if item.head.compression == "zstd":
                body = inflater.decompress(body)
            elif item.head.compression == "lz4":
                body = lz4.frame.decompress(body)
            if is_checked:
                crc32(body)
    file.close()
    return 0


def bare_checked(path: Path) -> int:
    return bare(path, is_checked=True)


CASES: dict[str, Callable[[Path], int]] = {
    "Rerun McapReader": rerun,
    "rosbags, deserialised": rosbags,
    "rosbags, raw": rosbags_raw,
    "mcap, CRCs verified": mcap_package,
    "ours, blocks": ours,
    "ours, log.batches()": ours_batches,
    "bare decompression": bare,
    "bare, with CRC-32": bare_checked,
}


# Reference of the ratios, number of digits, and True if higher is better.
AGAINST = (
    ("Rerun McapReader", 2, True),
    ("rosbags, deserialised", 1, True),
    ("bare decompression", 2, False),
)


def speed(rounds: int) -> None:
    with tempfile.TemporaryDirectory() as folder:
        for compression in CompressionType:
            path = Path(folder) / f"{compression.name.lower()}.mcap"
            write_log(path, compression)
            counts = {name: case(path) for name, case in CASES.items()}
            assert len(set(counts.values()) - {0}) == 1, counts
            took: dict[str, list[Took]] = {name: [] for name in CASES}
            for _ in range(rounds):
                for name, case in CASES.items():
                    took[name].append(timed(case, path))
            size = path.stat().st_size / 1e6
            print(f"\n{path.stem}: {size:.0f} MB, {counts['ours, blocks']} messages", flush=True)
            print(f"{'':24} {'':>22} {'x Rerun':>13} {'x rosbags':>13} {'x bare':>13} {'CPU':>7}")
            print(f"{'':24} {'s median [min-max]':>22} {'clock':>6} {'CPU':>6} ", end="")
            print(f"{'clock':>6} {'CPU':>6} {'clock':>6} {'CPU':>6} {'s':>7}")
            for name in CASES:
                wall = [one.wall_s for one in took[name]]
                span = f"{statistics.median(wall):.3f} [{min(wall):.3f}-{max(wall):.3f}]"
                ratios = " ".join(
                    f"{_ratio(above, below):>6.{digits}f}"
                    for against, digits, is_gain in AGAINST
                    for above, below in _pairs(took[against], took[name], is_gain=is_gain)
                )
                cpu = statistics.median(one.cpu_s for one in took[name])
                print(f"{name:24} {span:>22} {ratios} {cpu:>7.3f}")
            path.unlink()


class Took(NamedTuple):
    """Return the wall seconds and the CPU seconds of all threads."""

    wall_s: float
    cpu_s: float


def timed(case: Callable[[Path], int], path: Path) -> Took:
    wall, cpu = time.perf_counter(), time.process_time()
    case(path)
    return Took(time.perf_counter() - wall, time.process_time() - cpu)


def _pairs(
    peer: list[Took], own: list[Took], is_gain: bool
) -> Iterator[tuple[list[float], list[float]]]:
    """Yield the numerators and denominators of the ratios: wall times, then CPU times."""
    for k in range(2):
        theirs, ours_s = [one[k] for one in peer], [one[k] for one in own]
        yield (theirs, ours_s) if is_gain else (ours_s, theirs)


def _ratio(above: list[float], below: list[float]) -> float:
    return statistics.median(a / b for a, b in zip(above, below, strict=True))


def memory(megabytes: int) -> None:
    """Print the peak memory of processes that read a log of 200 MB and one of 2 GB."""
    with tempfile.TemporaryDirectory() as folder:
        for compression in CompressionType:
            added = []
            for size in (megabytes, 10 * megabytes):
                path = Path(folder) / "log.mcap"
                write_log(path, compression, max(1, round(size / 148)))
                call = [sys.executable, "-c", PEAK, str(path)]
                reported = subprocess.run(call, check=True, capture_output=True, text=True).stdout
                before, after = (int(kib) / 1024 for kib in reported.split())
                added.append(after - before)
                print(
                    f"{compression.name.lower():5} log of {path.stat().st_size / 1e6:5.0f} MB: "
                    f"peak {after:.1f} MiB, of which reading {added[-1]:.1f} MiB",
                    flush=True,
                )
                path.unlink()
            print(f"{'':5} the long one needs {added[1] - added[0]:+.1f} MiB")


PEAK = """
import sys
from pathlib import Path
from isal.isal_zlib import crc32
from crosscue.replay.ledger import Ledger
from crosscue.replay.logs.opening import open_log
import crosscue.replay.readers.mcap.reader

def peak():
    status = Path("/proc/self/status").read_text()
    return status.split("VmHWM:")[1].split()[0]

before = peak()
with open_log(sys.argv[1]) as log:
    last = 0
    for block in log.read(Ledger(sys.argv[1])):
        last = max(last, int(block.log_ns[-1]))
print(before, peak())
"""


if __name__ == "__main__":
    match sys.argv[1:]:
        case ["memory", *more]:
            memory(int(more[0]) if more else 200)
        case more:
            speed(int(more[0]) if more else 5)
