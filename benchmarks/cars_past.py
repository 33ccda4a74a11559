"""Reasons why the cues of oncoming and outgoing cars miss frames of PandaSet's sequence 002.

Run it as ``python benchmarks/cars_past.py RUN SEQUENCE``. RUN is a run of ``replay`` over SEQUENCE,
which has its 3-D boxes in ``annotations/cuboids.parquet``. Frames with a car that moves past the
far kerb count. The reason of a missed frame is the first unmet condition of the rule, for the car
that meets most of them.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from annotate_pandaset import (  # type: ignore[import-not-found]  # a script next to this one
    BEHIND_M,
    FAR_KERB_M,
    VehicleBoxes,
)

from crosscue.datasets.adapters.pandaset import read_pandaset_poses
from crosscue.detectors.base import Detections
from crosscue.detectors.boxes import box_ious
from crosscue.detectors.cues.observed import Place
from crosscue.detectors.cues.tracked.judge import (
    COMES_OR_GOES,
    MAX_SLANT,
    MIN_LONG,
    cars_past,
    is_past,
)
from crosscue.detectors.cues.tracked.motion import CarMotion
from crosscue.detectors.cues.tracked.tracks import CarTracks
from crosscue.eval.pipeline.scene.stage import EgoMotion
from crosscue.eval.runs.folder import RunFolder, open_run
from crosscue.eval.runs.tables.stored_frames import stored_frames
from crosscue.eval.runs.tables.travelled import odometer_of
from crosscue.replay.vehicle.vehicle import Vehicle

MIN_IOU = 0.3
FOUND = "found"
# Names of unmet conditions, from the last condition of the rule to the first.
REASONS = (
    "not surely past the far kerb",
    "speed not surely above 2 m/s",
    "too far aside, slanting, or narrower than high",
    "no steady motion",
    "lower end behind another car",
    "followed in fewer than three frames",
    "detected with too low a score, or for the first time",
    "not detected",
)


class Missed(NamedTuple):
    """A missed frame: the reason, and distance and visible fraction of the best car."""

    reason: str
    distance_m: float
    visible: float


def reason_of(car: CarMotion, vehicle: Vehicle, place: Place | None) -> str:
    """Return the first condition that a tracked car does not meet; ``FOUND`` if it meets all."""
    rules, ahead_mps = vehicle.cars, abs(car.ahead_mps)
    is_aside = abs(car.bearing) * car.distance_m > rules.past_aside_m
    failed = (
        place is None or not is_past(car, vehicle.camera, place),
        ahead_mps <= max(rules.crossing_mps, COMES_OR_GOES * car.ahead_sd_mps),
        is_aside or car.long < MIN_LONG or abs(car.right_mps) > MAX_SLANT * ahead_mps,
        not car.is_steady,
        car.is_hidden,
        car.frames < rules.min_frames,
    )
    unmet = [name for name, is_failed in zip(REASONS, failed, strict=False) if is_failed]
    return unmet[-1] if unmet else FOUND


def places(run: RunFolder) -> dict[int, Place]:
    """Return the position of the intersection after each frame, by time."""
    found: dict[int, dict[str, tuple[float, float]]] = {}
    for row in run.table("range").to_pylist():
        known = found.setdefault(row["t_ns"], {})
        known[row["reference"]] = (row["range_m"], row["var_m2"] ** 0.5)
    return {
        t_ns: Place(known.get("start", known["end"])[0], known["end"][0], known["end"][1])
        for t_ns, known in found.items()
        if "end" in known
    }


def owner(box_px: Sequence[float], boxes: VehicleBoxes, rows: np.ndarray) -> int | None:
    """Return the row of the 3-D box that a box in the picture overlaps most."""
    overlaps = [float(box_ious(boxes.outline_px[row], np.asarray(box_px))) for row in rows]
    best = int(np.argmax(overlaps)) if overlaps else 0
    return int(rows[best]) if overlaps and overlaps[best] > MIN_IOU else None


def why_missed(
    row: int,
    boxes: VehicleBoxes,
    rows: np.ndarray,
    cars: Sequence[CarMotion],
    seen: Sequence[Detections],
    vehicle: Vehicle,
    place: Place | None,
) -> str:
    """Return the reason why one true car of a frame does not count."""

    def is_same(box_px: Sequence[float]) -> bool:
        found = owner(box_px, boxes, rows)
        # Most cars have two 3-D boxes.
        return found is not None and bool(
            np.hypot(*(boxes.at_m[found] - boxes.at_m[row])) < BEHIND_M
        )

    reasons = [reason_of(car, vehicle, place) for car in cars if is_same(car.box_px)]
    if reasons:
        return min(reasons, key=(FOUND, *REASONS).index)
    is_detected = any(is_same(box) for one in seen for box in one.boxes_px.tolist())
    return REASONS[-2] if is_detected else REASONS[-1]


def main() -> None:
    """Print the number of frames missed for each reason, for both directions."""
    run, sequence = open_run(Path(sys.argv[1])), Path(sys.argv[2])
    manifest, poses = run.drive_manifest(), read_pandaset_poses(sequence)
    assert manifest.detected is not None
    vehicle, boxes = manifest.settings, VehicleBoxes(sequence, poses)
    steps = np.linalg.norm(np.diff(poses.xyz_m[:, :2], axis=0), axis=1)
    gone_m = np.concatenate([[0.0], np.cumsum(steps)])
    at, ego = places(run), EgoMotion(odometer_of(run))
    tracks, place = CarTracks(vehicle.camera, vehicle.cars), None
    missed: dict[str, list[Missed]] = {"oncoming": [], "outgoing": []}
    found: Counter[str] = Counter()
    for frame, stored in enumerate(stored_frames(run, manifest.detected, vehicle)):
        _, motion = ego(stored.t_ns)
        tracks(stored.objects, motion)
        cars = tracks.longer()
        if place is not None:
            way_m = motion.way_m or 0.0
            place = Place(place.start_m - way_m, place.end_m - way_m, place.sd_m)
        ways = cars_past(cars, vehicle.camera, vehicle.cars, place)
        rows = np.flatnonzero(boxes.frame == frame)
        is_beyond = boxes.ahead_m + gone_m[boxes.frame] > FAR_KERB_M
        for name, some in missed.items():
            if ways is not None and getattr(ways, name):
                found[name] += 1
                continue
            is_here = is_beyond & boxes.along(oncoming=name == "oncoming") & (boxes.frame == frame)
            whys = [
                Missed(
                    why_missed(row, boxes, rows, cars, stored.objects, vehicle, place),
                    float(boxes.ahead_m[row]),
                    float(boxes.visible[row]),
                )
                for row in np.flatnonzero(is_here).tolist()
            ]
            if whys:
                some.append(min(whys, key=lambda one: (FOUND, *REASONS).index(one.reason)))
        place = at.get(stored.t_ns)
    for name, some in missed.items():
        print(f"{name}: {found[name]} frames found, {len(some)} missed")
        for reason in REASONS:
            those = [one for one in some if one.reason == reason]
            if those:
                near_m, far_m = (pick(one.distance_m for one in those) for pick in (min, max))
                half = sum(one.visible >= 0.5 for one in those)
                print(
                    f"  {len(those):3} {reason} "
                    f"({near_m:.0f} to {far_m:.0f} m; at least half visible in {half})"
                )


if __name__ == "__main__":
    main()
