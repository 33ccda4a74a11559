"""Simulated drives next to filterpy's filter on the same steps, in one run.

    python benchmarks/study.py [--rounds 5] [--drives 200]

The script compares the CPU time per step of complete compiled drives (town, vehicle, sensors,
filter, decisions) with that of filterpy's ExtendedKalmanFilter alone, with the dissertation's four
states and the readings of a recorded drive. Both end in the same state. It also prints cost and
memory against the number of drives. ``crosscue study landmarks`` prints the time of the study.
"""

from __future__ import annotations

import argparse
import math
import resource
import statistics
import time
from collections.abc import Callable

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter

from crosscue.localization.angles import wrap
from crosscue.localization.town.drive import (
    Traced,
    drive_many,
    drive_traced,
)
from crosscue.localization.town.settings import TownDrive
from crosscue.replay.columns import Floats

SETTINGS = TownDrive()
STEPS = 3000


def cpu_s(work: Callable[[], object]) -> float:
    began = time.process_time()
    work()
    return time.process_time() - began


def seeds(count: int) -> np.ndarray[tuple[int], np.dtype[np.uint64]]:
    return np.arange(count, dtype=np.uint64)


class Odometry(ExtendedKalmanFilter):  # type: ignore[misc]  # filterpy has no types
    """filterpy's filter on x, y, heading and, if it has four states, speed."""

    def __init__(self, first: tuple[float, float, float], states: int) -> None:
        super().__init__(states, 1)
        sensors, car = SETTINGS.sensors, SETTINGS.car
        assert sensors.compass_2sigma_deg is not None
        position, heading = sensors.start_position_sd_m, math.radians(sensors.start_heading_sd_deg)
        self.x = np.array([*first, car.turn_mps][:states]).reshape(-1, 1)
        sd = np.array([position, position, heading, sensors.speed_sd_mps][:states])
        self.P = np.diag(sd**2)
        self.compass_var = np.array([[(math.radians(sensors.compass_2sigma_deg) / 2.0) ** 2]])
        self.speed_var = np.array([[sensors.speed_sd_mps**2]])
        self.of_heading, self.of_speed = np.eye(states)[2:3], np.eye(states)[3:]
        self.slip_var = sensors.slip_per_sqrt_m**2
        self.turn_var = 2.0 * self.slip_var / car.track_width_m**2
        self.per_track, self.step_s = 1.0 / car.track_width_m, car.step_s
        self.accel_var = sensors.accel_var_m2ps3 * car.step_s

    def predict_x(self, u: tuple[float, float] = (0.0, 0.0)) -> None:
        """Move the state along an arc, and set the Jacobian ``F`` and the noise ``Q``."""
        way, t = u
        h, t2 = self.x[2, 0], t * t
        along = 1.0 - t2 / 6.0 * (1.0 - t2 / 20.0)
        across = t / 2.0 * (1.0 - t2 / 12.0 * (1.0 - t2 / 30.0))
        along_by = -way * t / 3.0 * (1.0 - t2 / 10.0 * (1.0 - t2 / 28.0))
        across_by = way * (0.5 - t2 / 8.0 * (1.0 - t2 / 18.0 * (1.0 - t2 / 40.0)))
        c, s = math.cos(h), math.sin(h)
        fx, fy = c * along - s * across, s * along + c * across
        tx, ty = c * along_by - s * across_by, s * along_by + c * across_by
        d, r = 0.5 * self.slip_var * abs(way), self.turn_var * abs(way)
        self.F[0, 2], self.F[1, 2] = -way * fy, way * fx
        self.Q[:3, :3] = (
            (fx * fx * d + tx * tx * r, fx * fy * d + tx * ty * r, tx * r),
            (fx * fy * d + tx * ty * r, fy * fy * d + ty * ty * r, ty * r),
            (tx * r, ty * r, r),
        )
        if len(self.x) == 4:
            self.Q[3, 3] = self.accel_var
        self.x[0, 0] += way * fx
        self.x[1, 0] += way * fy
        self.x[2, 0] = wrap(h + t)

    def step(self, left: float, right: float, compass: float) -> None:
        """Predict, and update by speed (with four states) and by compass readings."""
        way = 0.5 * (left + right)
        self.predict((way, (right - left) * self.per_track))
        if len(self.x) == 4:
            self.update(
                np.array([[way / self.step_s]]),
                lambda x: self.of_speed,
                lambda x: x[3:],
                R=self.speed_var,
            )
        if compass == compass:
            self.update(
                np.array([[compass]]),
                lambda x: self.of_heading,
                lambda x: x[2:3],
                R=self.compass_var,
                residual=wrapped,
            )


def wrapped(a: Floats, b: Floats) -> Floats:
    """Return the angle wrapped to the shorter turn."""
    return np.array([[wrap(float(a[0, 0] - b[0, 0]))]])


def filterpy_alone(traced: Traced, steps: int, states: int) -> Floats:
    """Run the filter on the readings of one drive and return its final state."""
    kf = Odometry(traced.first_belief, states)
    for left, right, compass in traced.steps[:steps, 4:7].tolist():
        kf.step(left, right, compass)
    found: Floats = kf.x[:3, 0]
    return found


def largest_gap(a: Floats, b: Floats) -> float:
    gap = np.abs(a - b)
    gap[2] = abs(wrap(float(gap[2])))
    return float(gap.max())


def check(traced: Traced) -> None:
    """Check that both filters end in the same state, before timing them."""
    row = traced.steps[STEPS - 1]
    gap = largest_gap(filterpy_alone(traced, STEPS, 4), row[7:10].copy())
    print(f"filter, {STEPS} steps: filterpy's four states and ours differ by {gap:.1e}\n")
    assert gap < 1e-9


def compare(rounds: int, drives: int) -> None:
    long = [i for i, steps in enumerate(drive_many(SETTINGS, seeds(100))[:, 3]) if steps >= STEPS]
    traced = drive_traced(SETTINGS, long[0])
    check(traced)
    steps = int(drive_many(SETTINGS, seeds(drives))[:, 3].sum())
    spent: dict[str, list[float]] = {"filterpy, its filter alone": [], "ours, whole drive": []}
    for _ in range(rounds):
        for name, work, count in (
            ("filterpy, its filter alone", lambda: filterpy_alone(traced, STEPS, 4), STEPS),
            ("ours, whole drive", lambda: drive_many(SETTINGS, seeds(drives)), steps),
        ):
            spent[name].append(1e9 * cpu_s(work) / count)
    print("CPU time a trial-step                ns, median [min..max]")
    for name, values in spent.items():
        print(f"{name:34} {statistics.median(values):9.1f} [{min(values):.1f}..{max(values):.1f}]")
    peer, ours = spent.values()
    print(f"times as fast: {statistics.median(p / v for p, v in zip(peer, ours, strict=True)):.0f}")


def growth() -> None:
    print("\ndrives     steps      CPU s   ms a drive   peak memory MiB")
    for drives in (100, 400, 1600):
        rows = np.empty((0, 0))

        def work(drives: int = drives) -> None:
            nonlocal rows
            rows = np.concatenate(
                [
                    drive_many(SETTINGS, part)
                    for part in np.array_split(seeds(drives), drives // 100)
                ]
            )

        spent = cpu_s(work)
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        print(
            f"{drives:6} {int(rows[:, 3].sum()):10} {spent:9.2f} {1e3 * spent / drives:11.2f} "
            f"{peak:14.0f}"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--drives", type=int, default=200)
    args = parser.parse_args()
    began = time.process_time()
    drive_many(SETTINGS, seeds(1))
    print(f"first call, compiled or from the cache: {time.process_time() - began:.1f} CPU s")
    compare(args.rounds, args.drives)
    growth()


if __name__ == "__main__":
    main()
