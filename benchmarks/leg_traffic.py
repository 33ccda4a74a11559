"""Traffic in the legs of an intersection: precision of the cue ``leg_traffic``, simulated.

Run it as ``python benchmarks/leg_traffic.py [LAYOUT ...]``, by default A to H and M0 to M25, on
either side of the road. The boxes of all cars are projected from the simulated world, without
pictures, so nothing hides a car and no box errs; distances err by the cars' true heights. Motion
and place of the intersection are true. So it measures the rule, not a network. Turning cars are not
simulated, and cars cross only where both legs exist.
"""

from __future__ import annotations

import math
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Final, get_args

import numpy as np

from crosscue.datasets.scenes.layout import SCORED, Side, layout_named
from crosscue.datasets.scenes.motion import conditions_of
from crosscue.datasets.scenes.rendering.camera import SceneCamera
from crosscue.datasets.scenes.scene_truth import LEG_ASIDE_M
from crosscue.datasets.scenes.settings import scene_vehicle_text
from crosscue.datasets.scenes.world import SceneObject, World, build_world
from crosscue.detectors.base import Detections
from crosscue.detectors.cues.observed import Place
from crosscue.detectors.cues.tracked.judge import in_legs
from crosscue.detectors.cues.tracked.tracks import CarTracks
from crosscue.detectors.ranging.ground_plane import GroundPlane
from crosscue.detectors.ranging.object_tracks import CarStep
from crosscue.eval.scoring.intervals import wilson
from crosscue.replay.columns import Floats
from crosscue.replay.vehicle.vehicle import Vehicle, parse

CAMERA: Final = SceneCamera()
STEP: Final = 10
PLACE_SD_M: Final = 2.0
MOUNTED: Final = {"mounting_yaw_rad": 0.0, "declination_rad": 0.0, "heading_rad": 0.0}


def corners_m(thing: SceneObject, t_s: float) -> Floats:
    """Corners of a car, shape (8, 3)."""
    length, width, height = thing.size
    at = np.array(thing.at) + thing.shift(t_s)
    cos, sin = math.cos(thing.heading_rad), math.sin(thing.heading_rad)
    signs = np.array([(a, b, c) for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)]) / 2.0
    own = signs * [length, width, height]
    turned = np.column_stack([own[:, 0] * cos - own[:, 1] * sin, own[:, 0] * sin + own[:, 1] * cos])
    return np.asarray(np.column_stack([at[:2] + turned, at[2] + own[:, 2]]), np.float64)


def boxes_px(
    world: World, vehicle: Vehicle, pose: tuple[float, float, float], t_s: float
) -> Iterator[tuple[SceneObject, Floats]]:
    """Yield the cars in view with their boxes."""
    size = (CAMERA.width_px, CAMERA.height_px)
    plane = GroundPlane.of(vehicle.camera, size)
    x, y, heading = pose
    cos, sin = math.cos(heading), math.sin(heading)
    for thing in world.things:
        if thing.category != "car" or not thing.is_there(t_s):
            continue
        away = corners_m(thing, t_s) - [x, y, 0.0]
        own = np.column_stack(
            [away[:, 0] * cos + away[:, 1] * sin, away[:, 1] * cos - away[:, 0] * sin, away[:, 2]]
        )
        directions = own - np.array(plane.position_m)
        if directions[:, 0].min() < 1.0:
            continue
        seen = plane.seen_at(directions)
        box = np.concatenate([seen.min(axis=0), seen.max(axis=0)])
        if box[0] < size[0] and box[2] > 0.0 and box[3] - box[1] > 8.0:
            yield thing, np.clip(box, 0.0, [*size, *size])


def judged(layout_name: str, side: Side, rows: Counter[str]) -> None:
    """Count the frames in which the cue is positive, right or wrong, and those it misses."""
    layout = replace(layout_named(layout_name), traffic=side)
    world = build_world(layout, conditions_of(layout, 1), is_painted=False)
    vehicle = parse(scene_vehicle_text(CAMERA, traffic=side, **MOUNTED), "vehicle.toml")
    settings = vehicle.cars.model_copy(update={"kind": "tracks"})
    tracks, motion, before = CarTracks(vehicle.camera, settings), world.approach.motion, None
    for at in range(0, len(motion), STEP):
        pose = (float(motion.x_m[at]), float(motion.y_m[at]), float(motion.heading_rad[at]))
        found = list(boxes_px(world, vehicle, pose, at / 100.0))
        cars = Detections(
            at * 10_000_000,
            (CAMERA.width_px, CAMERA.height_px),
            np.array([box for _, box in found]).reshape(-1, 4),
            np.full(len(found), 0.99),
            ("car",) * len(found),
            (b"",) * len(found),
        )
        if before is not None:
            ego = CarStep(math.dist(pose[:2], before[:2]), 1e-4, pose[2] - before[2], STEP / 100.0)
            place = Place(-pose[0], layout.end_m - pose[0], PLACE_SD_M)
            counts = in_legs(tracks([cars], ego), vehicle.camera, settings, place)
            for leg, sign, exists in (
                ("left", 1.0, layout.has_left),
                ("right", -1.0, layout.has_right),
            ):
                there = any(
                    one.role == "cross"
                    and one.velocity != (0.0, 0.0)
                    and sign * (one.at[1] + one.shift(at / 100.0)[1]) > LEG_ASIDE_M
                    for one, _ in found
                )
                if counts is not None:
                    is_found = getattr(counts, leg) > 0
                    rows[f"{is_found} {there}"] += 1
                    rows["leg exists"] += is_found and exists
        before = pose


def main(arguments: Sequence[str]) -> None:
    """Print one line for each side of traffic."""
    layouts = arguments or [*SCORED, *(f"M{seed}" for seed in range(26))]
    for side in get_args(Side):
        rows: Counter[str] = Counter()
        for name in layouts:
            judged(name, side, rows)
        found = rows["True True"] + rows["True False"]
        there = rows["True True"] + rows["False True"]
        for what, right, of in (
            ("a car moves in the leg", rows["True True"], found),
            ("the leg exists", rows["leg exists"], found),
            ("recall", rows["True True"], there),
        ):
            interval = wilson(right, of) if of else (math.nan, math.nan)
            print(
                f"traffic on the {side}, {len(layouts)} layouts: {what}: {right} of {of} "
                f"({interval[0]:.2f} to {interval[1]:.2f})",
                flush=True,
            )


if __name__ == "__main__":
    main(sys.argv[1:])
