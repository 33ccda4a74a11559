"""Tracked cars with perfect boxes: precision and recall of each cue, and the rejecting conditions.

Run it as ``python benchmarks/tracked_cars.py DRIVES [LAYOUTS]`` on drives of ``crosscue simulate``;
LAYOUTS, such as ``ACEG``, are the first letters of the drives to use. Every car of
``objects.json`` that is at least half visible becomes a detection with its true mask. The ego
motion and the position of the intersection are also true, so all errors are those of the rule.
"""

from __future__ import annotations

import csv
import json
import math
import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from crosscue.datasets.truth.truth import read_truth
from crosscue.detectors.cues.observed import Place
from crosscue.detectors.cues.tracked.judge import along, count_cars, crossing_gates, is_past
from crosscue.detectors.cues.tracked.motion import CarMotion
from crosscue.detectors.cues.tracked.tracks import CarTracks
from crosscue.detectors.ranging.object_tracks import CarStep
from crosscue.eval.scoring.intervals import wilson
from crosscue.replay.vehicle.vehicle import Vehicle
from crosscue.replay.vehicle.vehicle import load as load_vehicle
from support.perfect_boxes import frames, is_there

VISIBLE = 0.5
# Standard deviation assumed for the true range, as of a good estimate.
PLACE_SD_M = 2.0


class Totals(NamedTuple):
    """Counts over all drives: (cue, counted, true), and rejecting conditions by cue."""

    rows: Counter[tuple[str, bool, bool]]
    gates: Counter[str]


class TrueCar(NamedTuple):
    """One car of ``objects.json`` in one frame: its motion, distance ahead and box."""

    role: str
    distance_m: float
    box_px: tuple[float, float, float, float]


def true_cars(drive: Path) -> dict[int, list[TrueCar]]:
    """Return the sufficiently visible cars of each frame, by time."""
    content = json.loads((drive / "objects.json").read_text())
    times = {one["id"]: one["t_ns"] for one in content["images"]}
    cars: dict[int, list[TrueCar]] = {t_ns: [] for t_ns in times.values()}
    for one in content["annotations"]:
        if "role" in one and one["visible"] >= VISIBLE:
            x, y, width, height = one["bbox"]
            box = (x, y, x + width, y + height)
            cars[times[one["image_id"]]].append(TrueCar(one["role"], one["distance_m"], box))
    return cars


def motions(drive: Path) -> dict[int, CarStep]:
    """Return the true motion of the rear axle since the previous frame, by time."""
    found = {}
    last: tuple[float, float, float, int] | None = None
    for line in (drive / "pose.tum").read_text().splitlines():
        if line.startswith("#"):
            continue
        t_s, x, y, _, _, _, qz, qw = map(float, line.split())
        here = (x, y, 2.0 * math.atan2(qz, qw), round(t_s * 1e9))
        if last is not None:
            turned = math.remainder(here[2] - last[2], 2.0 * math.pi)
            ahead = (x - last[0]) * math.cos(last[2]) + (y - last[1]) * math.sin(last[2])
            way_m = math.copysign(math.dist(here[:2], last[:2]), ahead)
            found[here[3]] = CarStep(way_m, 1e-4, turned, (here[3] - last[3]) * 1e-9)
        last = here
    return found


def places(drive: Path) -> dict[int, Place]:
    """Return the true position of the intersection in each frame, by time."""
    with (drive / "ranges.csv").open() as file:
        return {
            int(row["t_ns"]): Place(float(row["start_m"]), float(row["end_m"]), PLACE_SD_M)
            for row in csv.DictReader(file)
            if row["start_m"] and row["end_m"]
        }


def judge_drive(drive: Path, totals: Totals) -> None:
    """Count a drive: cross traffic and parked cars by frame, the other cues by car."""
    truth, vehicle = read_truth(drive / "truth.json"), load_vehicle(drive / "vehicle.toml")
    camera, settings = vehicle.camera, vehicle.cars
    moved, at, known = motions(drive), places(drive), true_cars(drive)
    times = np.array(sorted(moved))
    tracks = CarTracks(camera, settings)
    last_ns: int | None = None
    for found in frames(drive, VISIBLE):
        ego = _between(moved, times, last_ns, found.t_ns)
        last_ns = found.t_ns
        if ego is None:
            continue
        cars, place = tracks([found], ego), at.get(found.t_ns)
        one = count_cars(cars, tracks.standing(), tracks.seen, camera, settings, place)
        for name, sides in (("cross_traffic", one.crossing), ("parked", one.parked)):
            for side in ("left", "right"):
                there = is_there(truth, f"{name}_{side}", found.t_ns)
                if there is not None:
                    totals.rows[name, getattr(sides, side) > 0, there] += 1
        for car in cars:
            true = known_as(car, known[found.t_ns])
            if true is not None and true.role == "cross":
                failed = crossing_gates(car, settings)
                totals.gates[" and ".join(failed) or "counted"] += 1
        if place is not None and place.end_m > 0.0:
            _past(tracks.longer(), known[found.t_ns], place, vehicle, totals)


def _past(
    cars: Sequence[CarMotion],
    known: Sequence[TrueCar],
    place: Place,
    vehicle: Vehicle,
    totals: Totals,
) -> None:
    """Count oncoming and outgoing cars past the end of the intersection, one by one."""
    counted = [car for car in along(cars, vehicle.cars) if is_past(car, vehicle.camera, place)]
    named = Counter[TrueCar]()
    for car in counted:
        name = "outgoing" if car.ahead_mps > 0.0 else "oncoming"
        true = known_as(car, known)
        is_right = true is not None and true.role == name
        is_beyond = true is not None and true.distance_m + vehicle.camera.x_m > place.end_m
        totals.rows[name, True, is_right and is_beyond] += 1
        if true is not None and is_right and is_beyond:
            named[true] += 1
    for true in known:
        is_beyond = true.distance_m + vehicle.camera.x_m > place.end_m
        if true.role in ("oncoming", "outgoing") and is_beyond and not named[true]:
            totals.rows[true.role, False, True] += 1


def known_as(car: CarMotion, known: Sequence[TrueCar]) -> TrueCar | None:
    """Return the true car that has the box of a tracked car."""
    return next((one for one in known if np.allclose(one.box_px, car.box_px, atol=0.5)), None)


def _between(
    moved: dict[int, CarStep], times: np.ndarray, last_ns: int | None, t_ns: int
) -> CarStep | None:
    if last_ns is None:
        return CarStep(0.0, 0.0, 0.0, 0.1)
    some = [moved[int(t)] for t in times[(times > last_ns) & (times <= t_ns)]]
    if not some:
        return None
    return CarStep(
        sum(one.way_m or 0.0 for one in some),
        sum(one.var_m2 for one in some),
        sum(one.turned_rad for one in some),
        (t_ns - last_ns) * 1e-9,
    )


def main() -> None:
    """Print both for the selected layouts."""
    letters = sys.argv[2] if len(sys.argv) > 2 else "ABCDEFGHIJKLMNOPQRSTUVWXYZ"
    drives = sorted(
        path.parent
        for path in Path(sys.argv[1]).glob("*/objects.json")
        if path.parent.name[0] in letters
    )
    totals = Totals(Counter(), Counter())
    for drive in drives:
        judge_drive(drive, totals)
    print(f"{len(drives)} simulated drives: {' '.join(one.name for one in drives)}")
    for cue in sorted({cue for cue, _, _ in totals.rows}):
        right, wrong, missed = (
            totals.rows[cue, *key] for key in ((True, True), (True, False), (False, True))
        )
        low, high = wilson(right, right + wrong)
        print(
            f"  {cue:14} precision {right} of {right + wrong} ({low:.2f} to {high:.2f}); "
            f"recall {right} of {right + missed}"
        )
    print("true cars of the crossroad that move, by what the rule says:")
    for gate, count in totals.gates.most_common(12):
        print(f"  {count:5} {gate}")


if __name__ == "__main__":
    main()
