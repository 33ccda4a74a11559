"""Cues of a frame from what detectors found in it; a pass that goes frame by frame in time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from crosscue.replay.vehicle import Vehicle

from .base import Detections, Found, RoadMask
from .cars import CarShapes, Tracker, car_shapes, cross_traffic, pair_cars, parked_cars
from .cue_names import Cue
from .road import RoadShares, road_shares

SIGN_CUES: Final[Mapping[str, Cue]] = {
    "one way left": Cue.ONE_WAY_LEFT,
    "one way right": Cue.ONE_WAY_RIGHT,
    "do not enter": Cue.DO_NOT_ENTER,
}
"""From the labels that the sign detector gives."""


@dataclass(frozen=True, slots=True)
class FrameCues:
    """What one frame says.

    Attributes:
        counts: From each cue that was looked for to how many there were; 0 is looked and not found.
        road: Shares of road, where a detector segments.
    """

    counts: Mapping[Cue, int]
    road: RoadShares | None


@dataclass(slots=True)
class CuePass:
    """Gives each frame's cues; keeps the cars of the frame before.

    Attributes:
        vehicle: Regions and thresholds.
        has_boxes: A detector gives objects, so their absence counts.
        has_signs: A detector looks for signs.
        tracker: Pairs cars of two frames.
    """

    vehicle: Vehicle
    has_boxes: bool = True
    has_signs: bool = False
    tracker: Tracker = pair_cars
    _before: CarShapes | None = None

    def __call__(self, found: Sequence[Found]) -> FrameCues:
        """The cues of the next frame, of its detectors' results in any order."""
        boxes = [one for one in found if isinstance(one, Detections)]
        masks = [one for one in found if isinstance(one, RoadMask)]
        counts: dict[Cue, int] = {}
        if self.has_boxes and boxes:
            counts |= self._objects(boxes) | self._cars(boxes)
        if self.has_signs:
            counts |= {cue: _count(boxes, (label,), 0.0) for label, cue in SIGN_CUES.items()}
        road = road_shares(masks[0], self.vehicle.regions) if masks else None
        if road is not None:
            sides = (Cue.ROAD_LEFT, Cue.ROAD_STRAIGHT, Cue.ROAD_RIGHT)
            positive = road.positive(self.vehicle.cues.road_share)
            counts |= {cue: int(is_road) for cue, is_road in zip(sides, positive, strict=True)}
        return FrameCues(counts, road)

    def _objects(self, boxes: Sequence[Detections]) -> dict[Cue, int]:
        cues = self.vehicle.cues
        return {
            Cue.STOP_SIGN: _count(boxes, cues.stop_sign_labels, cues.stop_sign_score),
            Cue.TRAFFIC_LIGHT: _count(boxes, cues.traffic_light_labels, cues.traffic_light_score),
        }

    def _cars(self, boxes: Sequence[Detections]) -> dict[Cue, int]:
        now = car_shapes(boxes, self.vehicle.cars)
        before, self._before = self._before, now
        if before is None:
            return {}
        pairs = self.tracker(before, now, self.vehicle.cars)
        moving = cross_traffic(pairs, self.vehicle.cars)
        parked = parked_cars(pairs, self.vehicle.cars)
        return {
            Cue.CROSS_TRAFFIC_LEFT: moving.left,
            Cue.CROSS_TRAFFIC_RIGHT: moving.right,
            Cue.PARKED_LEFT: parked.left,
            Cue.PARKED_RIGHT: parked.right,
        }


def _count(boxes: Sequence[Detections], labels: tuple[str, ...], score: float) -> int:
    return sum(
        int(
            np.sum(
                [label in labels and s > score for label, s in zip(d.labels, d.scores, strict=True)]
            )
        )
        for d in boxes
    )
