"""Estimate again from cached detections: drive time over run time.

The drive is a simulated ten-minute town drive (without scenes in its pictures) with a camera of 10
pictures per second, 150 kB each. Its stored detections are as dense as a busy street's: six objects
with masks per frame, two of them cars seen from the side. The timed work is ``crosscue estimate``
as a library call: reading the log's other topics, pose, cues, range and belief, and writing all
tables. Run it as ``python benchmarks/estimate.py [MINUTES]``.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import wraps
from pathlib import Path
from statistics import median
from typing import Any
from unittest.mock import patch

import numpy as np

from crosscue.datasets.simulated.drive import DriveSettings, sense, true_motion, vehicle_text
from crosscue.datasets.simulated.log_files import BUS, GYRO, MAGNETOMETER, sensor_blocks
from crosscue.detectors import rle
from crosscue.detectors.base import Detections, DetectorChoice, Found, Frame, View
from crosscue.detectors.catalog.known_models import OBJECTS, ROAD
from crosscue.detectors.cues.road_area import RoadArea
from crosscue.detectors.cues.road_openings import RoadOpenings
from crosscue.detectors.cues.tracked.motion import Windows
from crosscue.detectors.images import Encoded, decode
from crosscue.detectors.networks.box_model import BoxModel
from crosscue.detectors.networks.picture_input import prepared
from crosscue.detectors.ranging import object_tracks
from crosscue.detectors.registry import make
from crosscue.eval.drives.demo import fetch_drive
from crosscue.eval.drives.replay import choices_for
from crosscue.eval.pipeline.detecting import Detecting
from crosscue.eval.pipeline.whole_run import detect_drive, estimate_run, replay_drive
from crosscue.eval.runs.drive import Drive
from crosscue.eval.runs.folder import RunFolder, create, open_run
from crosscue.replay.columns import Block, Images, Messages, Topic
from crosscue.replay.ledger import Ledger
from crosscue.replay.logs.opening import open_log
from crosscue.replay.vehicle.vehicle import load, parse
from crosscue.replay.write.convert import LogWriter

ROUNDS = 5
PICTURE_BYTES = 150_000
CAMERA = Topic("/camera", "crosscue/Images", "columns")
SIZE = (1280, 720)
SECONDS_PER_BLOCK = 15.0
STAYS_NS = 3_000_000_000
LABELS = ("car", "car", "car", "car", "stop sign", "traffic light")
RANGES = """
[ranges.stop_sign]
parameters = [800.0]
residual_sd_m = 1.7
[ranges.traffic_light]
parameters = [1000.0]
residual_sd_m = 5.9
"""


class Busy:
    """Detector that returns six objects with masks in every frame and ignores the picture."""

    view = View(min_width_px=64)
    identity = "busy 1"

    def __call__(self, frames: Sequence[Frame], /) -> Sequence[Found]:
        """Return random objects of each frame, seeded by its time."""
        return [self._of(frame) for frame in frames]

    def _of(self, frame: Frame) -> Found:
        # Each object stays for some seconds and moves slightly, so that cars are matched again.
        rng = np.random.default_rng(frame.t_ns // STAYS_NS)
        corner = np.column_stack([rng.integers(0, 1100, 6), rng.integers(100, 600, 6)])
        corner[:, 0] += frame.t_ns % STAYS_NS * 50 // STAYS_NS
        size = np.array([(120, 45), (120, 45), (90, 80), (60, 52), (30, 31), (14, 34)])
        boxes = np.hstack([corner, corner + size]).astype(np.float64)
        masks = tuple(
            rle.encode_mask(_outline(w, h), (int(x), int(y)), SIZE)
            for (x, y), (w, h) in zip(corner, size.tolist(), strict=True)
        )
        return Detections(frame.t_ns, SIZE, boxes, np.full(6, 0.99), LABELS, masks)


def _outline(width: int, height: int) -> np.ndarray[tuple[int, int], np.dtype[np.bool_]]:
    top = 0.45 - 0.33 * np.sin(np.arange(width)[None, :] / 40)
    shape: np.ndarray[tuple[int, int], np.dtype[np.bool_]] = (
        np.arange(height)[:, None] >= top * height
    )
    return shape


def build() -> Busy:
    """Build the detector; the function that ``--detectors`` names."""
    return Busy()


def pictures(times: np.ndarray[tuple[int], np.dtype[np.int64]]) -> Block:
    """Return a grey JPEG for each time, padded to a typical size with incompressible noise."""
    import cv2

    _, coded = cv2.imencode(".jpg", np.full((SIZE[1], SIZE[0], 3), 128, np.uint8))
    head, rest = coded.tobytes()[:2], coded.tobytes()[2:]
    rng = np.random.default_rng(int(times[0]))
    count = 1 + (PICTURE_BYTES - len(rest)) // 60_000
    mark = b"\xff\xfe" + (60_000 + 2).to_bytes(2, "big")
    each = [head + b"".join(mark + rng.bytes(60_000) for _ in range(count)) + rest for _ in times]
    length = len(each[0])
    start = np.arange(len(times), dtype=np.int64) * length
    messages = Messages(np.frombuffer(b"".join(each), np.uint8), start, start + length)
    return Block(CAMERA.name, times, Images(messages, ("jpeg",) * len(times)), header_ns=times)


def write_log(path: Path, settings: DriveSettings) -> float:
    """Write the log and return its length in seconds."""
    motion = true_motion(settings)
    first, last = int(motion.t_ns[0]), int(motion.t_ns[-1])
    with LogWriter(path, Ledger(str(path))) as writer:
        for topic in (BUS, GYRO, MAGNETOMETER, CAMERA):
            writer.add_topic(topic)
        sensors = sensor_blocks(sense(motion, settings), settings.seed)
        at = first
        for block in sensors:
            stop = int(block.log_ns[-1])
            if stop - at > 1_000_000_000:
                writer.write(pictures(np.arange(at, stop, 100_000_000, dtype=np.int64)))
                at = stop
            writer.write(block)
    return (last - first) * 1e-9


def estimated(run: RunFolder, seconds: float) -> None:
    """Print how long it takes to estimate a run again, after a first time that imports."""
    taken, cpu = [], []
    for _ in range(1 + ROUNDS):
        began, began_cpu = time.perf_counter(), time.process_time()
        estimate_run(open_run(run.path))
        taken.append(time.perf_counter() - began)
        cpu.append(time.process_time() - began_cpu)
    print(
        f"estimate: {median(taken[1:]):.2f} s wall, {median(cpu[1:]):.2f} s CPU; "
        f"{seconds / median(cpu[1:]):.1f} times real time (CPU)"
    )


@contextmanager
def counted(seconds: dict[str, float]) -> Iterator[None]:
    """Add the CPU time of the computations that every frame needs, by their name."""
    parts: tuple[tuple[Any, str, str], ...] = (
        (RoadArea, "see", "road area"),
        (RoadArea, "plan", "road area"),
        (RoadOpenings, "__call__", "road area"),
        (object_tracks, "range_from_motion", "ranges from motion"),
        (Windows, "__init__", "motion of cars"),
        (Windows, "motions", "motion of cars"),
    )

    def timed(function: Callable[..., Any], part: str) -> Callable[..., Any]:
        @wraps(function)
        def call(*given: Any, **named: Any) -> Any:
            began = time.process_time()
            try:
                return function(*given, **named)
            finally:
                seconds[part] = seconds.get(part, 0.0) + time.process_time() - began

        return call

    with ExitStack() as stack:
        for owner, name, part in parts:
            stack.enter_context(patch.object(owner, name, timed(getattr(owner, name), part)))
        yield


def real(source: str | None) -> None:
    """Time PandaSet 002, and its replay with yolox-nano against the bare network."""
    known = fetch_drive(source, with_road=True)
    vehicle = load(known.vehicle)
    with tempfile.TemporaryDirectory() as name, open_log(known.log) as log:
        drive = Drive([log], vehicle)
        everything = Detecting(choices_for(vehicle, f"{OBJECTS},{ROAD}"))
        run = create(Path(name) / "run", overwrite=False)
        outcome = replay_drive(drive, run, everything)
        print(f"PandaSet 002, {outcome.drive_seconds:.1f} s, with road, lights and cars")
        estimated(run, outcome.drive_seconds)
        parts: dict[str, float] = {}
        with counted(parts):
            estimate_run(open_run(run.path))
        print(", ".join(f"{part} {used:.2f} s" for part, used in parts.items()))
        print(
            f"these alone: {outcome.drive_seconds / sum(parts.values()):.1f} times real time (CPU)"
        )
        (choice,) = choices_for(vehicle, OBJECTS)
        detector = make(choice)
        assert isinstance(detector, BoxModel)
        given = detector.card.input
        batch = np.zeros((1, 3, given.height_px, given.width_px), np.float32)
        files = sorted(path for path in Path(known.log).rglob("*.jpg"))
        ratios, least = [], []
        for number in range(3):
            assert outcome.scene is not None
            began = time.process_time()
            for _ in range(outcome.scene.frames):
                detector.network(batch)
            bare = time.process_time() - began
            began = time.process_time()
            for file in files[: outcome.scene.frames]:
                picture = Encoded("jpeg", memoryview(file.read_bytes()), None)
                prepared(decode(picture, detector.view)[0], given)
            least.append(1.0 + (time.process_time() - began) / bare)
            began = time.process_time()
            replay_drive(
                drive, create(Path(name) / f"{number}", overwrite=False), Detecting((choice,))
            )
            ratios.append((time.process_time() - began) / bare)
            print(f"bare network {bare:.2f} s CPU, replay {ratios[-1]:.2f} times as much")
        print(f"replay with {OBJECTS}: {median(ratios):.2f} times the bare network")
        print(f"with its pictures decoded and resized alone: {median(least):.2f} times")


def main() -> None:
    """Write the drive once and estimate it several times."""
    if sys.argv[1:2] == ["--real"]:
        real(sys.argv[2] if len(sys.argv) > 2 else None)
        return
    minutes = float(sys.argv[1]) if len(sys.argv) > 1 else 10.0
    settings = DriveSettings(blocks=max(4, round(minutes * 60.0 / SECONDS_PER_BLOCK)))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        seconds = write_log(folder / "drive.mcap", settings)
        dbc = Path(__file__).parent.parent / "datasets" / "simulated" / "simulated_car.dbc"
        vehicle = parse(vehicle_text(settings, str(dbc)) + RANGES, "benchmark")
        choice = DetectorChoice("busy", f"{__name__}:build")
        run = create(folder / "run", overwrite=False)
        with open_log(folder / "drive.mcap") as log:
            detect_drive(Drive([log], vehicle), run, Detecting((choice,)))
        size = (folder / "drive.mcap").stat().st_size
        print(f"simulated drive of {seconds:.0f} s, {size / 1e6:.0f} MB")
        estimated(run, seconds)


if __name__ == "__main__":
    main()
