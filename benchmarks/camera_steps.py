"""Steps of the camera's pitch or yaw, injected into pictures: found within 10 s, none elsewhere.

Run it as ``python -m benchmarks.camera_steps``. The pictures of real drives on straight road
(``$CROSSCUE_DATA`` or ``../shared/data``) and of simulated approaches are warped from a moment on
as by a camera that turns by half a degree. Pictures later than ten seconds after the step are left
out. Where the speed is known, pictures of a car that brakes or accelerates do not count, as in
``crosscue check``.
"""

from __future__ import annotations

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
from crosscue.eval.vehicle.mounting import watch_mounting
from crosscue.eval.vehicle.picture_pass import Follower, PicturePass, reduced
from crosscue.localization.camera_watch import MIN_MEASURED, MountingStep
from crosscue.replay.base import EVERYTHING
from crosscue.replay.columns import Bytes
from crosscue.replay.signals.kinds import Signal
from crosscue.replay.signals.plan import plan
from crosscue.replay.vehicle.camera import Camera
from crosscue.replay.vehicle.drafting.series import Series
from crosscue.replay.vehicle.vehicle import load, parse

REAL: Final = ("kitti_t_junction", "pandaset_002")
SIMULATED: Final = ("A", "B", "C")
STEP_DEG: Final = 0.5
WITHIN_S: Final = 10.0
# Parts of the directions of travel before the step; a simulated drive is long, and has one.
PARTS: Final = (0.5, 0.4, 0.6)


class Drive(NamedTuple):
    """Pictures of a camera, in grey, with their times."""

    name: str
    camera: Camera
    pictures: Sequence[tuple[int, Bytes]]
    speed: Series | None = None


def real(name: str) -> Drive:
    """Read the pictures of a real drive."""
    drive = DRIVES[name]
    camera = parse(f"version = 1\n[camera]\n{drive.camera}", drive.folder).camera
    files = sorted((DATA / "sequences" / drive.folder).glob(drive.pictures))
    grey = (np.asarray(cv2.imread(str(one), cv2.IMREAD_GRAYSCALE), np.uint8) for one in files)
    pictures = [(round(i / drive.rate_hz * 1e9), one) for i, one in enumerate(grey)]
    return Drive(name, camera, pictures)


def simulated(folder: Path) -> Iterator[Drive]:
    """Simulate one approach to each intersection."""
    simulate_approaches(Approaches(SIMULATED, width_px=960), folder)
    for place in sorted(folder.iterdir()):
        vehicle = load(place / "vehicle.toml")
        with crosscue.open(place / "drive.mcap") as log:
            topic = next(one for one in log.topics if "image" in one)
            pictures = [
                (frame.t_ns, np.asarray(cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY), np.uint8))
                for frame in log[topic].frames()
            ]
            planned = plan([(0, topic) for topic in log.logs[0].topics], vehicle)
            samples = read_samples(log.logs, vehicle, planned, EVERYTHING)
        speed = QualityDrive(vehicle, (), samples, planned).series(Signal.WHEEL_SPEEDS)
        yield Drive(f"simulated {place.name}", vehicle.camera, pictures, speed)


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


def watched(
    drive: Drive, axis: str = "", by_deg: float = 0.0, at_ns: int = 0
) -> tuple[list[MountingStep], list[int]]:
    """Return the steps that are found, and the times of the directions of travel."""
    follower, followed = None, []
    for t_ns, grey in drive.pictures:
        if axis and t_ns > at_ns + WITHIN_S * 1e9:
            break
        moved = turned(grey, drive.camera, axis, by_deg) if axis and t_ns >= at_ns else grey
        small = reduced(moved)
        size_px = (grey.shape[1], grey.shape[0])
        follower = follower or Follower(drive.camera, size_px, small)
        step = follower.follow(t_ns, small)
        followed += [] if step is None else [step]
    assert follower is not None
    nothing = np.empty(0)
    seen = PicturePass(
        nothing.astype(np.int64), nothing, nothing, nothing.astype(np.int64), None,
        follower.camera, follower.scale, tuple(followed), nothing,
        np.array(follower.travel_ns, np.int64), tuple(follower.travel),
    )  # fmt: skip
    steps = [one for one in watch_mounting(seen, drive.speed).steps if one.value != "height"]
    return steps, follower.travel_ns


def main() -> None:
    """Print a line for each drive, and the counts."""
    found = injected = false = drives = 0
    with tempfile.TemporaryDirectory() as folder:
        for drive in [*map(real, REAL), *simulated(Path(folder))]:
            steps, times = watched(drive)
            if len(times) < 2 * MIN_MEASURED:
                print(f"{drive.name:32} {len(times):3} directions of travel, too few")
                continue
            false, drives, mine = false + len(steps), drives + 1, []
            for part in PARTS[: 1 if drive.name.startswith("simulated") else 3]:
                at_ns = times[int(part * len(times))]
                for axis in ("pitch", "yaw"):
                    for by_deg in (-STEP_DEG, STEP_DEG):
                        seen, _ = watched(drive, axis, by_deg, at_ns)
                        right = [
                            one
                            for one in seen
                            if one.value == axis and abs(math.degrees(one.by) - by_deg) < 0.25
                        ]
                        false += len(seen) - len(right)
                        mine.append(len(right) == 1)
            found, injected = found + sum(mine), injected + len(mine)
            print(
                f"{drive.name:32} {len(times):3} directions of travel; without a step "
                f"{len(steps)} found; injected {sum(mine)} of {len(mine)} found"
            )
            sys.stdout.flush()
    print(f"all: {found} of {injected} steps found within 10 s, {false} false in {drives} drives")


if __name__ == "__main__":
    main()
