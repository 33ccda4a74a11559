"""Compute the cues of each frame from its detections, frame by frame in time order."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from crosscue.detectors.base import Detections, RoadMask
from crosscue.detectors.cues.tracked.judge import (
    cars_past,
    count_cars,
    in_legs,
    is_past,
    may_be_parked,
)
from crosscue.detectors.cues.tracked.motion import CarMotion
from crosscue.detectors.cues.tracked.tracks import CarTracks
from crosscue.detectors.ranging.control_tracks import ControlTracks
from crosscue.detectors.ranging.object_tracks import CarStep
from crosscue.replay.vehicle.vehicle import Vehicle

from .candidates import (
    SAME_OBJECT,
    Candidates,
    Count,
    label_scores,
    take,
    thresholds_met,
    unsure_of,
)
from .cars import CarCandidates, CarShapes, Pairs, car_shapes, no_pairs, pair_cars
from .labelled import count_own
from .observed import NOT_SEEN, FrameCues, FrameDetections, Place, RoadFractions
from .road import road_fractions
from .rules import counts_of


@dataclass(slots=True)
class CuePass:
    """Computes the cues of each frame; it remembers the objects of earlier frames.

    Attributes:
        vehicle: Regions and thresholds.
        candidates: Candidates of every evaluated cue so far; only cues with a label or a region.
        not_followed: Number of frames in which cars could not be tracked, by reason.
        controls: Tracks of stop signs and traffic lights.
    """

    vehicle: Vehicle
    candidates: dict[str, Candidates] = field(default_factory=dict)
    not_followed: Counter[str] = field(default_factory=Counter)
    controls: ControlTracks = field(init=False)
    _before: CarShapes | None = None
    _tracks: CarTracks | None = None
    _last_ns: int | None = None

    def __post_init__(self) -> None:
        self.controls = ControlTracks(self.vehicle)

    def __call__(
        self, frame: FrameDetections, ego: CarStep | None = None, place: Place | None = None
    ) -> FrameCues:
        """Compute the cues of the next frame.

        Args:
            frame: Detections in the frame.
            ego: The ego vehicle's motion since the previous frame; None where unknown.
            place: Estimated position of the intersection; None where unknown.
        """
        objects: dict[str, Count] = {}
        cars: dict[str, Count] = {}
        signs: dict[str, Count] = {}
        passed_s = 0.0 if self._last_ns is None else (frame.t_ns - self._last_ns) * 1e-9
        self._last_ns = frame.t_ns
        if frame.objects:
            motion = CarStep(None, 0.0, 0.0, max(passed_s, 0.0)) if ego is None else ego
            frame = replace(frame, objects=self.controls(frame.objects, motion))
            objects = counts_of("objects", frame.objects, self.vehicle)
            pairs = self._cars(frame.objects, ego, place)
            if pairs is not None:
                cars = counts_of("car pairs", pairs, self.vehicle)
        if frame.boxes:
            signs = counts_of("signs", frame.boxes, self.vehicle)
            for name, own in self.vehicle.cues.own.items():
                signs[name] = count_own(frame.boxes, name, own)
        fractions = self._road(frame.road)
        road = {} if fractions is None else counts_of("road", fractions, self.vehicle)
        found = self._reportable(objects | cars | signs | road, frame.labels)
        counts = {cue: one.number for cue, one in found.items() if one.number is not None}
        for cue in (*objects, *signs, *cars, *road):
            if cue in found:
                take(self.candidates, cue, found[cue])
        if frame.doubles:
            self._take_doubles(frame.doubles, counts)
        return FrameCues(counts, fractions, frame.objects)

    def _reportable(
        self, counts: dict[str, Count], labels: frozenset[str] | None
    ) -> dict[str, Count]:
        """Return the counts without cues whose labels no detector can report."""
        if labels is None:
            return counts
        wanted = self.vehicle.cue_labels()
        return {
            cue: count
            for cue, count in counts.items()
            if not wanted[cue] or not labels.isdisjoint(wanted[cue])
        }

    def _road(self, road: RoadMask | RoadFractions | None) -> RoadFractions | None:
        """Return the fractions of road by region."""
        if not isinstance(road, RoadMask):
            return road
        if self.vehicle.regions.kind == "area":
            # Known only from many frames together; the stage that has them passes fractions.
            return NOT_SEEN
        return road_fractions(road, self.vehicle.regions)

    def _take_doubles(self, boxes: Sequence[Detections], counts: Mapping[str, int]) -> None:
        """Account for objects that another detector found with a better score."""
        for name, labels in self.vehicle.cue_labels().items():
            scores = label_scores(boxes, labels) if name in counts else []
            if scores and name in self.candidates:
                self.candidates[name].take(Count(None, scores, {SAME_OBJECT: len(scores)}))

    def restart(self) -> None:
        """Forget the objects of earlier frames."""
        self._before = self._tracks = self._last_ns = None
        self.controls.restart()

    def followed(self) -> list[CarMotion]:
        """Cars of the newest frame, if they are tracked over frames."""
        return [] if self._tracks is None else self._tracks.longer()

    def notes(self) -> Counter[str]:
        """Number of frames without crossing and parked cars, by reason."""
        return Counter(
            {f"crossing and parked cars: {why}": n for why, n in self.not_followed.items()}
        )

    def _cars(
        self, boxes: Sequence[Detections], ego: CarStep | None, place: Place | None
    ) -> Pairs | None:
        """Cars found in earlier frames and this one; None if they could not be tracked."""
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
        standing = self._tracks.standing(lambda seen: may_be_parked(seen, cars))
        judged = count_cars(found, standing, self._tracks.seen, camera, cars, place)
        longer = self._tracks.longer(
            lambda seen: place is not None and is_past(seen[-1], camera, place)
        )
        judged = judged._replace(
            past=cars_past(longer, camera, cars, place), in_leg=in_legs(found, camera, cars, place)
        )
        return Pairs(
            np.array([car.step_px for car in found]).reshape(-1, 2),
            np.array([car.center_px for car in found]).reshape(-1, 2),
            np.sign([car.nose for car in found]).astype(np.int64),
            boxes[0].size_px[0],
            judged,
            self._candidates(boxes),
        )

    def _candidates(self, boxes: Sequence[Detections], shapes: int = 0) -> CarCandidates:
        """Return all cars among the detections, of which ``shapes`` pass the rules of shape."""
        cars = self.vehicle.cars
        return CarCandidates(
            label_scores(boxes, cars.labels),
            unsure_of(boxes, cars.labels, cars.score).total(),
            thresholds_met(boxes, cars.labels, cars.score),
            shapes,
        )

    def _pairs(self, boxes: Sequence[Detections]) -> Pairs:
        """Cars found in the previous frame and this one."""
        now = car_shapes(boxes, self.vehicle.cars)
        before, self._before = self._before, now
        if before is None:
            pairs = no_pairs(now.size_px[0])
        else:
            pairs = pair_cars(before, now, self.vehicle.cars)
        cars = self._candidates(boxes, len(now))
        return replace(pairs, cars=cars, is_first=before is None)


NO_ODOMETRY: Final = "no odometry, so the camera's own motion is unknown"
NO_FOCAL_LENGTH: Final = "camera.focal_px is not set"


def _why_not_followed(ego: CarStep | None, vehicle: Vehicle) -> str | None:
    """Reason why cars cannot be tracked into this frame; None if they can."""
    if vehicle.camera.focal_px is None:
        return NO_FOCAL_LENGTH
    if ego is None or ego.way_m is None:
        return NO_ODOMETRY
    if ego.seconds > vehicle.cars.max_gap_s:
        return f"frames further than {vehicle.cars.max_gap_s:g} s apart"
    return None
