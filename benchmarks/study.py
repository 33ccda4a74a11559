"""Simulated drives with their filter beside filterpy's, doing the same steps in the same run.

    python benchmarks/study.py [--rounds 5] [--drives 200]

Four comparisons, each a trial-step's CPU time; every filterpy filter is its ExtendedKalmanFilter,
with ``predict_x`` overridden as it asks for, and ``update`` with Jacobian, measurement function and
wrapped residual. With three states it does what the compiled filter does; with four (speed, weighed
in at every step) what the source's and our readable one do.

* Whole drive: one drive's controllers, bicycle model, wheels, compass, random numbers and filter in
  a lean Python loop, against ``drive_many``, which makes cities and decides besides. The loop is
  given its lanes; fed with the compiled drive's random numbers it ends in the same state.
* The same without the making of cities, which the loop does not do: the same drives are begun and
  given up at once, and that time is taken off.
* Filter alone: both on the wheels and compass readings of recorded drives.
* Unfavourable: filterpy's filter alone against the whole compiled drive.

Cases in rotation, medians; then cost and memory against the number of drives.
"""

from __future__ import annotations

import argparse
import math
import random
import resource
import statistics
import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter

from crosscue.localization.angles import wrap
from crosscue.localization.town import simulator as drive_simulator
from crosscue.localization.town.city import HEADINGS_RAD
from crosscue.localization.town.kernel import (
    LANES,
    Traced,
    drive_many,
    drive_traced,
    filter_rows,
    numbers_of,
)
from crosscue.localization.town.random_stream import Stream, key_of
from crosscue.localization.town.settings import City, Drive
from crosscue.localization.town.simulator import SENSOR_STREAM, drive
from crosscue.replay.columns import Floats

SETTINGS = Drive()
BEGUN = Drive(longest_m=1e-3)
SHORT = Drive(city=City(largest_km2=2.0))
STEPS = 3000
WINDUP = drive_simulator.WINDUP

Case = tuple[Callable[[], object], int]


def cpu_s(work: Callable[[], object]) -> float:
    began = time.process_time()
    work()
    return time.process_time() - began


def seeds(count: int) -> np.ndarray[tuple[int], np.dtype[np.uint64]]:
    return np.arange(count, dtype=np.uint64)


class Odometry(ExtendedKalmanFilter):  # type: ignore[misc]  # filterpy has no types
    """filterpy's filter on x, y, heading and, with four states, speed."""

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
        """Along the arc; the Jacobians for the covariance beside."""
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
        """Predict; speed, with four states; heading, where the compass was read."""
        way = 0.5 * (left + right)
        self.predict((way, (right - left) * self.per_track))
        if len(self.x) == 4:
            self.update(
                np.array([[way / self.step_s]]), lambda x: self.of_speed, lambda x: x[3:],
                R=self.speed_var,
            )  # fmt: skip
        if compass == compass:
            self.update(
                np.array([[compass]]), lambda x: self.of_heading, lambda x: x[2:3],
                R=self.compass_var, residual=wrapped,
            )  # fmt: skip


def wrapped(a: Floats, b: Floats) -> Floats:
    """The shorter way round."""
    return np.array([[wrap(float(a[0, 0] - b[0, 0]))]])


class Lane(NamedTuple):
    """What one step's controllers are told: a street or, with a radius, an arc; how fast."""

    c: float
    s: float
    x: float
    y: float
    radius: float
    is_to_brake: bool
    entry_m: float


class Recorder(drive_simulator._Drive):
    """The readable drive, which notes its lane at every step."""

    def run_lanes(self, steps: int) -> list[Lane]:
        """The lane of each of so many steps."""
        self.lanes: list[Lane] = []
        for _ in range(steps):
            self._note_lane()
            self._estimate(*self._move())
            assert not self._has_arrived()
            self._follow_path()
        return self.lanes

    def _note_lane(self) -> None:
        heading = HEADINGS_RAD[self.way]
        x, y = self.made.city.place(self.node)
        radius = 0.0
        if self.arcs:
            arc = self.arcs[0]
            radius = 1.0 / arc.curvature
            x = arc.x_m - radius * math.sin(arc.heading_rad)
            y = arc.y_m + radius * math.cos(arc.heading_rad)
        self.lanes.append(
            Lane(math.cos(heading), math.sin(heading), x, y, radius, bool(self.turn),
                 self._entry_m())
        )  # fmt: skip


def python_loop(
    lanes: list[Lane], start: tuple[float, float, float], first: tuple[float, float, float],
    states: int, normal: Callable[[], float],
) -> tuple[float, ...]:  # fmt: skip
    """One drive's steps in plain Python, with filterpy's filter; truth and belief come back."""
    car, sensors = SETTINGS.car, SETTINGS.sensors
    assert sensors.compass_2sigma_deg is not None
    compass_sd = math.radians(sensors.compass_2sigma_deg) / 2.0
    kf = Odometry(first, states)
    x, y, h = start
    v, dt = car.turn_mps, car.step_s
    half_track, count_m, slip = (
        0.5 * car.track_width_m,
        sensors.encoder_step_m,
        sensors.slip_per_sqrt_m,
    )
    accel = beside_sum = slow_sum = unread_left = unread_right = since = 0.0
    for lane in lanes:
        ch, sh = math.cos(h), math.sin(h)
        curvature, wanted = 0.0, car.cruise_mps
        if lane.radius:
            ox, oy = x - lane.x, y - lane.y
            apart, side = math.hypot(ox, oy), math.copysign(1.0, lane.radius)
            beside = side * (abs(lane.radius) - apart)
            growth = side * (-oy * sh - ox * ch) / apart
            curvature, wanted = 1.0 / lane.radius, car.turn_mps
        else:
            beside = lane.c * (y - lane.y) - lane.s * (x - lane.x) + car.lane_offset_m
            growth = lane.c * sh - lane.s * ch
            if lane.is_to_brake:
                room = lane.c * (lane.x - x) + lane.s * (lane.y - y) - lane.entry_m
                fast = math.sqrt(car.turn_mps**2 + 2.0 * car.accel_mps2 * max(room, 0.0))
                wanted = min(car.cruise_mps, fast)
        slow = wanted - v
        slow_sum = min(max(slow_sum + slow * dt, -WINDUP), WINDUP)
        accel = car.speed_p * slow + car.speed_i * slow_sum - car.speed_d * accel
        accel = min(max(accel, -drive_simulator.BRAKE_SHARE * car.accel_mps2), car.accel_mps2)
        accel = max(accel, (drive_simulator.SLOWEST_MPS - v) / dt)
        steering = car.wheelbase_m * curvature - car.steering_p * beside
        steering -= car.steering_i * beside_sum + car.steering_d * growth
        limit = drive_simulator.STEERING_LIMIT_RAD
        steering = min(max(steering, -limit), limit)
        way = v * dt + 0.5 * accel * dt * dt
        turned = way * steering / car.wheelbase_m
        if turned:
            dx, dy = (
                way * math.sin(turned) / turned,
                way * 2.0 * math.sin(turned / 2.0) ** 2 / turned,
            )
        else:
            dx, dy = way, 0.0
        x, y, h = x + ch * dx - sh * dy, y + sh * dx + ch * dy, wrap(h + turned)
        v += accel * dt
        beside_sum = min(max(beside_sum + beside * way, -WINDUP), WINDUP)
        path = way - half_track * turned
        unread_left += path + slip * math.sqrt(abs(path)) * normal()
        left = math.floor(unread_left / count_m + 0.5) * count_m
        unread_left -= left
        path = way + half_track * turned
        unread_right += path + slip * math.sqrt(abs(path)) * normal()
        right = math.floor(unread_right / count_m + 0.5) * count_m
        unread_right -= right
        since += abs(0.5 * (left + right))
        compass = math.nan
        if since >= sensors.compass_interval_m:
            since -= sensors.compass_interval_m
            compass = wrap(h + compass_sd * normal())
        kf.step(left, right, compass)
    return (x, y, h, *kf.x[:3, 0].tolist())


def filterpy_alone(traced: Traced, steps: int, states: int) -> Floats:
    """Its filter on one drive's readings; the state at the end."""
    kf = Odometry(traced.first_belief, states)
    for left, right, compass in traced.steps[:steps, 4:7].tolist():
        kf.step(left, right, compass)
    found: Floats = kf.x[:3, 0]
    return found


def compiled_alone(many: list[Traced], steps: int) -> tuple[Floats, Floats]:
    """Readings and starts of as many drives as go side by side."""
    readings = np.stack([traced.steps[:steps, 4:7] for traced in many], axis=2)
    first = np.array([traced.first_belief for traced in many]).T
    return np.ascontiguousarray(first), np.ascontiguousarray(readings)


def largest_gap(a: Floats, b: Floats) -> float:
    gap = np.abs(a - b)
    gap[2] = abs(wrap(float(gap[2])))
    return float(gap.max())


class Recorded(NamedTuple):
    """The same drives as every side wants them.

    Attributes:
        seed: Of the first drive.
        many: As many drives as go side by side.
        start: Where the first one begins: x, y, heading.
        lanes: What its controllers are told, step by step.
        first: Shape (3, LANES): x, y and heading believed at the start, of all of them.
        readings: Shape (STEPS, 3, LANES): wheels and compass.
        ends: Shape (9, LANES): filled in by the compiled filter.
    """

    seed: int
    many: list[Traced]
    start: tuple[float, float, float]
    lanes: list[Lane]
    first: Floats
    readings: Floats
    ends: Floats


def recorded() -> Recorded:
    long = [i for i, steps in enumerate(drive_many(SETTINGS, seeds(100))[:, 3]) if steps >= STEPS]
    many = [drive_traced(SETTINGS, i) for i in long[:LANES]]
    recorder = Recorder(SETTINGS, long[0], drive_simulator.Trace())
    start = recorder.x, recorder.y, recorder.heading
    lanes = recorder.run_lanes(STEPS)
    return Recorded(long[0], many, start, lanes, *compiled_alone(many, STEPS), np.empty((9, LANES)))


def check(one: Recorded) -> None:
    """Both sides end in the same state, or nothing is worth timing."""
    traced = one.many[0]
    filter_rows(numbers_of(SETTINGS), one.first, one.readings, one.ends)
    for states in (3, 4):
        gap = largest_gap(filterpy_alone(traced, STEPS, states), one.ends[:3, 0].copy())
        print(
            f"filter alone, {STEPS} steps: filterpy's {states} states and ours differ by {gap:.1e}"
        )
        assert gap < 1e-9
    noise = Stream(key_of(one.seed, SENSOR_STREAM))
    for _ in range(3):
        noise.normal()
    found = np.array(python_loop(one.lanes, one.start, traced.first_belief, 3, noise.normal))
    row = traced.steps[STEPS - 1]
    gap = max(largest_gap(found[:3], row[:3].copy()), largest_gap(found[3:], row[7:10].copy()))
    print(f"whole drive, {STEPS} steps: the Python loop and ours differ by {gap:.1e}\n")
    assert gap < 1e-9


def cases_of(one: Recorded, drives: int) -> dict[str, Case]:
    """Work and its trial-steps."""
    gauss = random.Random(1).gauss
    numbers, traced = numbers_of(SETTINGS), one.many[0]
    compiled_steps = int(drive_many(SETTINGS, seeds(drives))[:, 3].sum())

    def loop(states: int) -> None:
        python_loop(one.lanes, one.start, traced.first_belief, states, lambda: gauss(0.0, 1.0))

    return {
        "Python loop, filterpy, 3 states": (lambda: loop(3), STEPS),
        "Python loop, filterpy, 4 states": (lambda: loop(4), STEPS),
        "filterpy alone, 3 states": (lambda: filterpy_alone(traced, STEPS, 3), STEPS),
        "filterpy alone, 4 states": (lambda: filterpy_alone(traced, STEPS, 4), STEPS),
        "ours, filter alone": (
            lambda: [filter_rows(numbers, one.first, one.readings, one.ends) for _ in range(20)],
            20 * STEPS * LANES,
        ),
        "ours, whole drive": (lambda: drive_many(SETTINGS, seeds(drives)), compiled_steps),
        "ours, making the cities": (lambda: drive_many(BEGUN, seeds(drives)), compiled_steps),
        "ours, readable, whole drive": (lambda: drive(SHORT, 0), drive(SHORT, 0).steps),
    }


def in_rotation(cases: dict[str, Case], rounds: int) -> dict[str, list[float]]:
    """Nanoseconds a trial-step of each case, round by round."""
    spent: dict[str, list[float]] = {name: [] for name in cases}
    for _ in range(rounds):
        for name, (work, count) in cases.items():
            spent[name].append(1e9 * cpu_s(work) / count)
    spent["ours, steps and decisions"] = [
        whole - city
        for whole, city in zip(
            spent["ours, whole drive"], spent["ours, making the cities"], strict=True
        )
    ]
    return spent


def compare(rounds: int, drives: int) -> None:
    one = recorded()
    check(one)
    spent = in_rotation(cases_of(one, drives), rounds)
    print("CPU time a trial-step              ns, median [least..most]")
    for name, values in spent.items():
        print(f"{name:34} {statistics.median(values):9.1f} [{min(values):.1f}..{max(values):.1f}]")
    print("\ntimes as fast                       3 states   4 states")
    for name, peer, our in (
        ("whole drive", "Python loop, filterpy", "ours, whole drive"),
        ("without making cities", "Python loop, filterpy", "ours, steps and decisions"),
        ("filter alone", "filterpy alone", "ours, filter alone"),
        ("their filter, our whole drive", "filterpy alone", "ours, whole drive"),
    ):
        three, four = (faster(spent, f"{peer}, {states} states", our) for states in (3, 4))
        print(f"{name:34} {three:9.0f}  {four:9.0f}")
    readable = faster(spent, "ours, readable, whole drive", "ours, whole drive")
    print(f"whole drive, our readable one {readable:14.0f}")


def faster(spent: dict[str, list[float]], peer: str, our: str) -> float:
    return statistics.median(p / v for p, v in zip(spent[peer], spent[our], strict=True))


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
