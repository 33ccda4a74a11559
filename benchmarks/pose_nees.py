"""Consistency of dead reckoning with fitted odometry, on parts of drives that were not fitted.

Each drive is cut into parts. `fit odometry` is fitted to each part, and the filter, with the fit's
constant errors as states, predicts the next part (and the part before) from the last 15 s of known
positions. The table has the mean NEES of x and y by horizon: 2 is expected, and less means that the
filter is too cautious. Its interval covers what many such drives would give, in 94 % or more of
simulated repetitions, also where the windows of a part share most of their error (``interval``).

    python benchmarks/pose_nees.py --data ../shared/data [--simulated 20] [--json nees.json]

Simulated drives have seeds 0, 1, ...; their sensors (`datasets.simulated.drive.sense`) err in ways
of their own: slip that persists for two seconds, and tyres of four sizes. The page's figures are of
seeds 700 to 705, 700 to 729 for turns and 700 to 723 for short drives, named before they were
drawn. By `--wheel-turn 0.0283` the predictions of short drives have the noise that the wheels have
over a long time.
"""

from __future__ import annotations

import argparse
import csv
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, NamedTuple, TypeAlias

import numpy as np
from scipy.stats import chi2

import crosscue
from crosscue.datasets.geodesy import geodetic_to_enu
from crosscue.datasets.simulated.drive import (
    START_NS,
    TRACK_WIDTH_M,
    WHEELBASE_M,
    DriveSettings,
    TrueMotion,
    sense,
    true_motion,
)
from crosscue.eval.fit.log_signals import read_signals, signal_plan, turn_samples, wheel_speeds
from crosscue.eval.fit.reference import ReferencePositions, of_gnss, of_truth
from crosscue.eval.logs.log import opened
from crosscue.eval.pipeline.pose import odometry_settings
from crosscue.localization.constants import NO_CONSTANTS
from crosscue.localization.fit.known_drive import KnownDrive
from crosscue.localization.fit.odometry import OdometryFit, fit_odometry
from crosscue.localization.fixes import Fixes
from crosscue.localization.odometry import (
    Increments,
    OdometrySettings,
    TurnSignal,
    WheelSamples,
)
from crosscue.localization.pose_filter import State, major_axis_m
from crosscue.localization.start_pose import START_S, path_of, start_pose
from crosscue.replay.columns import Floats
from crosscue.replay.errors import VehicleError
from crosscue.replay.signals.kinds import Signal
from crosscue.replay.vehicle.vehicle import Topics, Vehicle

HORIZONS_S: Final = (5, 10, 20, 30, 60)
# Length of a part of a long drive; a shorter drive is cut in halves.
PART_S: Final = 85.0
SIMULATED_S: Final = 150.0
SHORT: Final = "short, by wheels"
KINDS: Final = ("straight", "turns", "stop and go", SHORT)
FIX_SD_M: Final = 0.3
# A short drive has no gyro and better positions.
SHORT_S: Final = 60.0
SHORT_FIX_SD_M: Final = 0.1
# Start of a prediction before its first position, and the heading below which a car has moved.
START_SD_M: Final = 30.0
START_SD_RAD: Final = 0.3
MAX_HEADING_VAR_RAD2: Final = 0.2**2
SECOND_NS: Final = 1_000_000_000
# Settings that replace fitted ones in the predictions, not in their starts.
Known: TypeAlias = Mapping[str, Any]
NOTHING: Final[Known] = {}


class Prediction(NamedTuple):
    """NEES of one prediction, with its error in metres along and across the car, and their s.d."""

    drive: str
    fit: int
    part: int
    horizon_s: int
    nees: float
    along_m: float
    along_sd_m: float
    across_m: float
    across_sd_m: float


def predictions(
    name: str, numbers: tuple[int, int], drive: KnownDrive, found: OdometryFit, known_turn: Known
) -> Iterator[Prediction]:
    """Predict a part of a drive, by the fit of another, from starts half a horizon apart."""
    made = drive.increments(found.settings)
    car = found.car._replace(settings=replace(found.settings, **known_turn))
    t_ns = drive.fixes.t_ns
    since_ns = round(START_S * 1e9)
    for horizon_s in HORIZONS_S:
        begin_ns = int(t_ns[0]) + since_ns
        while begin_ns + (horizon_s - 0.7) * 1e9 <= t_ns[-1]:
            until_ns = begin_ns + horizon_s * SECOND_NS + SECOND_NS // 2
            inside = (t_ns >= begin_ns - since_ns) & (t_ns <= until_ns)
            known = int((inside & (t_ns <= begin_ns)).sum())
            part = KnownDrive(drive.wheels, drive.turn, drive.fixes.take(inside), drive.lever_m)
            begin_ns += horizon_s * SECOND_NS // 2
            start = _start(part, known, found, made)
            if start is None:
                continue
            there = part.reckon(start, car, known)
            heading = float(there.heading_rad[-1])
            cos, sin = math.cos(heading), math.sin(heading)
            turned = np.array([[cos, sin], [-sin, cos]])
            along_m, across_m = turned @ (there.xy_m[-1] - part.fixes.xy_m[-1])
            cov = turned @ (there.cov_m2[-1] + np.eye(2) * found.fix_sd_m**2) @ turned.T
            apart = np.array([along_m, across_m])
            nees = float(apart @ np.linalg.solve(cov, apart))
            along_sd_m, across_sd_m = np.sqrt(np.diagonal(cov)).tolist()
            yield Prediction(
                name,
                *numbers,
                horizon_s,
                nees,
                float(along_m),
                along_sd_m,
                float(across_m),
                across_sd_m,
            )


def _start(part: KnownDrive, known: int, found: OdometryFit, made: Increments) -> State | None:
    """A start without knowledge at a good point of linearisation; None if the heading is unknown.

    While a car stands or creeps, the positions' own error looks like motion.
    """
    if known < 2:
        return None
    first = part.fixes.take(slice(0, known))
    cov = np.tile(np.eye(2) * found.fix_sd_m**2, (known, 1, 1))
    at = start_pose(made, Fixes(first.t_ns, first.xy_m, cov), part.lever_m)
    path = path_of(made, first.t_ns, int(first.t_ns[0]))
    reach_m2 = max(float(np.var(path.x_m) + np.var(path.y_m)), 1e-9)
    wander_m2 = found.wander_m_per_sqrt_s**2 * float(part.seconds[known - 1]) / 12.0
    if at.hh + wander_m2 / reach_m2 > MAX_HEADING_VAR_RAD2:
        return None
    xy, heading = START_SD_M**2, START_SD_RAD**2
    pose = at.x_m, at.y_m, at.heading_rad, 0.0
    return State(*pose, xy, 0.0, 0.0, 0.0, xy, 0.0, 0.0, heading, 0.0, 1.0)


def tested(
    name: str, drive: KnownDrive, given: OdometrySettings, fit: int, known_turn: Known
) -> list[Prediction]:
    """Fit each part of a drive and predict its neighbours, with a known noise if there is one."""
    fixes = drive.fixes
    length_s = float(drive.seconds[-1])
    parts = max(round(length_s / PART_S), 2)
    edges = fixes.t_ns[0] + np.linspace(0.0, length_s * 1e9 + 1.0, parts + 1).astype(np.int64)
    found: list[Prediction] = []
    for k in range(parts):
        here = _part(drive, int(edges[k]), int(edges[k + 1]))
        try:
            car = fit_odometry(here, given)
        except VehicleError as error:
            print(f"{name}, part {k}: {error}", flush=True)
            continue
        shown = ", ".join(f"{one.parameter} {one.value:.5g} +- {one.sd:.2g}" for one in car.fitted)
        print(f"{name}, part {k}: {shown}", flush=True)
        for other in (k - 1, k + 1):
            if 0 <= other < parts:
                # The first start of a part needs the positions before it.
                begin_ns = int(edges[other]) - round(START_S * 1e9)
                there = _part(drive, begin_ns, int(edges[other + 1]))
                found += predictions(name, (fit + k, fit + other), there, car, known_turn)
    return found


def _part(drive: KnownDrive, begin_ns: int, end_ns: int) -> KnownDrive:
    fixes = drive.fixes
    inside = fixes.take((fixes.t_ns >= begin_ns) & (fixes.t_ns < end_ns))
    return KnownDrive(drive.wheels, drive.turn, inside, drive.lever_m)


def recorded(log: Path, vehicle: Vehicle, truth: Path | None) -> dict[str, KnownDrive]:
    """Read a recorded drive with its known positions, by the source of its turns."""
    with opened(log) as drive:
        planned = signal_plan(drive.logs, vehicle)
        wanted = [Signal.WHEEL_SPEEDS, Signal.YAW_RATE, Signal.STEERING, Signal.POSITION]
        found = read_signals(drive.logs, planned, vehicle, drive.selection, wanted)
        reference: ReferencePositions
        if truth is not None:
            reference = of_truth(truth, vehicle)
        else:
            gnss = planned.source_of(Signal.POSITION)
            assert gnss is not None
            reference = of_gnss(gnss.topic.name, found[Signal.POSITION], vehicle)
    wheels = wheel_speeds(found[Signal.WHEEL_SPEEDS])
    sources = [signal for signal in (Signal.YAW_RATE, Signal.STEERING) if signal in found]
    turns = [turn_samples(signal, found) for signal in sources]
    if wheels.wheels_mps.shape[1] == 4:
        turns.append(None)
    drives = [KnownDrive(wheels, turn, reference.fixes, reference.lever_m) for turn in turns]
    return {one.source: one for one in drives}


def simulated(kind: str, seed: int) -> KnownDrive:
    """Simulate a drive with positions once a second."""
    settings = DriveSettings(seed=seed, blocks=14)
    motion = true_motion(settings) if kind == "turns" else _motion(kind, seed)
    read = sense(motion, settings)
    rows = slice(None, None, 100)
    fix_sd_m = SHORT_FIX_SD_M if kind == SHORT else FIX_SD_M
    xy = np.column_stack([motion.x_m[rows], motion.y_m[rows]])
    xy += np.random.default_rng([seed, 21]).normal(0.0, fix_sd_m, xy.shape)
    cov = np.tile(np.eye(2) * fix_sd_m**2, (len(xy), 1, 1))
    gyro = TurnSignal(read.gyro_t_ns, read.gyro_radps[:, 2], "yaw rate")
    return KnownDrive(
        WheelSamples(read.wheel_t_ns, read.wheels_mps),
        None if kind == SHORT else gyro,
        Fixes(motion.t_ns[rows], xy, cov),
        (0.0, 0.0),
    )


def _motion(kind: str, seed: int) -> TrueMotion:
    """Return a straight drive at changing speed, or one with stops and gentle bends."""
    rng = np.random.default_rng([seed, 20])
    t_s = np.arange(round((SHORT_S if kind == SHORT else SIMULATED_S) * 100)) * 0.01
    phase = rng.uniform(0.0, 2.0 * np.pi, 2)
    speed = 15.0 + 3.0 * np.sin(2.0 * np.pi * t_s / 40.0 + phase[0])
    yaw = np.zeros(len(t_s))
    if kind == "stop and go":
        speed = np.clip(9.0 * np.sin(2.0 * np.pi * t_s / 30.0 + phase[0]) + 4.0, 0.0, 12.0)
        yaw = 0.004 * speed * np.sin(2.0 * np.pi * t_s / 47.0 + phase[1])
    heading = phase[1] + np.append(0.0, np.cumsum(yaw[:-1] * 0.01))
    middle = heading + 0.005 * yaw
    x = np.append(0.0, np.cumsum(0.01 * speed * np.cos(middle))[:-1])
    y = np.append(0.0, np.cumsum(0.01 * speed * np.sin(middle))[:-1])
    t_ns = START_NS + np.arange(len(t_s), dtype=np.int64) * 10_000_000
    return TrueMotion(t_ns, x, y, heading, speed, yaw)


def table(found: Sequence[Prediction]) -> Iterator[str]:
    """Yield a row for each drive and horizon."""
    yield (
        f"{'drive':24} horizon  parts  predictions   NEES   95 %           "
        "along (s.d.), across (s.d.), m"
    )
    for name in dict.fromkeys(one.drive for one in found):
        for horizon_s in HORIZONS_S:
            of = [one for one in found if (one.drive, one.horizon_s) == (name, horizon_s)]
            if not of:
                continue
            nees = float(np.mean([one.nees for one in of]))
            groups: dict[tuple[int, int], list[float]] = {}
            for one in of:
                groups.setdefault((one.fit, one.part), []).append(one.nees)
            low, high = interval([np.array(part) for part in groups.values()])
            columns = [(one.along_m, one.along_sd_m, one.across_m, one.across_sd_m) for one in of]
            along, along_sd, across, across_sd = np.sqrt(np.mean(np.square(columns), axis=0))
            yield (
                f"{name:24} {horizon_s:5} s {len(groups):6} {len(of):12} {nees:6.2f}   {low:4.2f} "
                f"to {high:5.2f} {along:8.2f} ({along_sd:.2f}) {across:8.2f} ({across_sd:.2f})"
            )


def interval(parts: Sequence[Floats]) -> tuple[float, float]:
    """Return the 95 % interval of the expected NEES, from the predictions of each part.

    The mean of n independent predictions is a multiple of a chi-square variable of 2 n degrees of
    freedom. Every other window of a part is independent of the sensors' noise. All windows have the
    errors of one fit, so n is less; it follows from the scatter between parts, at its upper 90 %
    bound. Few parts cannot show a scatter, and n is their number then.
    """
    count = np.array([len(part) for part in parts])
    mean = float(np.concatenate(parts).mean())
    of_parts = float(np.sum(count**2)) / float(count.sum()) ** 2
    relative_var = of_parts
    if len(parts) > 1:
        freedom = len(parts) - 1
        apart = np.array([part.sum() for part in parts]) - mean * count
        scatter = len(parts) / freedom * float(np.sum(apart**2)) / (mean * count.sum()) ** 2
        bound = scatter * freedom / chi2.ppf(0.1, freedom)
        of_windows = 1.0 / float(np.maximum(count / 2.0, 1.0).sum())
        relative_var = max(of_windows, min(bound, max(of_parts, scatter)))
    total = 2.0 / relative_var
    low, high = mean * total / chi2.ppf([0.975, 0.025], total)
    return float(low), float(high)


def udacity(file: Path) -> tuple[str, KnownDrive, OdometrySettings]:
    """Read a drive of Udacity's challenge 2: speed, steering wheel and GNSS at the pictures' times.

    The car is a Lincoln MKZ. Latitude and longitude are stored as 32-bit numbers, half a metre.
    """
    with file.open(encoding="utf-8", newline="") as text:
        rows = [row for row in csv.DictReader(text) if row["frame_id"] == "center_camera"]
    t_ns = np.array([int(row["timestamp"]) for row in rows])
    names = ("speed", "angle", "lat", "long", "alt")
    columns = {name: np.array([float(row[name]) for row in rows]) for name in names}
    speed, angle, lat, long, alt = columns.values()
    origin = (float(lat[0]), float(long[0]), float(alt[0]))
    xy_m = geodetic_to_enu(lat, long, alt, origin)[:, :2]
    seconds = np.arange(t_ns[0], t_ns[-1], SECOND_NS)
    at = np.searchsorted(t_ns, seconds)
    car = replace(
        odometry_settings(Vehicle(version=1)),
        wheelbase_m=2.85,
        track_width_m=1.58,
        steering_ratio=14.8,
    )
    fixes = Fixes(t_ns[at], xy_m[at], np.tile(np.eye(2), (len(at), 1, 1)))
    wheels = WheelSamples(t_ns, np.column_stack([speed, speed]))
    drive = KnownDrive(wheels, TurnSignal(t_ns, angle, "steering"), fixes, (0.0, 0.0))
    return f"Udacity {file.stem}", drive, car


def smartloc(folder: Path) -> tuple[str, KnownDrive, OdometrySettings]:
    """Read a drive of smartLoc (TU Chemnitz): speed and yaw rate of the car, and true positions.

    The folder has lines of ``libRSF``: ``odom.txt`` of type odom3, ``gt.txt`` of type point3.
    """
    odom, gt = (
        np.loadtxt(folder / f"{name}.txt", usecols=range(1, columns))
        for name, columns in (("odom", 9), ("gt", 5))
    )
    t_ns, true_ns = (np.round(of[:, 0] * 1e9).astype(np.int64) for of in (odom, gt))
    up = gt[0, 1:] / np.linalg.norm(gt[0, 1:])
    east = np.cross([0.0, 0.0, 1.0], up)
    east /= np.linalg.norm(east)
    xy_m = (gt[:, 1:] - gt[0, 1:]) @ np.column_stack([east, np.cross(up, east)])
    at = np.searchsorted(true_ns, np.arange(true_ns[0], true_ns[-1], SECOND_NS))
    fixes = Fixes(true_ns[at], xy_m[at], np.tile(0.01 * np.eye(2), (len(at), 1, 1)))
    wheels = WheelSamples(t_ns, np.column_stack([odom[:, 1], odom[:, 1]]))
    drive = KnownDrive(wheels, TurnSignal(t_ns, odom[:, 6], "yaw rate"), fixes, (0.0, 0.0))
    return "smartLoc, Berlin", drive, odometry_settings(Vehicle(version=1))


def ellipses(drives: dict[str, KnownDrive], given: OdometrySettings) -> Iterator[str]:
    """Yield the ellipse at a drive's end by its gyro, and with the best use of all sources.

    Sources are fused at best as independent yaw rates: their noise and the errors of their biases
    have the inverse of the sum of inverse variances. On a straight drive, a scale of the right
    wheels and an offset of the steering are biases.
    """
    found = {}
    for source, drive in drives.items():
        t_ns = drive.fixes.t_ns
        found[source] = fit_odometry(drive.until(int(t_ns[0] + t_ns[-1]) // 2), given)
    gyro, drive = found["yaw rate"], drives["yaw rate"]
    speed_mps = drive.steps(given).distance_m.sum() / drive.seconds[-1]
    noise, bias = [], []
    for source, fit in found.items():
        sd = dict(zip(fit.constants.names, np.sqrt(np.diagonal(fit.constants.cov)), strict=True))
        made = fit.settings
        per_base = speed_mps / (made.wheelbase_m or 1.0)
        one = {
            "yaw rate": (made.gyro_noise_rad_per_sqrt_s, sd.get("gyro_bias_radps", 0.0)),
            "steering": (
                made.steering_noise_rad_sqrt_m * per_base / math.sqrt(speed_mps),
                sd.get("steering_offset_rad", 0.0) * per_base / made.steering_ratio,
            ),
            "wheels": (
                made.wheel_turn_rad_per_sqrt_m * math.sqrt(speed_mps),
                sd.get("right_wheel_scale", 0.0) * speed_mps / made.track_width_m,
            ),
        }[source]
        yield f"{source}: noise {one[0]:.2g} rad after 1 s, s.d. of the bias {one[1]:.2g} rad/s"
        noise.append(one[0])
        bias.append(one[1])
    best, sure = (float(np.sum(np.power(of, -2.0)) ** -0.5) for of in (noise, bias))
    fused = replace(gyro.settings, gyro_noise_rad_per_sqrt_s=best)
    factor = np.array(
        [sure / bias[0] if n == "gyro_bias_radps" else 1.0 for n in gyro.constants.names]
    )
    less = replace(
        gyro.constants,
        cov=gyro.constants.cov * np.outer(factor, factor),
        cross=gyro.constants.cross * factor,
    )
    for name, car in (
        ("gyro as fitted to the first half", gyro.car),
        ("all sources at best", gyro.car._replace(settings=fused, constants=less)),
        ("gyro without an error of its bias", gyro.car._replace(constants=NO_CONSTANTS)),
    ):
        path = drive.reckon(gyro.start, car)
        (xx, xy), (_, yy) = path.cov_m2[-1].tolist()
        error_m = np.hypot(*(path.xy_m[-1] - drive.fixes.xy_m[-1]))
        yield f"{name}: 2-sigma ellipse {major_axis_m(xx, xy, yy):.1f} m, error {error_m:.2f} m"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--data", type=Path, help="folder of the recorded drives")
    parser.add_argument("--work", type=Path, default=Path("pose_nees"), help="folder for truths")
    parser.add_argument("--simulated", type=int, default=20, help="number of simulated drives")
    parser.add_argument("--first-seed", type=int, default=0, help="seed of the first of them")
    parser.add_argument("--wheel-turn", type=float, help="known noise of the simulated wheels")
    parser.add_argument("--kinds", nargs="+", default=list(KINDS), choices=KINDS)
    parser.add_argument("--udacity", type=Path, nargs="*", default=[], help="interpolated.csv")
    parser.add_argument("--smartloc", type=Path, nargs="*", default=[], help="folder of a drive")
    parser.add_argument("--ellipse", action="store_true", help="only that of the comma minute")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    found: list[Prediction] = []
    if args.ellipse:
        segment, truth, vehicle = comma_minute(args.data, args.work)
        drives = recorded(segment, vehicle, truth)
        print("\n".join(ellipses(drives, odometry_settings(vehicle))))
        return
    if args.data is not None:
        for name, drive, car in real_drives(args.data, args.work):
            found += tested(name, drive, car, 0, NOTHING)
    for file in args.udacity:
        found += tested(*udacity(file), 0, NOTHING)
    for folder in args.smartloc:
        found += tested(*smartloc(folder), 0, NOTHING)
    car = replace(
        odometry_settings(Vehicle(version=1)), track_width_m=TRACK_WIDTH_M, wheelbase_m=WHEELBASE_M
    )
    known_turn = {} if args.wheel_turn is None else {"wheel_turn_rad_per_sqrt_m": args.wheel_turn}
    for kind in args.kinds:
        for seed in range(args.first_seed, args.first_seed + args.simulated):
            drive = simulated(kind, seed)
            found += tested(f"simulated, {kind}", drive, car, 10 * seed, known_turn)
    print("\n".join(table(found)))
    if args.json is not None:
        args.json.write_text(json.dumps([one._asdict() for one in found], indent=1))


def comma_minute(data: Path, work: Path) -> tuple[Path, Path, Vehicle]:
    """Return the segment, its truth and its vehicle."""
    work.mkdir(parents=True, exist_ok=True)
    (segment,) = (data / "comma2k19" / "Example_1").glob("*/40")
    truth = work / "comma2k19"
    if not truth.exists():
        crosscue.write_truth(segment, truth)
    vehicle = work / "rav4.toml"
    if not vehicle.exists():
        crosscue.draft_vehicle(segment, [data / "comma2k19" / "toyota_2017.dbc"], vehicle)
    return segment, truth, crosscue.load_vehicle(vehicle)


def real_drives(data: Path, work: Path) -> Iterator[tuple[str, KnownDrive, OdometrySettings]]:
    """Yield the recorded drives with known positions, by each source of turns."""
    segment, truth, car = comma_minute(data, work)
    for source, drive in recorded(segment, car, truth).items():
        yield f"comma2k19, {source}", drive, odometry_settings(car)
    car = Vehicle(version=1)
    phone = data / "odometry" / "smartphone_compass"
    for source, drive in recorded(phone, car, None).items():
        yield f"phone in a BMW, {source}", drive, odometry_settings(car)
    topics = Topics(odometry="oxts/ins_speed")
    car = Vehicle(version=1, topics=topics)
    kitti = data / "odometry" / "kitti_tracking_0001"
    yield "KITTI tracking 0001", recorded(kitti, car, None)["yaw rate"], odometry_settings(car)


if __name__ == "__main__":
    main()
