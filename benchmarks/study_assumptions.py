"""Sensitivity of the studies to assumptions that the source leaves open, one at a time.

    python benchmarks/study_assumptions.py [--only field|nees|landmarks] [--drives 200]
        [--field-drives 400] [--nees-drives 20000] [--seed 77]

The first part is the field protocol's range runs: distance at loss. The second is the consistency
of the filter, with the studied encoders and with fine ones. The third is the landmark study on its
25 pairs of density and rate: the extra distance of the other two strategies over straight to goal,
averaged in three ways. Seeds differ from those of the studies and of the calibration, and all rows
use the same seeds. It takes about five CPU minutes.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from crosscue.eval.scoring.consistency import mean_band
from crosscue.eval.studies.intervals import km, mean_of, percent
from crosscue.eval.studies.town.landmark_study import summarise_landmarks
from crosscue.eval.studies.town.range_study import law_m
from crosscue.eval.studies.town.settings import UNTIL_LOST, FieldStudy, LandmarkStudy
from crosscue.eval.studies.town.work import chunks_of
from crosscue.localization.town.drive import (
    DriveOutcome,
    DriveResult,
    Keys,
    drive_many,
    drive_traced,
)
from crosscue.localization.town.random_stream import key_of
from crosscue.localization.town.settings import City, Navigation, Sensors, TownDrive
from support.beliefs import nees_along_the_arc

NEES = DriveResult._fields.index("nees")
FINE_M = 1e-4
PARTS = ("field", "nees", "landmarks")
LANDMARKS = {
    "as studied": TownDrive(),
    "penalty 10 degrees (45)": TownDrive(navigation=Navigation(penalty_deg=10.0)),
    "penalty 180 degrees": TownDrive(navigation=Navigation(penalty_deg=180.0)),
    "intersections recognised within 15 m (30)": TownDrive(
        navigation=Navigation(recognise_within_m=15.0)
    ),
    "intersections recognised within 60 m": TownDrive(
        navigation=Navigation(recognise_within_m=60.0)
    ),
    "landmark or goal given up within 5 m (20)": TownDrive(
        navigation=Navigation(arrive_within_m=5.0)
    ),
    "landmark or goal given up within 50 m": TownDrive(navigation=Navigation(arrive_within_m=50.0)),
    "landmark position 1 m s.d. (5)": TownDrive(sensors=Sensors(landmark_sd_m=1.0)),
    "landmark position 20 m s.d.": TownDrive(sensors=Sensors(landmark_sd_m=20.0)),
    "blocks 50 to 100 m (50 to 300)": TownDrive(city=City(longest_block_m=100.0)),
    "blocks 200 to 300 m": TownDrive(city=City(shortest_block_m=200.0)),
    "no dead ends (3 %)": TownDrive(city=City(dead_end_fraction=0.0)),
    "dead ends 15 %": TownDrive(city=City(dead_end_fraction=0.15)),
    "no one-way streets (15 %)": TownDrive(city=City(one_way_fraction=0.0)),
    "one-way streets 50 %": TownDrive(city=City(one_way_fraction=0.5)),
    "all cities 10 km2 (1 to 100)": TownDrive(city=City(smallest_km2=10.0, largest_km2=10.0)),
    "all cities 100 km2": TownDrive(city=City(smallest_km2=100.0)),
}
FIELD = {
    "as studied": FieldStudy(),
    "compass 30 degrees (25)": FieldStudy(compass_2sigma_deg=30.0),
    "blocks 50 to 100 m (50 to 300)": FieldStudy(drive=TownDrive(city=City(longest_block_m=100.0))),
    "blocks 200 to 300 m": FieldStudy(drive=TownDrive(city=City(shortest_block_m=200.0))),
    "town of 4 km2 (1)": FieldStudy(town_km2=4.0),
    "town of 25 km2": FieldStudy(town_km2=25.0),
    "wheels slip a third (0.003)": FieldStudy(
        drive=TownDrive(sensors=Sensors(slip_per_sqrt_m=0.001))
    ),
    "wheels slip three times": FieldStudy(drive=TownDrive(sensors=Sensors(slip_per_sqrt_m=0.009))),
    "wheels slip ten times": FieldStudy(drive=TownDrive(sensors=Sensors(slip_per_sqrt_m=0.03))),
    "compass errors last 3.6 m (1.876)": FieldStudy(
        drive=TownDrive(sensors=Sensors(compass_interval_m=3.6))
    ),
}


def landmarks(drives: int, seed: int) -> None:
    print(f"farther than straight to goal, {drives} drives in each of 25 x 3 cells, seed {seed}")
    print(f"{'':42} {'reached by both':>24} {'reached, each its own':>24} {'all drives':>24}")
    for name, drive in LANDMARKS.items():
        study = LandmarkStudy(drives=drives, drive=drive, points=(), seed=seed)
        parts: dict[int, list[np.ndarray[tuple[int, int], np.dtype[np.float64]]]] = {}
        for chunk in chunks_of(study.cases(), drives, seed):
            parts.setdefault(chunk.case, []).append(drive_many(chunk.settings, chunk.seeds()))
        rows = [
            dict(zip(DriveResult._fields, np.concatenate(parts[case]).T, strict=True))
            for case in sorted(parts)
        ]
        for compared in summarise_landmarks(study, rows).comparisons:
            print(
                f"{name:42} {percent(compared.extra):>24} {percent(compared.extra_reached):>24} "
                f"{percent(compared.extra_all):>24}  {compared.strategy}"
            )
            name = ""


def field(drives: int, seed: int) -> None:
    print(f"\nrange runs of the field protocol, {drives} each, seed {seed}")
    print(f"{'':42} {'lost after, km':>24} {'lost within 75 minutes':>24}")
    for name, study in FIELD.items():
        rows = drive_many(study.settings(has_landmarks=False), seeds_of(seed, drives))
        lost = rows[rows[:, 0] == DriveOutcome.LOST, 1]
        print(f"{name:42} {km(mean_of(lost), 1):>24} {100 * len(lost) / drives:22.0f} %")
    straight_m = law_m(FieldStudy().settings(has_landmarks=False))
    print(f"straight driving as studied, by the law r ds D: {straight_m / 1e3:.1f} km")


def nees(drives: int, seed: int) -> None:
    print(f"\nmean NEES of x, y, heading at the end, 3 for a consistent filter; seed {seed}")
    print(f"{'':42} {'as studied':>24} {f'encoders of {FINE_M * 1e3:g} mm':>24} {'consistent':>18}")
    fewer = 3 * drives // 40
    for name, compass_deg, goals, count in (
        ("10 degrees, to the goal", 10.0, 1, drives),
        ("20 degrees, to the goal", 20.0, 1, drives),
        ("30 degrees, to the goal", 30.0, 1, drives),
        ("10 degrees, 60 km", 10.0, UNTIL_LOST, fewer),
        ("20 degrees, until lost", 20.0, UNTIL_LOST, drives // 5),
        ("30 degrees, until lost", 30.0, UNTIL_LOST, 2 * drives // 5),
        ("no compass, to the goal", None, 1, drives),
    ):
        both = [
            drive_many(one, seeds_of(seed, count)) for one in coarse_and_fine(compass_deg, goals)
        ]
        reported(name, count, [float(rows[:, NEES].mean()) for rows in both])
    reported(
        "no compass, errors along an arc",
        fewer,
        [
            float(
                np.mean(
                    [
                        nees_along_the_arc(drive_traced(one, int(s)).steps[-1])
                        for s in seeds_of(seed, fewer)
                    ]
                )
            )
            for one in coarse_and_fine(None, 1)
        ],
    )


def coarse_and_fine(compass_deg: float | None, goals: int) -> list[TownDrive]:
    return [
        TownDrive(
            sensors=Sensors(compass_2sigma_deg=compass_deg, encoder_step_m=step_m), goals=goals
        )
        for step_m in (Sensors().encoder_step_m, FINE_M)
    ]


def reported(name: str, count: int, means: list[float]) -> None:
    low, high = mean_band(3, count)
    print(
        f"{f'{name}, {count}':42} {means[0]:24.2f} {means[1]:24.2f} {f'{low:.2f}..{high:.2f}':>18}"
    )


def seeds_of(seed: int, count: int) -> Keys:
    return np.array([key_of(seed, i) for i in range(count)], dtype=np.uint64)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", choices=PARTS)
    parser.add_argument("--drives", type=int, default=200)
    parser.add_argument("--field-drives", type=int, default=400)
    parser.add_argument("--nees-drives", type=int, default=20_000)
    parser.add_argument("--seed", type=int, default=77)
    args = parser.parse_args()
    parts = PARTS if args.only is None else (args.only,)
    if "field" in parts:
        field(args.field_drives, args.seed)
    if "nees" in parts:
        nees(args.nees_drives, args.seed)
    if "landmarks" in parts:
        landmarks(args.drives, args.seed)


if __name__ == "__main__":
    main()
