"""Upper limits of the cue rules, with true masks in place of the networks.

``python benchmarks/perfect_inputs.py DRIVES`` reads drives that ``crosscue simulate`` wrote. Every
object in ``objects.json`` that is visible enough becomes a detection with its true mask and a score
of 1. The remaining errors are those of the rule, and no network can repair them. With ``--runs N``,
the missing drives among runs 1 to N of layouts A to H are simulated into DRIVES first, 640 pixels
wide, ten frames per second, without rendering any picture.

``python benchmarks/perfect_inputs.py --all A B C`` simulates a drive to each of these layouts (by
default A to H), 640 pixels wide, five frames per second. Its pictures are the renderer's masks of
roads, cars, signs and lights. Every cue is scored as ``crosscue score`` does.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

import crosscue
from crosscue.datasets.scenes.drive import Imager, picture_times, write_scene
from crosscue.datasets.scenes.faulty_labels import DETECTORS, label_pictures, png
from crosscue.datasets.scenes.layout import SCORED
from crosscue.datasets.scenes.rendering.render import PictureSettings, RenderedFrame, Renderer
from crosscue.datasets.scenes.settings import SceneSettings, camera_of_width
from crosscue.datasets.scenes.world import World
from crosscue.datasets.simulated.drive import START_NS
from crosscue.datasets.truth.truth import read_truth
from crosscue.detectors.cues.cars import (
    CarShapes,
    car_shapes,
    cross_traffic,
    pair_cars,
    parked_cars,
)
from crosscue.eval.runs.folder import open_run
from crosscue.eval.scoring.drives import pool_scores as as_score
from crosscue.eval.scoring.drives import score_drive
from crosscue.eval.scoring.intervals import TOO_FEW, Proportion, fraction
from crosscue.eval.scoring.runs import read_run_tables
from crosscue.eval.scoring.truth import read_scored_truth as load_truth
from crosscue.replay.vehicle.vehicle import Vehicle
from crosscue.replay.vehicle.vehicle import load as load_vehicle
from support.perfect_boxes import NO_FAULTS, frames, is_there, role_at, true_cars

VISIBLE = (0.3, 0.5, 0.7, 0.9)
# Visibility threshold for which errors are listed by their cause.
SHOWN = 0.7
RULES = {"cross_traffic": cross_traffic, "parked": parked_cars}
LABELLED = {"stop_sign": "stop sign", "traffic_light": "traffic light"}
Claims = dict[str, tuple[list[bool], list[int]]]


def perfect_pictures(world: World, settings: SceneSettings) -> Iterator[tuple[int, RenderedFrame]]:
    """Yield label images of a faultless detector in dry daylight."""
    clear = replace(world, conditions=replace(world.conditions, light="noon", rain=0.0))
    return label_pictures(clear, settings, NO_FAULTS)


# Label images of the faultless detector, which show the best possible result of the rules.
PERFECT_LABELS = Imager("perfect labels 1", perfect_pictures, png, "png", is_painted=False)


def counts(drive: Path, vehicle: Vehicle, min_visible: float) -> Iterator[tuple[int, str, int]]:
    """Yield time, cue and count for each frame and rule."""
    before: CarShapes | None = None
    rules = vehicle.cars
    for found in frames(drive, min_visible):
        for cue, label in LABELLED.items():
            yield found.t_ns, cue, found.labels.count(label)
        now = car_shapes([found], rules)
        if before is not None:
            pairs = pair_cars(before, now, rules)
            for cue, rule in RULES.items():
                for side, number in zip(("left", "right"), rule(pairs, rules), strict=True):
                    yield found.t_ns, f"{cue}_{side}", number
        before = now


def score(drives: list[Path], min_visible: float) -> dict[str, tuple[Proportion, Proportion]]:
    """Return precision and recall of each kind of cue by frames, with both sides combined."""
    right: Claims = {}
    found: Claims = {}
    for number, drive in enumerate(drives):
        truth, vehicle = read_truth(drive / "truth.json"), load_vehicle(drive / "vehicle.toml")
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


def true_kinds(drives: list[Path], min_visible: float) -> dict[str, Counter[str]]:
    """Return the numbers of cars that each rule counts, by cue and true motion."""
    kinds: dict[str, Counter[str]] = {cue: Counter() for cue in RULES}
    for drive in drives:
        rules, cars = load_vehicle(drive / "vehicle.toml").cars, true_cars(drive)
        shapes = [car_shapes([found], rules) for found in frames(drive, min_visible)]
        for before, now in pairwise(shapes):
            pairs = pair_cars(before, now, rules)
            for i, (x, y) in enumerate(pairs.center_px.tolist()):
                part = slice(i, i + 1)
                one = replace(pairs, step_px=pairs.step_px[part], nose=pairs.nose[part])
                for cue, rule in RULES.items():
                    if any(rule(one, rules)):
                        kinds[cue][role_at(cars[now.t_ns], x, y)] += 1
    return kinds


def _fraction(values: list[bool], clusters: list[int]) -> Proportion:
    return fraction(np.array(values, np.bool_), np.array(clusters, np.int64))


def _text(one: Proportion | None) -> str:
    if one is None or not one.of:
        return "none"
    ends = f"{one.clusters_low:.2f} to {one.clusters_high:.2f}"
    by_drive = TOO_FEW if np.isnan(one.clusters_low) else ends
    return f"{one.value:.2f} ({by_drive}; {one.of} frames, {one.clusters} drives)"


def _counted(one: Proportion) -> str:
    return f"{one.right} of {one.of}"


def every_cue(layouts: list[str], folder: Path) -> None:
    """Print precision and recall of every cue with perfect masks."""
    judged = []
    for layout in layouts:
        drive = folder / layout
        scene = SceneSettings(layout=layout, camera=camera_of_width(640))
        files = write_scene(drive, scene, imager=PERFECT_LABELS, is_calibrated=False)
        crosscue.replay_drive(files.log, drive / "run", detectors=DETECTORS.split(","))
        judged.append(
            score_drive(read_run_tables(open_run(drive / "run")), load_truth(files.truth, layout))
        )
    print(f"{len(judged)} simulated drives, perfect masks: precision; recall")
    for name, cue in as_score(judged).cues.items():
        print(f"  {name:20} {_text(cue.precision)}; {_text(cue.recall)}")


def _objects(world: World, settings: SceneSettings) -> Iterator[tuple[int, RenderedFrame]]:
    """Yield frames without colours until the car is at the intersection."""
    renderer = Renderer(world, settings.camera, PictureSettings(samples=1))
    no_codes = np.zeros(world.ground.road.shape, np.uint8)
    for t_ns in picture_times(world, settings).tolist():
        t_s = (t_ns - START_NS) * 1e-9
        if t_s > world.approach.enter_s:
            return
        yield t_ns, renderer.owners(t_s, no_codes)[0]


OBJECTS = Imager("objects only", _objects, lambda *_: b"", "png", is_painted=False)


def simulate(folder: Path, runs: int) -> None:
    """Simulate the missing drives among runs 1 to ``runs`` of layouts A to H, objects only."""
    for run in range(1, runs + 1):
        for layout in SCORED:
            scene = SceneSettings(layout=layout, run=run, camera=camera_of_width(640))
            # The truth is written last, so its presence marks a complete drive.
            if not (folder / scene.name / "truth.json").exists():
                write_scene(folder / scene.name, scene, overwrite=True, imager=OBJECTS)


def main() -> None:
    """Print the upper limit of each rule, for several visibility thresholds."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("drives", nargs="?", type=Path, metavar="DRIVES")
    parser.add_argument("--runs", type=int, default=0, metavar="N")
    parser.add_argument("--all", nargs="*", metavar="LAYOUT")
    arguments = parser.parse_args()
    if arguments.all is not None:
        with TemporaryDirectory() as folder:
            every_cue(arguments.all or list(SCORED), Path(folder))
        return
    if arguments.drives is None:
        parser.error("expected DRIVES or --all")
    simulate(arguments.drives, arguments.runs)
    drives = sorted(path.parent for path in arguments.drives.glob("*/truth.json"))
    if not drives:
        parser.error(f"{arguments.drives}: no simulated drive; --runs N simulates some")
    kinds = Counter(path.name[0] for path in drives)
    print(f"{len(drives)} simulated drives, layouts {' '.join(sorted(kinds))}; perfect masks")
    for min_visible in VISIBLE:
        print(f"\nat least {100 * min_visible:.0f} % visible: precision; recall")
        for kind, (precision, recall) in score(drives, min_visible).items():
            print(f"  {kind:14} {_text(precision)}; {_text(recall)}")
    print(f"\nat least {100 * SHOWN:.0f} % visible, precision by layout")
    for layout in sorted(kinds):
        found = score([one for one in drives if one.name[0] == layout], SHOWN)
        print(f"  {layout}  " + "; ".join(f"{cue} {_counted(found[cue][0])}" for cue in RULES))
    print(f"\nat least {100 * SHOWN:.0f} % visible, cars counted by each rule, and what they are")
    for cue, cars in true_kinds(drives, SHOWN).items():
        print(f"  {cue:14} " + "; ".join(f"{n} {kind}" for kind, n in cars.most_common()))


if __name__ == "__main__":
    main()
