"""Steps of the camera's pitch or yaw, injected into pictures: found within 10 s, none elsewhere.

Run it as ``python -m benchmarks.camera_steps [DRIVE ...]``. The pictures of real drives
(``$CROSSCUE_DATA`` or ``../shared/data``) and of simulated approaches are warped from a moment on
as by a camera that turns by half a degree. Pictures later than ten seconds after the step are left
out. Real drives have no signals here; simulated ones have the wheel speeds and yaw rate of their
log, as in ``crosscue check``. The method was developed on the approaches of ``DEVELOPED``. Those of
``FRESH`` were named before it ran on them.
"""

from __future__ import annotations

import copy
import math
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final, NamedTuple

import cv2
import numpy as np

import crosscue
from benchmarks.real_roads import DATA, DRIVES
from crosscue.datasets.simulate import Approaches, simulate_approaches
from crosscue.eval.quality.drive import QualityDrive
from crosscue.eval.vehicle.check import read_samples
from crosscue.eval.vehicle.mounting import CarMotion, watch_mounting
from crosscue.eval.vehicle.picture_pass import ASSUMED_FOCAL, Follower, PicturePass, reduced
from crosscue.localization.camera_watch import MIN_MEASURED, MountingStep
from crosscue.replay.base import EVERYTHING
from crosscue.replay.columns import Bytes
from crosscue.replay.signals.kinds import Signal
from crosscue.replay.signals.plan import plan
from crosscue.replay.vehicle.camera import Camera
from crosscue.replay.vehicle.vehicle import load, parse

REAL: Final = (
    "kitti_t_junction", "pandaset_002", "kitti_right_turn", "kitti_red_light_queue",
    "camvid_0016e5_light", "highway_straight", "us_dashcam",
)  # fmt: skip
# Seed and layouts of simulated approaches.
DEVELOPED: Final = (0, "ABC")
FRESH: Final = (29_033, "ABCDEFGH")
STEP_DEG: Final = 0.5
WITHIN_S: Final = 10.0
# Parts of the directions of travel before the step; a simulated drive is long, and has one.
PARTS: Final = (0.5, 0.4, 0.6)


class Drive(NamedTuple):
    """Pictures of a camera, in grey, with their times."""

    name: str
    camera: Camera
    pictures: Sequence[tuple[int, Bytes]]
    motion: CarMotion = CarMotion(None, None)


def real(name: str) -> Drive:
    """Read the pictures of a real drive; where no focal length is known, one is assumed."""
    drive = DRIVES[name]
    files = sorted((DATA / "sequences" / drive.folder).glob(drive.pictures))
    grey = [np.asarray(one, np.uint8) for one in _read(files)][:: drive.cut[2]]
    pictures = [(round(i / drive.rate_hz * 1e9), one) for i, one in enumerate(grey)]
    known = drive.camera or f"focal_px = {ASSUMED_FOCAL * grey[0].shape[1]}"
    camera = parse(f"version = 1\n[camera]\n{known}", drive.folder).camera
    return Drive(name, camera, pictures)


def _read(files: Sequence[Path]) -> Iterator[Bytes]:
    """Yield pictures, or those of a video, in grey."""
    if len(files) > 1:
        yield from (
            np.asarray(cv2.imread(str(one), cv2.IMREAD_GRAYSCALE), np.uint8) for one in files
        )
        return
    video = cv2.VideoCapture(str(files[0]))
    while (found := video.read())[0]:
        yield np.asarray(cv2.cvtColor(found[1], cv2.COLOR_BGR2GRAY), np.uint8)


def simulated(layout: str, seed: int) -> Drive:
    """Simulate an approach."""
    with tempfile.TemporaryDirectory() as folder:
        approach = Approaches((layout,), seed=seed, width_px=960)
        place = simulate_approaches(approach, folder)[0].log.parent
        vehicle = load(place / "vehicle.toml")
        with crosscue.open(place / "drive.mcap") as log:
            topic = next(one for one in log.topics if "image" in one)
            pictures = [
                (frame.t_ns, np.asarray(cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY), np.uint8))
                for frame in log[topic].frames()
            ]
            planned = plan([(0, topic) for topic in log.logs[0].topics], vehicle)
            samples = read_samples(log.logs, vehicle, planned, EVERYTHING)
    signals = QualityDrive(vehicle, (), samples, planned)
    motion = CarMotion(signals.series(Signal.WHEEL_SPEEDS), signals.series(Signal.YAW_RATE))
    return Drive(f"seed {seed} {layout}", vehicle.camera, pictures, motion)


def turned(grey: Bytes, camera: Camera, axis: str, by_deg: float) -> Bytes:
    """Return the picture of a camera that is turned down (pitch) or to the left (yaw)."""
    assert camera.focal_px is not None
    center_px = camera.center_px or (0.5 * grey.shape[1], 0.5 * grey.shape[0])
    matrix = np.array(
        [[camera.focal_px, 0, center_px[0]], [0, camera.focal_px, center_px[1]], [0, 0, 1.0]]
    )
    cos, sin = math.cos(math.radians(by_deg)), math.sin(math.radians(by_deg))
    turn = np.array(
        [[1.0, 0, 0], [0, cos, -sin], [0, sin, cos]]
        if axis == "pitch"
        else [[cos, 0, sin], [0, 1.0, 0], [-sin, 0, cos]]
    )
    warp = matrix @ turn @ np.linalg.inv(matrix)
    size = (grey.shape[1], grey.shape[0])
    moved = cv2.warpPerspective(grey, warp, size, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(moved, np.uint8)


class Watch(NamedTuple):
    """Steps that are found, and the directions of travel."""

    steps: list[MountingStep]
    follower: Follower


def watched(drive: Drive, until_ns: int | None = None) -> Watch:
    """Watch the pictures of a drive, or those before a time."""
    start = drive.pictures[0][1]
    follower = Follower(drive.camera, (start.shape[1], start.shape[0]), reduced(start))
    for t_ns, grey in drive.pictures:
        if until_ns is None or t_ns < until_ns:
            follower.follow(t_ns, reduced(grey))
    return Watch(_steps(drive, follower), follower)


def stepped(drive: Drive, before: Follower, at_ns: int, axis: str, by_deg: float) -> Watch:
    """Watch on from ``before``, whose pictures end at ``at_ns``, with a camera that has turned."""
    follower = copy.deepcopy(before)
    for t_ns, grey in drive.pictures:
        if at_ns <= t_ns <= at_ns + WITHIN_S * 1e9:
            follower.follow(t_ns, reduced(turned(grey, drive.camera, axis, by_deg)))
    return Watch(_steps(drive, follower), follower)


def _steps(drive: Drive, follower: Follower) -> list[MountingStep]:
    nothing = np.empty(0)
    seen = PicturePass(
        nothing.astype(np.int64), nothing, nothing, nothing.astype(np.int64), None,
        follower.camera, follower.scale, (), nothing,
        np.array(follower.travel_ns, np.int64), tuple(follower.travel),
    )  # fmt: skip
    return list(watch_mounting(seen, drive.motion).steps)


def _drives(asked: Sequence[str]) -> Iterator[Drive]:
    for name in REAL:
        if asked and name not in asked:
            continue
        if any((DATA / "sequences" / DRIVES[name].folder).glob(DRIVES[name].pictures)):
            yield real(name)
        else:
            print(f"{name:24} no pictures in {DATA}")
    for seed, layouts in (DEVELOPED, FRESH):
        for layout in layouts:
            if not asked or f"{seed}-{layout}" in asked:
                yield simulated(layout, seed)


def main(asked: Sequence[str]) -> None:
    """Print a line for each drive, and the counts of each kind.

    Args:
        asked: Names of real drives, and SEED-LAYOUT for simulated ones (default: all).
    """
    counts: dict[str, list[int]] = {}
    for drive in _drives(asked):
        whole = watched(drive)
        times = whole.follower.travel_ns
        if len(times) < 2 * MIN_MEASURED:
            print(f"{drive.name:24} {len(times):3} directions of travel, too few", flush=True)
            continue
        false, mine = len(whole.steps), []
        for part in PARTS[: 3 if drive.name in REAL else 1]:
            at_ns = times[int(part * len(times))]
            before = watched(drive, at_ns).follower
            for axis in ("pitch", "yaw"):
                for by_deg in (-STEP_DEG, STEP_DEG):
                    seen = stepped(drive, before, at_ns, axis, by_deg).steps
                    right = [
                        one
                        for one in seen
                        if one.value == axis and abs(math.degrees(one.by) - by_deg) < 0.25
                    ]
                    false += len(seen) - len(right)
                    mine.append(len(right) == 1)
        kind = "real" if drive.name in REAL else " ".join(drive.name.split()[:2])
        line = [sum(mine), len(mine), false, 1]
        counts[kind] = np.add(counts.get(kind, [0] * 4), line).tolist()
        print(
            f"{drive.name:24} {len(times):3} directions of travel; without a step "
            f"{len(whole.steps)} found; injected {sum(mine)} of {len(mine)} found",
            flush=True,
        )
    for kind, (found, of, false, drives) in counts.items():
        print(f"{kind}: {found} of {of} steps found within 10 s, {false} false in {drives} drives")


if __name__ == "__main__":
    main(sys.argv[1:])
