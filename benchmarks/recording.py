"""Record a run for Rerun: ours in bulk columns next to logging frame by frame, in one run.

    python benchmarks/recording.py [MINUTES]

The drive is a simulated town drive (without scenes in its pictures) with 10 pictures of 150 kB per
second and six masked objects in each, as in ``estimate.py``. The peer follows Rerun's tutorials: it
sets the time and logs the picture, boxes with labels, masks as a segmentation image, beliefs and
ranges, frame by frame. Unlike ours, it draws neither map, plan, cars, regions nor cues. The cases
alternate, and ratios are taken round by round. Our peak memory is printed for the drive and for one
twice as long, each in a separate process; it should hardly grow.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median

import numpy as np
import rerun as rr
from estimate import (  # type: ignore[import-not-found]  # a script next to this one
    RANGES,
    SECONDS_PER_BLOCK,
    write_log,
)

from crosscue.datasets.simulated.drive import DriveSettings, vehicle_text
from crosscue.detectors import rle
from crosscue.detectors.base import DetectorChoice
from crosscue.detectors.images import Encoded
from crosscue.eval.pipeline.detecting import Detecting
from crosscue.eval.pipeline.whole_run import detect_drive, estimate_run
from crosscue.eval.recording import save_rrd
from crosscue.eval.runs.drive import Drive
from crosscue.eval.runs.folder import RunFolder, create, open_run
from crosscue.eval.runs.stored_images import read_pictures, run_camera
from crosscue.eval.runs.tables.stored_frames import stored_frames
from crosscue.replay.logs.opening import open_log
from crosscue.replay.vehicle.vehicle import parse

ROUNDS = 5
CLASSES = {"car": 1, "stop sign": 2, "traffic light": 3}
MEMORY = """
import sys
from pathlib import Path
from crosscue.eval.recording import save_rrd
from crosscue.eval.runs.folder import open_run
save_rrd(open_run(Path(sys.argv[1])), Path(sys.argv[2]))
status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
print(int(status["VmHWM"].split()[0]) // 1024)
"""


def make_run(folder: Path, minutes: float) -> tuple[RunFolder, float]:
    """Return a finished run and the length of its drive in seconds."""
    settings = DriveSettings(blocks=max(4, round(minutes * 60.0 / SECONDS_PER_BLOCK)))
    folder.mkdir()
    seconds = write_log(folder / "drive.mcap", settings)
    dbc = Path(__file__).parent.parent / "datasets" / "simulated" / "simulated_car.dbc"
    vehicle = parse(vehicle_text(settings, str(dbc)) + RANGES, "benchmark")
    run = create(folder / "run", overwrite=False)
    with open_log(folder / "drive.mcap") as log:
        busy = Detecting((DetectorChoice("busy", "estimate:build"),))
        detect_drive(Drive([log], vehicle), run, busy)
    estimate_run(open_run(run.path))
    return run, seconds


def picture_bytes(run: RunFolder) -> int:
    """Return the total bytes of all JPEGs."""
    total = 0

    def add(t_ns: int, encoded: Encoded) -> None:
        nonlocal total
        total += len(encoded.content)

    camera = run_camera(run)
    assert camera is not None
    read_pictures(camera, add)
    return total


def frame_by_frame(run: RunFolder, path: Path) -> None:
    """Record frame by frame, as in Rerun's tutorials."""
    recording = rr.RecordingStream("naive")
    recording.save(path)

    def picture(t_ns: int, encoded: Encoded) -> None:
        recording.set_time("drive", timestamp=np.datetime64(t_ns, "ns"))
        content = bytes(encoded.content)
        recording.log("camera", rr.EncodedImage(contents=content, media_type="image/jpeg"))

    camera = run_camera(run)
    assert camera is not None
    read_pictures(camera, picture)
    detected = run.drive_manifest().detected
    assert detected is not None
    for frame in stored_frames(run, detected, detected.settings):
        recording.set_time("drive", timestamp=np.datetime64(frame.t_ns, "ns"))
        for found in frame.objects:
            classes = np.zeros(found.size_px[::-1], np.uint8)
            for label, mask in zip(found.labels, found.masks, strict=True):
                classes[rle.decode_mask(mask, found.size_px)] = CLASSES[label]
            labels = [f"{a} {b:.2f}" for a, b in zip(found.labels, found.scores, strict=True)]
            boxes = rr.Boxes2D(
                array=found.boxes_px, array_format=rr.Box2DFormat.XYXY, labels=labels
            )
            recording.log("camera/boxes", boxes)
            recording.log("camera/masks", rr.SegmentationImage(classes))
    for table, names in (
        ("belief", ("intersection", "left", "right", "straight")),
        ("range", ("range_m",)),
        ("pose", ("x_m", "y_m", "speed_mps", "major_axis_m")),
    ):
        for row in run.table(table).to_pylist():
            recording.set_time("drive", timestamp=np.datetime64(row["t_ns"], "ns"))
            for name in names:
                recording.log(f"{table}/{name}", rr.Scalars(row[name]))
    recording.flush()
    recording.disconnect()


def main() -> None:
    """Write the drive once and record it several times both ways."""
    minutes = float(sys.argv[1]) if len(sys.argv) > 1 else 2.0
    cases: dict[str, Callable[[RunFolder, Path], None]] = {
        "crosscue, bulk columns": save_rrd,
        "frame by frame": frame_by_frame,
    }
    with tempfile.TemporaryDirectory() as name:
        run, seconds = make_run(Path(name) / "one", minutes)
        jpegs = picture_bytes(run)
        taken: dict[str, list[float]] = {case: [] for case in cases}
        sizes: dict[str, int] = {}
        for _ in range(ROUNDS):
            for case, record in cases.items():
                path = Path(name) / "drive.rrd"
                began = time.perf_counter()
                record(run, path)
                taken[case].append(time.perf_counter() - began)
                sizes[case] = path.stat().st_size
        print(f"simulated drive of {seconds:.0f} s, {jpegs / 1e6:.1f} MB of JPEG; {ROUNDS} rounds")
        print(f"{'':24}{'wall s':>8}{'x real time':>13}{'file / JPEGs':>14}{'against ours':>14}")
        ours = taken["crosscue, bulk columns"]
        for case, times in taken.items():
            ratio = median(a / b for a, b in zip(times, ours, strict=True))
            print(
                f"{case:24}{median(times):8.2f}{seconds / median(times):13.0f}"
                f"{sizes[case] / jpegs:14.3f}{ratio:14.2f}"
            )
        twice, longer = make_run(Path(name) / "two", 2.0 * minutes)
        for one, length in ((run, seconds), (twice, longer)):
            reported = subprocess.run(
                [sys.executable, "-c", MEMORY, str(one.path), str(Path(name) / "m.rrd")],
                capture_output=True,
                text=True,
                check=True,
            )
            print(f"peak memory over {length:.0f} s of drive: {reported.stdout.strip()} MiB")


if __name__ == "__main__":
    main()
