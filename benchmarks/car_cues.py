"""False car cues of a simulated study: each positive car compared with the true car.

Run it as ``python benchmarks/car_cues.py STUDY`` on the folder of ``crosscue study intersections``.
Every car that counted as cross traffic (eq. 15) or parked (eq. 16) is matched with the nearest true
car of the drive's ``objects.json``, and counted by the motion of that car.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from crosscue.datasets.truth.truth import Truth, read_truth
from crosscue.detectors.cues.cars import (
    CarShapes,
    car_shapes,
    cross_traffic,
    pair_cars,
    parked_cars,
)
from crosscue.eval.runs.folder import RunFolder, open_run
from crosscue.eval.runs.tables.stored_frames import stored_frames
from crosscue.eval.scoring.truth import cue_at
from crosscue.replay.vehicle.vehicle import Vehicle
from support.perfect_boxes import role_at, true_cars


def claims(run: RunFolder, vehicle: Vehicle) -> Iterator[tuple[int, str, float, float]]:
    """Yield time, cue and image position of every car that counted for a cue."""
    found = run.drive_manifest().detected
    assert found is not None
    before: CarShapes | None = None
    rules = vehicle.cars
    for frame in stored_frames(run, found, vehicle):
        now = car_shapes(frame.objects, rules)
        if before is not None:
            pairs = pair_cars(before, now, rules)
            for i, (x, y) in enumerate(pairs.center_px.tolist()):
                part = slice(i, i + 1)
                one = replace(pairs, step_px=pairs.step_px[part], nose=pairs.nose[part])
                reported = {
                    "cross_traffic": cross_traffic(one, rules),
                    "parked": parked_cars(one, rules),
                }
                for cue, (left, right) in reported.items():
                    if left or right:
                        yield now.t_ns, f"{cue}_{'left' if left else 'right'}", x, y
        before = now


def is_true(truth: Truth, cue: str, t_ns: int) -> bool | None:
    """Return the truth of the cue in the frame, independent of the car; None if unknown."""
    at = cue_at([one for one in truth.cues if one.cue == cue], np.array([t_ns], np.int64))
    return None if at.present[0] < 0 else bool(at.present[0])


def main() -> None:
    """Count over all drives of the study."""
    study = Path(sys.argv[1])
    right: Counter[str] = Counter()
    wrong: dict[str, Counter[str]] = {}
    runs = sorted(path.parent for path in (study / "runs").glob("*/manifest.json"))
    for path in runs:
        run, drive = open_run(path), study / "drives" / path.name
        truth, cars = read_truth(drive / "truth.json"), true_cars(drive)
        for t_ns, cue, x, y in claims(run, run.drive_manifest().settings):
            kind = cue.rpartition("_")[0]
            verdict = is_true(truth, cue, t_ns)
            if verdict:
                right[kind] += 1
            elif verdict is False:
                wrong.setdefault(kind, Counter())[role_at(cars.get(t_ns, []), x, y)] += 1
    print(f"{len(runs)} simulated drives; cars that counted, one by one")
    for kind in sorted(wrong):
        total = right[kind] + wrong[kind].total()
        print(f"\n{kind.replace('_', ' ')}: {right[kind]} of {total} in frames that have one")
        for what, times in wrong[kind].most_common():
            print(f"  wrong: {what:<52} {times:5}")


if __name__ == "__main__":
    main()
