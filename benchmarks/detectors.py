"""Speed of cues from stored detections, of reduced decoding, and of the cache of detections.

Prints the frames per second of the two-frame car rules with stored masks (CPU time). For each
input width of a network, it compares reduced decoding of a JPEG of 1280 x 720 with full decoding
and resizing. For a camera with synthetic pictures, it compares a run that detects with one that
finds all results in the cache.
"""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path
from statistics import median

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from crosscue.datasets.scenes.drive import jpeg
from crosscue.datasets.scenes.rendering.render import Renderer
from crosscue.datasets.scenes.settings import SceneSettings, world_of
from crosscue.detectors import rle
from crosscue.detectors.base import Detections, View
from crosscue.detectors.cues.frame import CuePass
from crosscue.detectors.cues.observed import FrameDetections
from crosscue.detectors.images import Encoded, decode
from crosscue.detectors.registry import chosen
from crosscue.eval.pipeline.detecting import Detecting
from crosscue.eval.pipeline.whole_run import detect_drive
from crosscue.eval.runs.drive import Drive
from crosscue.eval.runs.folder import create
from crosscue.replay.logs.opening import open_log
from crosscue.replay.vehicle.vehicle import Vehicle

ROUNDS = 5
FRAMES = 1000
PICTURES = 40
WIDTHS = (160, 320, 480, 640, 1280)
VEHICLE = Vehicle(version=1)


def stored_frames() -> list[Detections]:
    """Return frames of five cars, each with a mask of 120 by 45 pixels."""
    rng = np.random.default_rng(1)
    found = []
    for t in range(FRAMES):
        corners = np.column_stack([rng.integers(0, 1100, 5), rng.integers(300, 600, 5)])
        boxes = np.hstack([corners, corners + np.array([120, 45])]).astype(np.float64)
        mask = np.arange(45)[:, None] >= 20 - 15 * np.sin(np.arange(120)[None, :] / 40)
        masks = tuple(rle.encode_mask(mask, (int(x), int(y)), (1280, 720)) for x, y in corners)
        row = Detections(t * 10**8, (1280, 720), boxes, np.full(5, 0.99), ("car",) * 5, masks)
        found.append(row)
    return found


def cue_seconds(found: list[Detections]) -> float:
    """Return the CPU seconds of one pass over all frames."""
    cues = CuePass(VEHICLE)
    began = time.process_time()
    for one in found:
        cues(FrameDetections(one.t_ns, (one,)))
    return time.process_time() - began


def decode_seconds() -> None:
    """Print CPU times of decoding for several network widths, ours and the peer alternating."""
    settings = SceneSettings("L800", 1)
    _, _, world = world_of(settings)
    shown = Renderer(world, settings.camera, settings.picture).picture(5.0)
    coded = jpeg(shown.rgb, settings.picture.jpeg_quality)
    picture = Encoded("jpeg", memoryview(coded))
    print(f"{'JPEG of 1280 x 720':22} {'decoded':>10} {'ours, ms':>9} {'full, ms':>9} {'ratio':>6}")
    for width in WIDTHS:
        taken: dict[str, list[float]] = {"ours": [], "full": []}
        for _ in range(ROUNDS * 4):
            began = time.process_time()
            ours, _ = decode(picture, View(min_width_px=width))
            taken["ours"].append(time.process_time() - began)
            size = (ours.shape[1], ours.shape[0])
            began = time.process_time()
            whole = cv2.imdecode(np.frombuffer(coded, np.uint8), cv2.IMREAD_COLOR)
            assert whole is not None
            if size != (1280, 720):
                cv2.resize(whole, size, interpolation=cv2.INTER_AREA)
            taken["full"].append(time.process_time() - began)
        own, full = (1e3 * median(seconds) for seconds in taken.values())
        name = f"for {width} px wide"
        print(f"{name:22} {size[0]:>10} {own:9.2f} {full:9.2f} {full / own:6.1f}")


def camera(folder: Path) -> Path:
    """Write a folder of simulated JPEG pictures."""
    from support.sign_scenes import clutter

    folder.mkdir()
    for i in range(PICTURES):
        _, encoded = cv2.imencode(".jpg", clutter(i, (1280, 720)))
        (folder / f"{i:04}.jpg").write_bytes(encoded.tobytes())
    (folder / "timestamps.txt").write_text("rate_hz: 10\n")
    return folder


def detect_seconds(log_path: Path, run_path: Path, cache: Path) -> float:
    """Return the seconds of one run of the sign detector."""
    run = create(run_path, overwrite=True)
    began = time.perf_counter()
    with open_log(log_path) as log:
        detect_drive(Drive([log], VEHICLE), run, Detecting(chosen("signs", {}), cache))
    return time.perf_counter() - began


def main() -> None:
    """Print the results of all three measurements."""
    cv2.setNumThreads(1)
    found = stored_frames()
    taken = median(cue_seconds(found) for _ in range(ROUNDS))
    print(f"car rules, 5 masks a frame: {FRAMES / taken:,.0f} frames a CPU second")
    decode_seconds()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        log = camera(folder / "camera")
        detect_seconds(log, folder / "warm", folder / "warm.sqlite")
        first, again = [], []
        for i in range(ROUNDS):
            cache = folder / f"cache{i}.sqlite"
            first.append(detect_seconds(log, folder / "run", cache))
            again.append(detect_seconds(log, folder / "run", cache))
    one, two = (1e3 * median(seconds) / PICTURES for seconds in (first, again))
    print(
        f"signs, 1280 x 720: {one:.1f} ms a picture; from the cache {two:.2f} ms; {one / two:.0f}x"
    )


if __name__ == "__main__":
    main()
