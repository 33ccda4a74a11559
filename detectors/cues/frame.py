"""Cues of a frame from what detectors found in it; a pass that goes frame by frame in time."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum

from crosscue.detectors.base import Detections, Found, RoadMask
from crosscue.replay.vehicle.vehicle import Vehicle

from .cars import CarShapes, Pairs, Tracker, car_shapes, pair_cars
from .labelled import count_labels
from .road import RoadShares, road_shares
from .rules import counts_of
from .tally import CueTally, cue_labels


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
        labels: What the detectors of objects and signs can report; None for anything.
    """

    t_ns: int
    objects: tuple[Detections, ...] = ()
    signs: tuple[Detections, ...] = ()
    road: RoadMask | RoadShares | None = None
    labels: frozenset[str] | None = None

    @property
    def boxes(self) -> tuple[Detections, ...]:
        """Of all detectors of objects and signs."""
        return (*self.objects, *self.signs)


def all_labels(labels: Iterable[Sequence[str] | None]) -> frozenset[str] | None:
    """What several detectors can report together; None for anything, if one does not say."""
    known: set[str] = set()
    for one in labels:
        if one is None:
            return None
        known.update(one)
    return frozenset(known)


def role_of(found: Found, is_for_signs: bool) -> Role:
    """The role that a result plays."""
    if isinstance(found, RoadMask):
        return Role.ROAD
    return Role.SIGNS if is_for_signs else Role.OBJECTS


def seen(
    t_ns: int,
    found: Sequence[Found],
    is_for_signs: Sequence[bool],
    labels: frozenset[str] | None = None,
) -> Seen:
    """One frame's results, sorted by role.

    Args:
        t_ns: Log time of the frame.
        found: One result for each detector.
        is_for_signs: Whether that detector looks for one-way and do-not-enter signs.
        labels: What all detectors can report together.
    """
    boxes: dict[bool, list[Detections]] = {True: [], False: []}
    road: RoadMask | None = None
    for one, for_signs in zip(found, is_for_signs, strict=True):
        if isinstance(one, Detections):
            boxes[for_signs].append(one)
        elif road is None:
            road = one
    return Seen(t_ns, tuple(boxes[False]), tuple(boxes[True]), road, labels)


@dataclass(frozen=True, slots=True)
class FrameCues:
    """What one frame says.

    Attributes:
        counts: From each cue that was looked for, a user's own among them, to how many there were;
            0 is looked and not found.
        road: Fractions of road, where a detector segments.
    """

    counts: Mapping[str, int]
    road: RoadShares | None


@dataclass(slots=True)
class CuePass:
    """Gives each frame's cues; keeps the cars of the frame before.

    Attributes:
        vehicle: Regions and thresholds.
        tracker: Pairs cars of two frames.
        tally: Counts what became of all candidates, where somebody asks.
    """

    vehicle: Vehicle
    tracker: Tracker = pair_cars
    tally: CueTally | None = None
    _before: CarShapes | None = None

    def __call__(self, frame: Seen) -> FrameCues:
        """The cues of the next frame."""
        counts: dict[str, int] = {}
        pairs: Pairs | None = None
        if frame.objects:
            counts |= counts_of("objects", frame.objects, self.vehicle)
            pairs = self._pairs(frame.objects)
            if pairs is not None:
                counts |= counts_of("car pairs", pairs, self.vehicle)
        if frame.boxes:
            counts |= counts_of("signs", frame.boxes, self.vehicle)
            for name, own in self.vehicle.cues.own.items():
                counts[name] = count_labels(frame.boxes, own.labels, own.score)
        if frame.labels is not None:
            wanted = cue_labels(self.vehicle)
            counts = {
                cue: count
                for cue, count in counts.items()
                if not wanted[cue] or not frame.labels.isdisjoint(wanted[cue])
            }
        road = frame.road
        if isinstance(road, RoadMask):
            road = road_shares(road, self.vehicle.regions)
        if road is not None:
            counts |= counts_of("road", road, self.vehicle)
        found = FrameCues(counts, road)
        if self.tally is not None:
            self._explain(self.tally, frame, pairs, found)
        return found

    def _explain(self, tally: CueTally, frame: Seen, pairs: Pairs | None, found: FrameCues) -> None:
        tally.labelled("objects", frame.objects, found.counts)
        tally.labelled("signs", frame.boxes, found.counts)
        tally.own(frame.boxes, found.counts)
        is_any = frame.labels is None or not frame.labels.isdisjoint(self.vehicle.cars.labels)
        if self._before is not None and frame.objects and is_any:
            again = 0 if pairs is None else len(pairs.nose)
            tally.cars(frame.objects, len(self._before), again, found.counts)
        if found.road is not None:
            tally.road(found.road)

    def _pairs(self, boxes: Sequence[Detections]) -> Pairs | None:
        """Cars found again since the frame before; None in the first frame."""
        now = car_shapes(boxes, self.vehicle.cars)
        before, self._before = self._before, now
        return None if before is None else self.tracker(before, now, self.vehicle.cars)
