"""Cues from stored detections, and a detection run from the cache beside the first run.

Prints frames a second of the two-frame car rules from stored masks, and for a camera of simulated
pictures the time of a run that detects and of one that finds all in the cache.
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

from crosscue.detectors import rle
from crosscue.detectors.base import Detections
from crosscue.detectors.frame_cues import CuePass, Seen
from crosscue.detectors.registry import chosen
from crosscue.eval.detect_stage import detect_drive
from crosscue.replay.log import Selection, open_log
from crosscue.replay.run_folder import create
from crosscue.replay.vehicle import Vehicle

ROUNDS = 5
FRAMES = 1000
PICTURES = 40
VEHICLE = Vehicle(version=1)


def stored_frames() -> list[Detections]:
    """Five cars a frame, each with a mask of 120 by 45 pixels."""
    rng = np.random.default_rng(1)
    found = []
    for t in range(FRAMES):
        corners = np.column_stack([rng.integers(0, 1100, 5), rng.integers(300, 600, 5)])
        boxes = np.hstack([corners, corners + np.array([120, 45])]).astype(np.float64)
        mask = np.arange(45)[:, None] >= 20 - 15 * np.sin(np.arange(120)[None, :] / 40)
        masks = tuple(rle.encode(mask, (int(x), int(y)), (1280, 720)) for x, y in corners)
        row = Detections(t * 10**8, (1280, 720), boxes, np.full(5, 0.99), ("car",) * 5, masks)
        found.append(row)
    return found


def cue_seconds(found: list[Detections]) -> float:
    """One pass over all frames."""
    cues = CuePass(VEHICLE)
    began = time.perf_counter()
    for one in found:
        cues(Seen(one.t_ns, (one,)))
    return time.perf_counter() - began


def camera(folder: Path) -> Path:
    """Simulated JPEG pictures."""
    from support.sign_scenes import clutter

    folder.mkdir()
    for i in range(PICTURES):
        _, encoded = cv2.imencode(".jpg", clutter(i, (1280, 720)))
        (folder / f"{i:04}.jpg").write_bytes(encoded.tobytes())
    (folder / "timestamps.txt").write_text("rate_hz: 10\n")
    return folder


def detect_seconds(log_path: Path, run_path: Path, cache: Path) -> float:
    """One run of the sign detector."""
    run = create(run_path, overwrite=True)
    began = time.perf_counter()
    with open_log(log_path) as log:
        detect_drive([log], VEHICLE, run, Selection(), chosen("signs", {}), cache)
    return time.perf_counter() - began


def main() -> None:
    """Both subjects."""
    found = stored_frames()
    taken = median(cue_seconds(found) for _ in range(ROUNDS))
    print(f"car rules, 5 masks a frame: {FRAMES / taken:,.0f} frames a second")
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
