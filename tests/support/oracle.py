"""A detector that returns the truth of a simulated drive, for tests of later stages.

Its settings name the file of true objects, so that it cannot be mistaken for a real detector.
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from crosscue.detectors.base import Detections, Found, Frame, View, nothing_found


class Oracle:
    """A detector that returns every labelled object with a score of 0.99."""

    def __init__(self, objects: str) -> None:
        tree = json.loads(Path(objects).read_text())
        names = {one["id"]: one["name"] for one in tree["categories"]}
        times = {one["id"]: one["t_ns"] for one in tree["images"]}
        self._found: dict[int, list[dict[str, Any]]] = {t: [] for t in times.values()}
        for one in tree["annotations"]:
            self._found[times[one["image_id"]]].append({**one, "label": names[one["category_id"]]})
        # Small pictures, because it does not use them.
        self.view = View(min_width_px=64)
        self.identity = f"oracle {objects}"

    def __call__(self, frames: Sequence[Frame], /) -> Sequence[Found]:
        """Return the labelled objects at the time of each frame."""
        return [self._of(frame) for frame in frames]

    def _of(self, frame: Frame) -> Found:
        rows = self._found.get(frame.t_ns, [])
        if not rows:
            return nothing_found(frame)
        boxes = np.array([row["bbox"] for row in rows], np.float64)
        boxes[:, 2:] += boxes[:, :2]
        return Detections(
            frame.t_ns,
            frame.size_px,
            boxes,
            np.full(len(rows), 0.99),
            tuple(row["label"] for row in rows),
            tuple(row["segmentation"]["counts"].encode("ascii") for row in rows),
        )


def build(objects: str) -> Oracle:
    """Build the oracle of a drive's ``objects.json``."""
    return Oracle(objects)
