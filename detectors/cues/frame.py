"""Cues of a frame from what detectors found in it; a pass that goes frame by frame in time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

from crosscue.detectors.base import Detections, Found, RoadMask
from crosscue.replay.vehicle.vehicle import Vehicle

from .cars import CarShapes, Tracker, car_shapes, cross_traffic, pair_cars, parked_cars
from .names import Cue
from .road import RoadShares, road_shares

SIGN_CUES: Final[Mapping[str, Cue]] = {
    "one way left": Cue.ONE_WAY_LEFT,
    "one way right": Cue.ONE_WAY_RIGHT,
    "do not enter": Cue.DO_NOT_ENTER,
}
"""From the labels that the sign detector gives."""


class Role(StrEnum):
    """What a detector looks for; where none of a role ran, its cues are not looked for."""

    OBJECTS = "objects"
    SIGNS = "signs"
    ROAD = "road"


@dataclass(frozen=True, slots=True)
class Seen:
    """What detectors found in one frame, by what they look for.

    Attributes:
        t_ns: Log time of the frame.
        objects: Of detectors of objects; empty where none ran.
        signs: Of detectors of one-way and do-not-enter signs; empty where none ran.
        road: Road pixels, or their shares where these are known already.
    """

    t_ns: int
    objects: tuple[Detections, ...] = ()
    signs: tuple[Detections, ...] = ()
    road: RoadMask | RoadShares | None = None


def role_of(found: Found, is_for_signs: bool) -> Role:
    """The role that a result plays."""
    if isinstance(found, RoadMask):
        return Role.ROAD
    return Role.SIGNS if is_for_signs else Role.OBJECTS


def seen(t_ns: int, found: Sequence[Found], is_for_signs: Sequence[bool]) -> Seen:
    """One frame's results, sorted by role.

    Args:
        t_ns: Log time of the frame.
        found: One result for each detector.
        is_for_signs: Whether that detector looks for one-way and do-not-enter signs.
    """
    boxes: dict[bool, list[Detections]] = {True: [], False: []}
    road: RoadMask | None = None
    for one, for_signs in zip(found, is_for_signs, strict=True):
        if isinstance(one, Detections):
            boxes[for_signs].append(one)
        elif road is None:
            road = one
    return Seen(t_ns, tuple(boxes[False]), tuple(boxes[True]), road)


@dataclass(frozen=True, slots=True)
class FrameCues:
    """What one frame says.

    Attributes:
        counts: From each cue that was looked for, a user's own among them, to how many there were;
            0 is looked and not found.
        road: Shares of road, where a detector segments.
    """

    counts: Mapping[str, int]
    road: RoadShares | None


@dataclass(slots=True)
class CuePass:
    """Gives each frame's cues; keeps the cars of the frame before.

    Attributes:
        vehicle: Regions and thresholds.
        tracker: Pairs cars of two frames.
    """

    vehicle: Vehicle
    tracker: Tracker = pair_cars
    _before: CarShapes | None = None

    def __call__(self, frame: Seen) -> FrameCues:
        """The cues of the next frame."""
        counts: dict[str, int] = {}
        if frame.objects:
            counts |= self._objects(frame.objects) | self._cars(frame.objects)
        if frame.signs:
            counts |= {
                cue.value: _count(frame.signs, (label,), 0.0) for label, cue in SIGN_CUES.items()
            }
        if frame.objects or frame.signs:
            boxes = (*frame.objects, *frame.signs)
            for name, own in self.vehicle.cues.own.items():
                counts[name] = _count(boxes, own.labels, own.score)
        road = frame.road
        if isinstance(road, RoadMask):
            road = road_shares(road, self.vehicle.regions)
        if road is not None:
            sides = (Cue.ROAD_LEFT, Cue.ROAD_STRAIGHT, Cue.ROAD_RIGHT)
            positive = road.positive(self.vehicle.cues.road_share)
            counts |= {
                cue.value: int(is_road) for cue, is_road in zip(sides, positive, strict=True)
            }
        return FrameCues(counts, road)

    def _objects(self, boxes: Sequence[Detections]) -> dict[str, int]:
        cues = self.vehicle.cues
        return {
            Cue.STOP_SIGN.value: _count(boxes, cues.stop_sign_labels, cues.stop_sign_score),
            Cue.TRAFFIC_LIGHT.value: _count(
                boxes, cues.traffic_light_labels, cues.traffic_light_score
            ),
        }

    def _cars(self, boxes: Sequence[Detections]) -> dict[str, int]:
        now = car_shapes(boxes, self.vehicle.cars)
        before, self._before = self._before, now
        if before is None:
            return {}
        pairs = self.tracker(before, now, self.vehicle.cars)
        moving = cross_traffic(pairs, self.vehicle.cars)
        parked = parked_cars(pairs, self.vehicle.cars)
        return {
            Cue.CROSS_TRAFFIC_LEFT.value: moving.left,
            Cue.CROSS_TRAFFIC_RIGHT.value: moving.right,
            Cue.PARKED_LEFT.value: parked.left,
            Cue.PARKED_RIGHT.value: parked.right,
        }


def _count(boxes: Sequence[Detections], labels: tuple[str, ...], score: float) -> int:
    return sum(
        label in labels and bool(s > score)
        for found in boxes
        for label, s in zip(found.labels, found.scores.tolist(), strict=True)
    )
