"""Cues of a frame from what detectors found in it; a pass that goes frame by frame in time."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Final

import numpy as np

from crosscue.detectors.base import Detections, Found, RoadMask
from crosscue.detectors.ranging.object_tracks import Motion
from crosscue.replay.vehicle.vehicle import Vehicle

from .car_tracks import CarTracks, judge
from .cars import CarShapes, Pairs, Tracker, car_shapes, pair_cars
from .labelled import count_labels
from .place import Place
from .road import RoadShares, road_fractions
from .road_ground import ground_fractions
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
        doubles: What was left out of ``objects`` and ``signs``, since another detector found it
            with a better score.
    """

    t_ns: int
    objects: tuple[Detections, ...] = ()
    signs: tuple[Detections, ...] = ()
    road: RoadMask | RoadShares | None = None
    labels: frozenset[str] | None = None
    doubles: tuple[Detections, ...] = ()

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
    """Gives each frame's cues; keeps the cars of earlier frames.

    Attributes:
        vehicle: Regions and thresholds.
        tracker: Pairs cars of two frames, where the vehicle file has ``cars.kind = "pairs"``.
        tally: Counts what became of all candidates, where somebody asks.
        not_followed: Frames in which cars could not be followed, by reason.
    """

    vehicle: Vehicle
    tracker: Tracker = pair_cars
    tally: CueTally | None = None
    not_followed: Counter[str] = field(default_factory=Counter)
    _before: CarShapes | None = None
    _tracks: CarTracks | None = None

    def __call__(
        self, frame: Seen, ego: Motion | None = None, place: Place | None = None
    ) -> FrameCues:
        """The cues of the next frame.

        Args:
            frame: What was found in it.
            ego: The ego vehicle's motion since the frame before; None where nobody knows.
            place: Where the intersection is believed to be, if that is known.
        """
        counts: dict[str, int] = {}
        pairs: Pairs | None = None
        if frame.objects:
            counts |= counts_of("objects", frame.objects, self.vehicle)
            pairs = self._cars(frame.objects, ego, place)
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
            regions = self.vehicle.regions
            road = (
                ground_fractions(road, self.vehicle.camera, regions, place)
                if regions.kind == "ground"
                else road_fractions(road, regions)
            )
        if road is not None:
            counts |= counts_of("road", road, self.vehicle)
        found = FrameCues(counts, road)
        if self.tally is not None:
            self._explain(self.tally, frame, pairs, found)
        return found

    def restart(self) -> None:
        """Know nothing of the cars before."""
        self._before = self._tracks = None

    def notes(self) -> Counter[str]:
        """Frames in which crossing and parked cars could not be computed, by reason."""
        return Counter(
            {f"crossing and parked cars: {why}": n for why, n in self.not_followed.items()}
        )

    def _explain(self, tally: CueTally, frame: Seen, pairs: Pairs | None, found: FrameCues) -> None:
        tally.labelled("objects", frame.objects, found.counts)
        tally.labelled("signs", frame.boxes, found.counts)
        tally.own(frame.boxes, found.counts)
        is_any = frame.labels is None or not frame.labels.isdisjoint(self.vehicle.cars.labels)
        if pairs is not None and pairs.judged is not None and is_any:
            tally.followed(frame.objects, pairs.judged)
        elif self._before is not None and frame.objects and is_any:
            again = 0 if pairs is None else len(pairs.nose)
            tally.cars(frame.objects, len(self._before), again, found.counts)
        if frame.doubles:
            tally.doubles(frame.doubles, found.counts)
        if found.road is not None:
            tally.road(found.road)

    def _cars(
        self, boxes: Sequence[Detections], ego: Motion | None, place: Place | None
    ) -> Pairs | None:
        """Cars found again; None where they could not be."""
        cars, camera = self.vehicle.cars, self.vehicle.camera
        if cars.kind != "tracks":
            return self._pairs(boxes)
        why = _why_not_followed(ego, self.vehicle)
        if ego is None or why is not None:
            self._tracks = None
            self.not_followed[why or NO_ODOMETRY] += 1
            return None
        self._tracks = self._tracks or CarTracks(camera, cars)
        found = self._tracks(boxes, ego)
        judged = judge(found, self._tracks.seen, camera, cars, place)
        return Pairs(
            np.array([car.step_px for car in found]).reshape(-1, 2),
            np.array([car.center_px for car in found]).reshape(-1, 2),
            np.sign([car.nose for car in found]).astype(np.int64),
            boxes[0].size_px[0],
            judged,
        )

    def _pairs(self, boxes: Sequence[Detections]) -> Pairs | None:
        """Cars found again since the frame before; None in the first frame."""
        now = car_shapes(boxes, self.vehicle.cars)
        before, self._before = self._before, now
        return None if before is None else self.tracker(before, now, self.vehicle.cars)


NO_ODOMETRY: Final = "no odometry, so the camera's own motion is unknown"
NO_FOCAL_LENGTH: Final = "camera.focal_px is not given"


def _why_not_followed(ego: Motion | None, vehicle: Vehicle) -> str | None:
    """Why cars cannot be followed into this frame; None where they can."""
    if vehicle.camera.focal_px is None:
        return NO_FOCAL_LENGTH
    if ego is None or ego.way_m is None:
        return NO_ODOMETRY
    if ego.seconds > vehicle.cars.max_gap_s:
        return f"frames further than {vehicle.cars.max_gap_s:g} s apart"
    return None
