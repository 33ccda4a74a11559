"""Simulated drives with their filter: compiled, readable, and a filterpy loop over the same steps.

    python benchmarks/study.py [--rounds 5] [--drives 200]

The peer is filterpy's ExtendedKalmanFilter with the source's four states, fed with the wheels and
compass readings of the same drives: predict, speed, and heading where one was read. It neither
simulates nor decides. ``drive_many`` makes the city, drives, steers, senses, filters and decides.
Cases in rotation, medians of CPU time; then cost and memory against the number of drives.
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
from crosscue.localization.drive_kernel import Traced, drive_many, drive_traced
from crosscue.localization.drive_settings import City, Drive
from crosscue.localization.drive_simulator import drive
from crosscue.localization.ekf import arc
from crosscue.replay.columns import Floats

SETTINGS = Drive()
SHORT = Drive(city=City(largest_km2=2.0))


def cpu_s(work: Callable[[], object]) -> float:
    began = time.process_time()
    work()
    return time.process_time() - began


def seeds(count: int) -> np.ndarray[tuple[int], np.dtype[np.uint64]]:
    return np.arange(count, dtype=np.uint64)


def filterpy_loop(traced: Traced, steps: int) -> Floats:
    """The filter of the readable simulator, in filterpy."""
    sensors, car = SETTINGS.sensors, SETTINGS.car
    assert sensors.compass_2sigma_deg is not None
    compass_var = np.array([[(math.radians(sensors.compass_2sigma_deg) / 2.0) ** 2]])
    speed_var = np.array([[sensors.speed_sd_mps**2]])
    kf = ExtendedKalmanFilter(4, 1)
    kf.x = np.array([*traced.first_belief, car.turn_mps]).reshape(4, 1)
    position, heading = sensors.start_position_sd_m, math.radians(sensors.start_heading_sd_deg)
    kf.P = np.diag([position**2, position**2, heading**2, sensors.speed_sd_mps**2])
    of_speed, of_heading = np.array([[0.0, 0.0, 0.0, 1.0]]), np.array([[0.0, 0.0, 1.0, 0.0]])
    for row in traced.steps[:steps]:
        left, right, compass = row[4], row[5], row[6]
        way, turn = 0.5 * (left + right), (right - left) / car.track_width_m
        slip = sensors.slip_per_sqrt_m**2 * abs(way)
        step, h = arc(way, turn), kf.x[2, 0]
        c, s = math.cos(h), math.sin(h)
        mx, my = c * step.dx_m - s * step.dy_m, s * step.dx_m + c * step.dy_m
        by_state = np.eye(4)
        by_state[:2, 2] = -my, mx
        by_input = np.array([
            [c * step.dx_by_distance - s * step.dy_by_distance,
             c * step.dx_by_turn - s * step.dy_by_turn],
            [s * step.dx_by_distance + c * step.dy_by_distance,
             s * step.dx_by_turn + c * step.dy_by_turn],
            [0.0, 1.0], [0.0, 0.0],
        ])  # fmt: skip
        noise = np.diag([slip / 2.0, 2.0 * slip / car.track_width_m**2])
        kf.F, kf.Q = by_state, by_input @ noise @ by_input.T
        kf.Q[3, 3] = sensors.accel_var_m2ps3 * car.step_s
        kf.x = kf.x + np.array([[mx], [my], [turn], [0.0]])
        kf.P = kf.F @ kf.P @ kf.F.T + kf.Q
        kf.update(np.array([[way / car.step_s]]), lambda x: of_speed, lambda x: x[3:], R=speed_var)
        if not math.isnan(compass):
            kf.update(
                np.array([[compass]]), lambda x: of_heading, lambda x: x[2:3], R=compass_var,
                residual=lambda a, b: np.array([[wrap(float(a[0, 0] - b[0, 0]))]]),
            )  # fmt: skip
    found: Floats = kf.x[:3, 0]
    return found


def compare(rounds: int, drives: int) -> None:
    traced = drive_traced(SETTINGS, 1)
    steps = min(len(traced.steps), 3000)
    ended = filterpy_loop(traced, steps)
    apart = np.abs(ended - traced.steps[steps - 1, 7:10])
    apart[2] = abs(wrap(float(apart[2])))
    print(f"filterpy's state after {steps} steps is the compiled one's within {apart.max():.1e}\n")
    compiled_steps = int(drive_many(SETTINGS, seeds(drives))[:, 3].sum())
    readable_steps = drive(SHORT, 0).steps
    cases = {
        "filterpy, filter alone": (lambda: filterpy_loop(traced, steps), steps),
        "readable, whole drive": (lambda: drive(SHORT, 0), readable_steps),
        "compiled, whole drive": (lambda: drive_many(SETTINGS, seeds(drives)), compiled_steps),
    }
    spent: dict[str, list[float]] = {name: [] for name in cases}
    for _ in range(rounds):
        for name, (work, count) in cases.items():
            spent[name].append(1e9 * cpu_s(work) / count)
    peer = spent["filterpy, filter alone"]
    print("CPU time a trial-step        ns, median [least..most]        times filterpy")
    for name, values in spent.items():
        ratio = statistics.median(p / v for p, v in zip(peer, values, strict=True))
        print(f"{name:26} {statistics.median(values):10.0f} "
              f"[{min(values):.0f}..{max(values):.0f}] {ratio:14.1f}")  # fmt: skip


def growth() -> None:
    print("\ndrives     steps      CPU s   ms a drive   peak memory MiB")
    for drives in (100, 400, 1600):
        rows = np.empty((0, 0))

        def work(drives: int = drives) -> None:
            nonlocal rows
            rows = np.concatenate([
                drive_many(SETTINGS, part) for part in np.array_split(seeds(drives), drives // 100)
            ])  # fmt: skip

        spent = cpu_s(work)
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        print(f"{drives:6} {int(rows[:, 3].sum()):10} {spent:9.2f} {1e3 * spent / drives:11.2f} "
              f"{peak:14.0f}")  # fmt: skip


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
