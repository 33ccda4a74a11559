"""The true objects of a simulated drive as detections of a perfect detector."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from crosscue.datasets.scenes.faulty_labels import LABELS, DetectorFaults, Sight
from crosscue.datasets.truth.truth import Truth
from crosscue.detectors.base import Detections
from crosscue.eval.scoring.truth import cue_at

# Max distance of a true car's center, in units of the longer side of its box.
MIN_NEAR = 0.5
KINDS = {
    "cross": "car on the crossroad that moves",
    "parked_cross": "car parked on the crossroad",
    "other": "car in a lot or driveway, or parked at the own road",
    "oncoming": "oncoming car",
    "outgoing": "car ahead",
    "parked_past": "car parked past the intersection",
}
# Faultless detector: exact masks of all objects that are visible by at least two thirds.
NO_FAULTS = DetectorFaults(
    sights=dict.fromkeys(LABELS, Sight(1.0, 1e-3)),
    height_sd_fraction=0.0,
    false_things={},
    false_per_frame=0.0,
    turned_around=0.0,
    road_half_m=1e6,
    ahead_half_m=1e6,
    road_best=1.0,
    lot_as_road=0.0,
    driveway_as_road=0.0,
    false_road=0.0,
    false_roads=0.0,
)


def true_cars(drive: Path) -> dict[int, list[dict[str, Any]]]:
    """Return the true cars of each frame, by time."""
    content = json.loads((drive / "objects.json").read_text())
    times = {one["id"]: one["t_ns"] for one in content["images"]}
    car = next(one["id"] for one in content["categories"] if one["name"] == "car")
    cars: dict[int, list[dict[str, Any]]] = {t_ns: [] for t_ns in times.values()}
    for one in content["annotations"]:
        if one["category_id"] == car:
            cars[times[one["image_id"]]].append(one)
    return cars


def role_at(cars: list[dict[str, Any]], x: float, y: float) -> str:
    """Return the role of the nearest true car, or ``no car``."""
    best, nearest = "no car", MIN_NEAR
    for one in cars:
        x0, y0, width, height = one["bbox"]
        away = float(np.hypot(x - x0 - width / 2, y - y0 - height / 2)) / max(width, height)
        if away < nearest:
            best, nearest = KINDS[one["role"]], away
    return best


def frames(drive: Path, min_visible: float) -> Iterator[Detections]:
    """Yield the drive's objects as detections, picture by picture."""
    content: dict[str, Any] = json.loads((drive / "objects.json").read_text())
    names = {one["id"]: one["name"] for one in content["categories"]}
    by_image: dict[int, list[dict[str, Any]]] = {one["id"]: [] for one in content["images"]}
    for one in content["annotations"]:
        if one["visible"] >= min_visible:
            by_image[one["image_id"]].append(one)
    for image in content["images"]:
        found = by_image[image["id"]]
        boxes = np.array([one["bbox"] for one in found], np.float64).reshape(-1, 4)
        boxes[:, 2:] += boxes[:, :2]
        yield Detections(
            image["t_ns"],
            (image["width"], image["height"]),
            boxes,
            np.ones(len(found)),
            tuple(names[one["category_id"]] for one in found),
            tuple(one["segmentation"]["counts"].encode() for one in found),
        )


def is_there(truth: Truth, cue: str, t_ns: int) -> bool | None:
    """Return whether a cue is truly present in a frame; None if unknown."""
    at = cue_at([one for one in truth.cues if one.cue == cue], np.array([t_ns], np.int64))
    return None if at.present[0] < 0 else bool(at.present[0])
