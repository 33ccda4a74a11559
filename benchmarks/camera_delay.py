"""Delay of pictures against signals: injected delays, errors, and coverage of the intervals.

Run it as ``python -m benchmarks.camera_delay [COUNT]``. It reads the sequences with poses of
``$CROSSCUE_DATA`` (or ``../shared/data``), whose yaw rate and speed are the signals, and simulated
drives. The true delay of the real pictures is not known; it is taken to be 0. KITTI's poses are the
nearest of an inertial unit at 100 Hz, so up to 5 ms from the pictures (Geiger et al., IJRR 32,
2013): intervals are printed as they are, and widened by that. One turn has one such error, and one
of its pictures, in all of its injected delays. Seeds were drawn once, after the method was fixed.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

import cv2
import numpy as np
from scipy.interpolate import CubicSpline

from benchmarks.real_roads import DATA, DRIVES
from benchmarks.visual_odometry import truth_of
from crosscue.eval.vehicle.picture_pass import Follower, reduced
from crosscue.localization.camera_delay import (
    CameraDelay,
    PictureMotion,
    delay_by_speed,
    delay_by_yaw_rate,
    mean_delay,
)
from crosscue.replay.columns import Floats
from crosscue.replay.vehicle.vehicle import parse
from support.picture_motion import pictures, speed, yaw_rate

NAMES = ("kitti_right_turn", "kitti_t_junction", "pandaset_002")
MAX_S = 0.25
# S.d. of the time of a pose, uniform within 5 ms.
REFERENCE_SD_S = 0.005 / 3.0**0.5
SEED = 31_000


class Pictures(NamedTuple):
    """Motion by the pictures of a drive, and its true motion."""

    motion: PictureMotion
    yaw_rate: Callable[[Floats], Floats]
    speed: Callable[[Floats], Floats]
    ends_s: tuple[float, float]


def pictures_of(name: str) -> Pictures:
    """Follow the pictures of a real drive."""
    drive = DRIVES[name]
    camera = parse(f"version = 1\n[camera]\n{drive.camera}", drive.folder).camera
    steps, growth, follower = [], [], None
    for i, path in enumerate(sorted((DATA / "sequences" / drive.folder).glob(drive.pictures))):
        grey = np.asarray(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), np.uint8)
        small = reduced(grey)
        size_px = (grey.shape[1], grey.shape[0])
        follower = follower or Follower(camera, size_px, small)
        step = follower.follow(round(i / drive.rate_hz * 1e9), small)
        if step is not None:
            steps.append(step)
            growth.append(follower.odometry.expansion)
    truth = truth_of(drive)
    middle_s = (np.arange(len(truth.turn_rad)) + 0.5) / drive.rate_hz
    motion = PictureMotion(
        np.array([one.start_ns for one in steps], np.int64),
        np.array([one.t_ns for one in steps], np.int64),
        np.array([one.turn_rad for one in steps]),
        np.array(growth),
        np.array([one.is_standing for one in steps]),
    )
    return Pictures(
        motion,
        CubicSpline(middle_s, truth.turn_rad * drive.rate_hz),
        CubicSpline(middle_s, np.abs(truth.distance_m) * drive.rate_hz),
        (float(middle_s[0]), float(middle_s[-1])),
    )


def injected(seen: Pictures, count: int, seed: int) -> Iterator[tuple[float, list[CameraDelay]]]:
    """Yield delays, and what is found: random parts of the drive, rates, noise and bias."""
    rng = np.random.default_rng(seed)
    for _ in range(count):
        delay_s, rate_hz = float(rng.uniform(-MAX_S, MAX_S)), float(rng.choice([20, 50, 100]))
        t_s = np.arange(
            seen.ends_s[0] + rng.uniform(0.0, 1.0 / rate_hz), seen.ends_s[1], 1 / rate_hz
        )
        t_ns = np.round(t_s * 1e9).astype(np.int64)
        rate = seen.yaw_rate(t_s) + np.radians(0.1) * rng.normal(size=len(t_s)) + np.radians(0.3)
        speed = seen.speed(t_s) + 0.03 * rng.normal(size=len(t_s))
        length = len(seen.motion.t_ns)
        kept = int(length * rng.uniform(0.7, 1.0))
        first = int(rng.integers(0, length - kept + 1))
        part = seen.motion.take(np.isin(np.arange(length), np.arange(first, first + kept)))
        late_ns = round(delay_s * 1e9)
        part = replace(part, start_ns=part.start_ns + late_ns, t_ns=part.t_ns + late_ns)
        yield delay_s, [delay_by_yaw_rate(part, t_ns, rate), delay_by_speed(part, t_ns, speed)]


def printed(
    name: str, pairs: list[tuple[float, CameraDelay | None]], reference_sd_s: float = 0.0
) -> None:
    """Print one line: errors, and coverage."""
    found = [(one.delay_s - true, one.sd_s) for true, one in pairs if one and one.is_observable]
    if not found:
        print(f"{name:28} not observable in {len(pairs)} of {len(pairs)}")
        return
    error, sd = np.array(found).T
    print(
        f"{name:28} {len(found)} of {len(pairs)} observable; bias {1e3 * error.mean():+.1f} ms, "
        f"s.d. {1e3 * error.std():.1f}, worst {1e3 * np.abs(error).max():.1f}; within 15 ms "
        f"{np.mean(np.abs(error) < 0.015):.0%}; stated s.d. {1e3 * np.median(sd):.1f}; inside 95 % "
        f"{_inside(error, sd)}"
        + (f", widened {_inside(error, np.hypot(sd, reference_sd_s))}" if reference_sd_s else "")
    )


def _inside(error: Floats, sd: Floats) -> str:
    """Share of errors inside their intervals, with its standard error for independent drives."""
    part = float(np.mean(np.abs(error) < 1.96 * sd))
    return f"{part:.1%} +- {(part * (1.0 - part) / len(sd)) ** 0.5:.1%}"


def main(count: int) -> None:
    """Print a line for each real drive and signal, and for simulated drives."""
    pairs: list[tuple[float, CameraDelay | None]]
    for name in NAMES:
        results = [*injected(pictures_of(name), count, SEED)]
        late_s = REFERENCE_SD_S if name.startswith("kitti") else 0.0
        for number, signal in enumerate(("yaw rate", "speed")):
            pairs = [(true, found[number]) for true, found in results]
            printed(f"{name}, {signal}", pairs, late_s)
        printed(f"{name}, mean", [(true, mean_delay(found)) for true, found in results], late_s)
    rng = np.random.default_rng(SEED)
    for signal in ("yaw rate", "speed"):
        pairs = []
        for seed in range(SEED, SEED + 2 * count):
            delay_s = float(rng.uniform(-MAX_S, MAX_S))
            motion = pictures(seed, delay_s)
            if signal == "yaw rate":
                pairs.append((delay_s, delay_by_yaw_rate(motion, *yaw_rate(seed, 25.0))))
            else:
                pairs.append((delay_s, delay_by_speed(motion, *speed(seed))))
        printed(f"simulated, {signal}", pairs)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 100)
