"""How good the rules of cues can get: perfect masks in place of networks.

``python benchmarks/perfect_inputs.py DRIVES`` works on what ``crosscue simulate`` wrote. Every
object of ``objects.json`` of which enough is visible becomes a detection with its true mask and a
score of 1. What is wrong then is wrong with the rule, and no network repairs it.

``python benchmarks/perfect_inputs.py --all A B C`` drives to these layouts (A to H without any),
640 pixels wide, with pictures that are the renderer's masks of roads, cars, signs and lights, five
a second, and scores every cue as ``crosscue score`` does.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

import crosscue
from crosscue.datasets.scenes.drive import write_scene
from crosscue.datasets.scenes.faulty_labels import DETECTORS, PERFECT_LABELS
from crosscue.datasets.scenes.layout import SCORED
from crosscue.datasets.scenes.settings import SceneSettings, camera_of_width
from crosscue.datasets.truth.truth import load
from crosscue.detectors.cues.cars import (
    CarShapes,
    car_shapes,
    cross_traffic,
    pair_cars,
    parked_cars,
)
from crosscue.eval.runs.folder import open_run
from crosscue.eval.scoring.drives import judge
from crosscue.eval.scoring.drives import score as as_score
from crosscue.eval.scoring.intervals import TOO_FEW, Proportion, fraction
from crosscue.eval.scoring.runs import tables_of
from crosscue.eval.scoring.truth import load as load_truth
from crosscue.replay.vehicle.vehicle import Vehicle
from crosscue.replay.vehicle.vehicle import load as load_vehicle
from support.perfect_boxes import frames, is_there

VISIBLE = (0.3, 0.5, 0.7, 0.9)
LABELLED = {"stop_sign": "stop sign", "traffic_light": "traffic light"}
Claims = dict[str, tuple[list[bool], list[int]]]


def counts(drive: Path, vehicle: Vehicle, min_visible: float) -> Iterator[tuple[int, str, int]]:
    """Time, cue and how many of it, for each frame and rule."""
    before: CarShapes | None = None
    rules = vehicle.cars
    for found in frames(drive, min_visible):
        for cue, label in LABELLED.items():
            yield found.t_ns, cue, found.labels.count(label)
        now = car_shapes([found], rules)
        if before is not None:
            pairs = pair_cars(before, now, rules)
            for cue, sides in (
                ("cross_traffic", cross_traffic(pairs, rules)),
                ("parked", parked_cars(pairs, rules)),
            ):
                for side, number in zip(("left", "right"), sides, strict=True):
                    yield found.t_ns, f"{cue}_{side}", number
        before = now


def score(drives: list[Path], min_visible: float) -> dict[str, tuple[Proportion, Proportion]]:
    """Precision and recall of each kind of cue, both sides together, by frames."""
    right: Claims = {}
    found: Claims = {}
    for number, drive in enumerate(drives):
        truth, vehicle = load(drive / "truth.json"), load_vehicle(drive / "vehicle.toml")
        for t_ns, cue, count in counts(drive, vehicle, min_visible):
            there = is_there(truth, cue, t_ns)
            if there is None:
                continue
            kind = cue.removesuffix("_left").removesuffix("_right")
            for rows, is_row, value in ((right, count > 0, there), (found, there, count > 0)):
                values, clusters = rows.setdefault(kind, ([], []))
                if is_row:
                    values.append(value)
                    clusters.append(number)
    return {kind: (_fraction(*right[kind]), _fraction(*found[kind])) for kind in right}


def _fraction(values: list[bool], clusters: list[int]) -> Proportion:
    return fraction(np.array(values, np.bool_), np.array(clusters, np.int64))


def _text(one: Proportion | None) -> str:
    if one is None or not one.of:
        return "none"
    ends = f"{one.clusters_low:.2f} to {one.clusters_high:.2f}"
    by_drive = TOO_FEW if np.isnan(one.clusters_low) else ends
    return f"{one.value:.2f} ({by_drive}; {one.of} frames, {one.clusters} drives)"


def every_cue(layouts: list[str], folder: Path) -> None:
    """Print precision and recall of every cue where masks are perfect."""
    judged = []
    for layout in layouts:
        drive = folder / layout
        scene = SceneSettings(layout=layout, camera=camera_of_width(640))
        files = write_scene(drive, scene, imager=PERFECT_LABELS, is_calibrated=False)
        crosscue.replay_drive(files.log, drive / "run", detectors=DETECTORS.split(","))
        judged.append(judge(tables_of(open_run(drive / "run")), load_truth(files.truth, layout)))
    print(f"{len(judged)} simulated drives, perfect masks: precision; recall")
    for name, cue in as_score(judged).cues.items():
        print(f"  {name:20} {_text(cue.precision)}; {_text(cue.recall)}")


def main() -> None:
    """Print the ceiling of each rule, by how much of a thing must be visible."""
    if sys.argv[1] == "--all":
        with TemporaryDirectory() as folder:
            every_cue(sys.argv[2:] or list(SCORED), Path(folder))
        return
    drives = sorted(path.parent for path in Path(sys.argv[1]).glob("*/objects.json"))
    kinds = Counter(path.name[0] for path in drives)
    print(f"{len(drives)} simulated drives, layouts {' '.join(sorted(kinds))}; perfect masks")
    for min_visible in VISIBLE:
        print(f"\nat least {100 * min_visible:.0f} % visible: precision; recall")
        for kind, (precision, recall) in score(drives, min_visible).items():
            print(f"  {kind:14} {_text(precision)}; {_text(recall)}")


if __name__ == "__main__":
    main()
