"""Calls as users write them, each next to the strongest peer in the same run, in CPU seconds.

    python -m benchmarks.calls [info|drive|catalog|http|window|mcap|db3|video ...]

Commands run as processes, user and system time together, the median of seven. Calls run in turn
in this process, and ratios are medians over the rounds. Logs are those of ``window_reading.py``
(2 s of one topic of 5 minutes, 700 MB), ``mcap_reading.py`` (1 minute) and ``bag_reading.py``
(30 s), a video of 600 pictures of 1280 x 720, and runs that are copies of one short scored drive.
Where a call cannot be faster than a part of it, that part is printed, too: NumPy's import in every
command, reading and checksums of an MCAP.
"""

from __future__ import annotations

import os
import shutil
import statistics
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import av
import cv2
import numpy as np
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

import crosscue
from benchmarks.bag_reading import theirs, write_db3
from benchmarks.window_reading import (
    SECOND_NS,
    SPAN_S,
    START_NS,
    TOPIC,
    VECTOR_TEXT,
    vector,
    write_log,
)

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from support.gap_drive import Clock, write_drive
from support.range_server import serving

ROUNDS = 7
RUNS = 10_000
MIDDLE_S = 150
Work = Callable[[], int]


def command(label: str, *words: str, program: str = "crosscue") -> None:
    """Print the CPU seconds of a command."""
    # As installed: with the modules compiled.
    env = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    spent = []
    for _ in range(ROUNDS + 1):
        before = sum(os.times()[2:4])
        subprocess.run([program, *words], check=True, stdout=subprocess.DEVNULL, env=env)
        spent.append(sum(os.times()[2:4]) - before)
    # The first one compiles.
    del spent[0]
    print(f"{label}: {statistics.median(spent):.2f} s [{min(spent):.2f}-{max(spent):.2f}]")


def compare(label: str, cases: dict[str, Work]) -> None:
    """Print each case's median CPU time, and as how many of the first.

    A case that returns 0 does a part of the work.
    """
    counts = {name: work() for name, work in cases.items()}
    assert len(set(counts.values()) - {0}) == 1, counts
    spent: dict[str, list[float]] = {name: [] for name in cases}
    for _ in range(ROUNDS):
        for name, work in cases.items():
            before = time.process_time()
            work()
            spent[name].append(time.process_time() - before)
    ours, *_ = spent.values()
    for name, seconds in spent.items():
        ratio = statistics.median(a / b for a, b in zip(seconds, ours, strict=True))
        print(
            f"{label}: {name:24} {1e3 * statistics.median(seconds):8.2f} ms   x{ratio:.2f} of ours"
        )


def info(folder: Path) -> None:
    short = folder / "ten.mcap"
    with short.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2")
        schema = writer.register_schema(
            "geometry_msgs/msg/Vector3Stamped", "ros2msg", VECTOR_TEXT.encode()
        )
        channel = writer.register_channel(TOPIC, "cdr", schema)
        for i in range(10):
            t_ns = START_NS + i * 2_000_000
            writer.add_message(channel, t_ns, vector(t_ns, i), t_ns)
        writer.finish()  # type: ignore[no-untyped-call]
    command("info, ten rows", "info", str(short))
    command("info --quick, 700 MB", "info", "--quick", str(_long(folder)))
    command("of which Python and NumPy", "-c", "import numpy", program=sys.executable)


def drive(folder: Path) -> None:
    log = write_drive(folder / "tiny", Clock())
    words = ("--vehicle", str(log.with_name("car.toml")), "-o", str(folder / "run"), "--overwrite")
    command(
        "replay, 14 s without detectors", "replay", str(log), *words, "--detectors", "none", "-q"
    )


def catalog(folder: Path) -> None:
    log = write_drive(folder / "scored", Clock())
    vehicle, run = log.with_name("car.toml"), folder / "one"
    text = vehicle.read_text(encoding="utf-8")
    vehicle.write_text(text.partition("[detectors")[0], encoding="utf-8")
    words = ("--vehicle", str(vehicle), "-o", str(run), "-q")
    subprocess.run(["crosscue", "replay", str(log), *words], check=True)
    truth = str(log.with_name("truth.json"))
    subprocess.run(
        ["crosscue", "score", str(run), "--truth", truth, "--without-figures", "-q"], check=True
    )
    fleet = folder / "fleet"
    for number in range(RUNS):
        copy = fleet / f"{number % 100:02}" / f"drive-{number:05}"
        shutil.copytree(run, copy, copy_function=os.link)
    before = time.process_time()
    found = crosscue.catalog(fleet)
    spent = time.process_time() - before
    assert found.query("select count(*) as n from runs")["n"].to_pylist() == [RUNS]
    print(f"catalog, index of {RUNS:,} scored runs: {spent:.1f} s", flush=True)


def _long(folder: Path) -> Path:
    path = folder / "long.mcap"
    if not path.exists():
        write_log(path, 5, 145_000)
    return path


def _seconds_of(place: Path | str) -> int:
    with crosscue.open(place) as log:
        return len(log[TOPIC].table(MIDDLE_S, MIDDLE_S + SPAN_S))


def window(folder: Path) -> None:
    path = _long(folder)
    begin = START_NS + MIDDLE_S * SECOND_NS
    cases: dict[str, Work] = {"log[topic].table()": lambda: _seconds_of(path)}
    if find_spec("small_mcap"):
        # Licensed under the GPL, so not a dependency of this project.
        cases["small-mcap, struct by hand"] = lambda: _by_hand(path, begin)
    else:
        print("without small-mcap; to have it: pip install small-mcap")
    compare("2 s of one topic, 700 MB", cases)


def _by_hand(path: Path, begin: int) -> int:
    rows = []
    with path.open("rb") as stream:
        found = import_module("small_mcap").read_message(
            stream, lambda channel, _: channel.topic == TOPIC, begin, begin + SPAN_S * SECOND_NS
        )
        for _, _, message in found:
            (size,) = struct.unpack_from("<I", message.data, 12)
            rows.append(struct.unpack_from("<ddd", message.data, 4 + (12 + size + 7) // 8 * 8))
    return len(rows)


def http(folder: Path) -> None:
    path = _long(folder)
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    begin, end = (START_NS + at * SECOND_NS for at in (MIDDLE_S, MIDDLE_S + SPAN_S))
    chunks = summary.chunk_indexes
    after = max(
        one.chunk_start_offset + one.chunk_length + one.message_index_length for one in chunks
    )
    needed = (
        path.stat().st_size
        - after
        + sum(
            one.chunk_length + one.message_index_length
            for one in chunks
            if one.message_start_time < end and one.message_end_time >= begin
        )
    )
    with serving() as web:
        web.files["log.mcap"] = path.read_bytes()
        assert _seconds_of(f"{web.base}/log.mcap") == SPAN_S * 500
        print(f"the same by HTTP: {web.sent / needed:.3f} times the {needed:,} bytes needed")


def mcap(folder: Path) -> None:
    from benchmarks.mcap_reading import bare_checked, ours_batches, rerun
    from benchmarks.mcap_reading import write_log as write_minute

    for compression in CompressionType:
        path = folder / f"{compression.name.lower()}.mcap"
        write_minute(path, compression)
        cases: dict[str, Work] = {
            "log.batches()": partial(ours_batches, path),
            "Rerun": partial(rerun, path),
            "reading, inflating, CRC": partial(bare_checked, path),
        }
        compare(f"MCAP, 1 minute, {path.stem}", cases)
        path.unlink()


def db3(folder: Path) -> None:
    path = write_db3(folder / "db3", 30)

    def ours() -> int:
        with crosscue.open(path) as log:
            return sum(rows.num_rows for _, rows in log.batches())

    cases: dict[str, Work] = {
        "log.batches()": ours,
        "rosbags, objects": lambda: theirs(path, True),
    }
    compare(".db3, 30 s", cases)


def video(folder: Path) -> None:
    path = folder / "video.mp4"
    noise = np.random.default_rng(0).integers(0, 255, (90, 160, 3), np.uint8)
    scene = cv2.resize(noise, (1600, 900), interpolation=cv2.INTER_CUBIC)
    with av.open(str(path), "w") as out:
        stream = out.add_stream("libx264", rate=20)
        stream.width, stream.height, stream.pix_fmt = 1280, 720, "yuv420p"
        for i in range(600):
            part = np.ascontiguousarray(scene[i % 100 : i % 100 + 720, i % 200 : i % 200 + 1280])
            out.mux(
                stream.encode(av.VideoFrame.from_ndarray(part.astype(np.uint8), format="rgb24"))
            )
        out.mux(stream.encode(None))

    def ours() -> int:
        with crosscue.open(path) as log:
            frames = (frame for topic in log.topics.values() for frame in topic.frames())
            return sum(1 for frame in frames if frame.rgb.ndim == 3)

    def pyav() -> int:
        with av.open(str(path)) as source:
            return sum(
                1 for frame in source.decode(video=0) if frame.to_ndarray(format="rgb24").ndim
            )

    compare("H.264, 600 pictures", {"frame.rgb": ours, "PyAV": pyav})


CASES: dict[str, Callable[[Path], None]] = {
    "info": info, "drive": drive, "catalog": catalog, "window": window, "http": http,
    "mcap": mcap, "db3": db3, "video": video,
}  # fmt: skip


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as place:
        for chosen in sys.argv[1:] or CASES:
            CASES[chosen](Path(place))
