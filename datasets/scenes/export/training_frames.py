"""Render pictures for training: a few of each simulated run, with their objects as COCO.

Consecutive pictures of a drive are very similar, so a network learns more from eight pictures of
each of a hundred intersections than from a thousand pictures of one.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from crosscue.datasets.scenes.drive import jpeg
from crosscue.datasets.scenes.rendering.render import Renderer
from crosscue.datasets.scenes.settings import SceneSettings, world_of
from crosscue.datasets.scenes.world import World
from crosscue.datasets.simulated.drive import START_NS
from crosscue.replay.columns import Floats
from crosscue.replay.files.whole_file import write_bytes
from crosscue.replay.processes import in_processes

from .coco import DriveAnnotations

# Fraction of the pictures before the intersection; the others are within it.
BEFORE_ENTRY: Final = 0.9


def times_s(world: World, count: int, rng: np.random.Generator) -> Floats:
    """Return the times of pictures: half evenly along the path, half evenly in time, sorted.

    A car that waits at a red light is mostly in one place, while other cars pass.
    """
    motion, enter_s = world.approach.motion, world.approach.enter_s
    last_s = (len(motion) - 2) / 100.0
    fraction = rng.random(count)
    until_s = np.where(rng.random(count) < BEFORE_ENTRY, min(enter_s, last_s), last_s)
    step_m = np.abs(motion.speed_mps) * 0.01 + 1e-9
    way_m = np.concatenate([[0.0], np.cumsum(step_m)[:-1]])
    at = np.arange(len(motion)) * 0.01
    by_way = np.interp(fraction * np.interp(until_s, at, way_m), way_m, at)
    return np.sort(np.where(rng.random(count) < 0.5, by_way, fraction * until_s))


def render_frames(settings: SceneSettings, count: int, folder: Path) -> DriveAnnotations:
    """Render and write ``count`` pictures of one run to ``folder``, and return their annotations.

    Raises:
        OutputError: A picture cannot be written.
    """
    layout, conditions, world = world_of(settings)
    renderer = Renderer(world, settings.camera, settings.picture)
    rng = np.random.default_rng([conditions.seed, 12])
    objects = DriveAnnotations()
    for number, t_s in enumerate(times_s(world, count, rng).tolist()):
        picture = renderer.picture(t_s, number)
        t_ns = START_NS + round(t_s * 1e9)
        tags = conditions.tags(layout)
        objects.add(t_ns, picture, tags, -picture.view.rear_axle[0])
        name = f"{settings.name}-{number:03d}.jpg"
        objects.images[-1]["file_name"] = name
        write_bytes(folder / name, jpeg(picture, settings.picture.jpeg_quality))
    return objects


def frames(
    runs: Sequence[SceneSettings], count: int, folder: Path, workers: int = 1
) -> Iterator[DriveAnnotations]:
    """Yield ``render_frames`` for each run, in order; several runs are rendered in parallel."""
    return in_processes(partial(render_frames, count=count, folder=folder), runs, workers)


def merge_annotations(parts: Sequence[DriveAnnotations]) -> DriveAnnotations:
    """Merge the annotations of many runs, with new numbers."""
    whole = DriveAnnotations()
    for part in parts:
        images, annotations = len(whole.images), len(whole.annotations)
        whole.images += [{**image, "id": image["id"] + images} for image in part.images]
        whole.annotations += [
            _moved(annotation, images, annotations) for annotation in part.annotations
        ]
    return whole


def _moved(annotation: dict[str, Any], images: int, annotations: int) -> dict[str, Any]:
    return {
        **annotation,
        "id": annotation["id"] + annotations,
        "image_id": annotation["image_id"] + images,
    }
