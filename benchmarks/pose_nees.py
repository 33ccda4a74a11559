"""Consistency of dead reckoning with fitted odometry, on parts of drives that were not fitted.

Each drive is cut into parts. `fit odometry` is fitted to each part, and the filter, with the fit's
constant errors as states, predicts the next part (and the part before) from the last 15 s of known
positions. The table has the mean NEES of x and y by horizon: 2 is expected, and less means that the
filter is too cautious. Errors of one fit are common to its predictions, so a short drive counts
little more than once; the column "fits" has their number, and "95 %" the range of the mean of as
many independent values.

    python benchmarks/pose_nees.py --data ../shared/data [--simulated 20] [--json nees.json]

Simulated drives have seeds 0, 1, ...; their sensors (`datasets.simulated.drive.sense`) err in ways
of their own: slip that persists for two seconds, and tyres of four sizes.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

import crosscue
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
from crosscue.eval.pipeline.pose import odometry_settings, turn_signal_of
from crosscue.eval.scoring.consistency import mean_band
from crosscue.localization.constants import effects
from crosscue.localization.ekf import PoseBelief, unpack_belief
from crosscue.localization.fit.known_drive import KnownDrive
from crosscue.localization.fit.odometry import FIX_DELAY, OdometryFit, fit_odometry
from crosscue.localization.fixes import Fixes
from crosscue.localization.odometry import (
    Increments,
    OdometrySettings,
    TurnSignal,
    WheelSamples,
    integrate,
)
from crosscue.localization.pose_filter import State, at_point, major_axis_m
from crosscue.localization.pose_track import NO_HEADINGS, TrackSettings, TrackState, advance_pose
from crosscue.localization.position_updates import PositionUpdates
from crosscue.localization.start_pose import START_S, start_pose
from crosscue.replay.errors import VehicleError
from crosscue.replay.signals.kinds import Signal
from crosscue.replay.vehicle.vehicle import Topics, Vehicle

HORIZONS_S: Final = (5, 10, 20, 30, 60)
# Length of a part of a long drive; a shorter drive is cut in halves.
PART_S: Final = 85.0
SIMULATED_S: Final = 150.0
KINDS: Final = ("straight", "turns", "stop and go")
FIX_SD_M: Final = 0.3
# Start of a prediction before its first position, and the heading below which a car has moved.
START_SD_M: Final = 30.0
START_SD_RAD: Final = 0.3
MAX_HEADING_VAR_RAD2: Final = 0.2**2
SECOND_NS: Final = 1_000_000_000


class Prediction(NamedTuple):
    """NEES of one prediction, and its error and major axis in metres."""

    drive: str
    fit: int
    horizon_s: int
    nees: float
    error_m: float
    axis_m: float


def predictions(name: str, fit: int, drive: KnownDrive, found: OdometryFit) -> Iterator[Prediction]:
    """Predict a part of a drive from starts that are a horizon apart."""
    delay_ns, car = round(found.value(FIX_DELAY) * 1e9), found.settings
    cov = np.eye(2) * found.fix_sd_m**2
    t_ns, xy_m = drive.fixes.t_ns - delay_ns, drive.fixes.xy_m
    fixes = Fixes(t_ns, xy_m, np.tile(cov, (len(t_ns), 1, 1)))
    made = integrate(drive.wheels, car, drive.turn).increments
    for horizon_s in HORIZONS_S:
        begin_ns = int(t_ns[0]) + round(START_S * 1e9)
        while begin_ns + (horizon_s - 0.7) * 1e9 <= t_ns[-1]:
            since_ns, until_ns = begin_ns - round(START_S * 1e9), begin_ns + horizon_s * SECOND_NS
            before = fixes.take((t_ns <= begin_ns) & (t_ns >= since_ns))
            last = int(np.flatnonzero(t_ns <= until_ns + SECOND_NS // 2)[-1])
            begin_ns += horizon_s * SECOND_NS
            if len(before) < 2 or start_pose(made, before, drive.lever_m).hh > MAX_HEADING_VAR_RAD2:
                continue
            there = predicted(found, made, before, drive.lever_m, int(t_ns[last]))
            apart = there.mean[:2] - xy_m[last]
            (xx, xy), (_, yy) = there.cov[:2, :2].tolist()
            nees = float(apart @ np.linalg.solve(there.cov[:2, :2] + cov, apart))
            yield Prediction(
                name, fit, horizon_s, nees, float(np.hypot(*apart)), major_axis_m(xx, xy, yy)
            )


def predicted(
    found: OdometryFit,
    made: Increments,
    before: Fixes,
    lever_m: tuple[float, float],
    at_ns: int,
) -> PoseBelief:
    """Run the filter through known positions, and on to a time; the antenna's pose there."""
    # A start without knowledge, at a good point of linearisation.
    start = start_pose(made, before, lever_m)
    sd = np.array([START_SD_M, START_SD_M, START_SD_RAD, 1.0])
    mean = np.array([start.x_m, start.y_m, start.heading_rad, 0.0])
    belief = PoseBelief(int(before.t_ns[0]), mean, np.diag(sd**2))
    constants = replace(found.constants, cross=np.zeros_like(found.constants.cross))
    updates = PositionUpdates(lever_m, gate_nis=math.inf)
    updates.add(before)
    inside = (made.stop_ns > belief.t_ns) & (made.start_ns <= at_ns)
    columns = {f.name: getattr(made, f.name)[inside] for f in fields(made)}
    some = Increments(**columns)
    by = effects(some, found.settings, constants.names)
    state = TrackState(belief, constants=constants)
    rows = np.array([at_ns])
    poses = advance_pose(state, some, TrackSettings(), NO_HEADINGS, rows, updates, by).poses
    xx, xy, xh, yy, yh, hh = poses.cov_xyh[0].tolist()
    x, y, heading = float(poses.x_m[0]), float(poses.y_m[0]), float(poses.heading_rad[0])
    axle = State(x, y, heading, 0.0, xx, xy, xh, 0.0, yy, yh, 0.0, hh, 0.0, 0.0)
    return unpack_belief(at_ns, at_point(axle, *lever_m))


def tested(name: str, drive: KnownDrive, given: OdometrySettings, fit: int) -> list[Prediction]:
    """Fit each part of a drive and predict its neighbours."""
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
                found += predictions(name, fit + k, there, car)
    return found


def _part(drive: KnownDrive, begin_ns: int, end_ns: int) -> KnownDrive:
    fixes = drive.fixes
    inside = fixes.take((fixes.t_ns >= begin_ns) & (fixes.t_ns < end_ns))
    return KnownDrive(drive.wheels, drive.turn, inside, drive.lever_m)


def recorded(log: Path, vehicle: Vehicle, truth: Path | None) -> KnownDrive:
    """Read a recorded drive with its known positions."""
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
        turn = turn_samples(turn_signal_of(planned, vehicle), found)
    wheels = wheel_speeds(found[Signal.WHEEL_SPEEDS])
    return KnownDrive(wheels, turn, reference.fixes, reference.lever_m)


def simulated(kind: str, seed: int) -> KnownDrive:
    """Simulate a drive with positions of ``FIX_SD_M`` once a second."""
    settings = DriveSettings(seed=seed, blocks=14)
    motion = true_motion(settings) if kind == "turns" else _motion(kind, seed)
    read = sense(motion, settings)
    rows = slice(None, None, 100)
    xy = np.column_stack([motion.x_m[rows], motion.y_m[rows]])
    xy += np.random.default_rng([seed, 21]).normal(0.0, FIX_SD_M, xy.shape)
    cov = np.tile(np.eye(2) * FIX_SD_M**2, (len(xy), 1, 1))
    return KnownDrive(
        WheelSamples(read.wheel_t_ns, read.wheels_mps),
        TurnSignal(read.gyro_t_ns, read.gyro_radps[:, 2], "yaw rate"),
        Fixes(motion.t_ns[rows], xy, cov),
        (0.0, 0.0),
    )


def _motion(kind: str, seed: int) -> TrueMotion:
    """Return a straight drive at changing speed, or one with stops and gentle bends."""
    rng = np.random.default_rng([seed, 20])
    t_s = np.arange(round(SIMULATED_S * 100)) * 0.01
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
    yield f"{'drive':24} horizon   fits  predictions   NEES   95 %           error   ellipse"
    for name in dict.fromkeys(one.drive for one in found):
        for horizon_s in HORIZONS_S:
            of = [one for one in found if (one.drive, one.horizon_s) == (name, horizon_s)]
            if not of:
                continue
            nees = float(np.mean([one.nees for one in of]))
            fits = len({one.fit for one in of})
            low, high = mean_band(2, fits)
            error_m = math.sqrt(float(np.mean([one.error_m**2 for one in of])))
            axis_m = float(np.mean([one.axis_m for one in of]))
            yield (
                f"{name:24} {horizon_s:5} s {fits:6} {len(of):12} {nees:6.2f}   {low:4.2f} to "
                f"{high:4.2f} {error_m:7.2f} m {axis_m:7.2f} m"
            )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--data", type=Path, help="folder of the recorded drives")
    parser.add_argument("--work", type=Path, default=Path("pose_nees"), help="folder for truths")
    parser.add_argument("--simulated", type=int, default=20, help="number of simulated drives")
    parser.add_argument("--first-seed", type=int, default=0, help="seed of the first of them")
    parser.add_argument("--kinds", nargs="+", default=list(KINDS), choices=KINDS)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    found: list[Prediction] = []
    if args.data is not None:
        for name, drive, car in real_drives(args.data, args.work):
            found += tested(name, drive, car, 0)
    car = replace(
        odometry_settings(Vehicle(version=1)), track_width_m=TRACK_WIDTH_M, wheelbase_m=WHEELBASE_M
    )
    for kind in args.kinds:
        for seed in range(args.first_seed, args.first_seed + args.simulated):
            found += tested(f"simulated, {kind}", simulated(kind, seed), car, 10 * seed)
    print("\n".join(table(found)))
    if args.json is not None:
        args.json.write_text(json.dumps([one._asdict() for one in found], indent=1))


def real_drives(data: Path, work: Path) -> Iterator[tuple[str, KnownDrive, OdometrySettings]]:
    """Yield the recorded drives with known positions."""
    work.mkdir(parents=True, exist_ok=True)
    (segment,) = (data / "comma2k19" / "Example_1").glob("*/40")
    truth = work / "comma2k19"
    if not truth.exists():
        crosscue.write_truth(segment, truth)
    vehicle = work / "rav4.toml"
    if not vehicle.exists():
        crosscue.draft_vehicle(segment, [data / "comma2k19" / "toyota_2017.dbc"], vehicle)
    car = crosscue.load_vehicle(vehicle)
    yield "comma2k19", recorded(segment, car, truth), odometry_settings(car)
    car = Vehicle(version=1)
    phone = data / "odometry" / "smartphone_compass"
    yield "phone in a BMW", recorded(phone, car, None), odometry_settings(car)
    topics = Topics(odometry="oxts/ins_speed")
    car = Vehicle(version=1, topics=topics)
    kitti = data / "odometry" / "kitti_tracking_0001"
    yield "KITTI tracking 0001", recorded(kitti, car, None), odometry_settings(car)


if __name__ == "__main__":
    main()
