"""Compute the cues of each frame from its detections, frame by frame in time order."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from crosscue.detectors.base import Detections, RoadMask
from crosscue.detectors.cues.tracked.judge import cars_past, count_cars
from crosscue.detectors.cues.tracked.motion import CarMotion
from crosscue.detectors.cues.tracked.tracks import CarTracks
from crosscue.detectors.ranging.control_tracks import ControlTracks
from crosscue.detectors.ranging.object_tracks import CarStep
from crosscue.replay.vehicle.vehicle import Vehicle

from .cars import CarShapes, Pairs, Tracker, car_shapes, pair_cars
from .labelled import count_labels
from .observed import NOT_SEEN, FrameCues, FrameDetections, Place
from .road import road_fractions
from .road_ground import ground_fractions
from .rules import counts_of
from .tally import CueTally


@dataclass(slots=True)
class CuePass:
    """Computes the cues of each frame; it remembers the objects of earlier frames.

    Attributes:
        vehicle: Regions and thresholds.
        tracker: Pairs cars of two frames, if the vehicle file has ``cars.kind = "pairs"``.
        tally: Account of all candidates; None to skip it.
        not_followed: Number of frames in which cars could not be tracked, by reason.
        controls: Tracks of stop signs and traffic lights.
    """

    vehicle: Vehicle
    tracker: Tracker = pair_cars
    tally: CueTally | None = None
    not_followed: Counter[str] = field(default_factory=Counter)
    controls: ControlTracks = field(init=False)
    _before: CarShapes | None = None
    _tracks: CarTracks | None = None
    _last_ns: int | None = None

    def __post_init__(self) -> None:
        self.controls = ControlTracks(self.vehicle)

    def __call__(
        self,
        frame: FrameDetections,
        ego: CarStep | None = None,
        place: Place | None = None,
        heights_px: Sequence[NDArray[np.float64]] | None = None,
    ) -> FrameCues:
        """Compute the cues of the next frame.

        Args:
            frame: Detections in the frame.
            ego: The ego vehicle's motion since the previous frame; None where unknown.
            place: Estimated position of the intersection; None where unknown.
            heights_px: Number of rows that each mask spans, by detector of objects; by default
                heights are those of boxes.
        """
        counts: dict[str, int] = {}
        pairs: Pairs | None = None
        passed_s = 0.0 if self._last_ns is None else (frame.t_ns - self._last_ns) * 1e-9
        self._last_ns = frame.t_ns
        if frame.objects:
            motion = CarStep(None, 0.0, 0.0, max(passed_s, 0.0)) if ego is None else ego
            frame = replace(frame, objects=self.controls(frame.objects, motion, heights_px))
            counts |= counts_of("objects", frame.objects, self.vehicle)
            pairs = self._cars(frame.objects, ego, place)
            if pairs is not None:
                counts |= counts_of("car pairs", pairs, self.vehicle)
        if frame.boxes:
            counts |= counts_of("signs", frame.boxes, self.vehicle)
            for name, own in self.vehicle.cues.own.items():
                counts[name] = count_labels(frame.boxes, own.labels, own.score)
        if frame.labels is not None:
            wanted = self.vehicle.cue_labels()
            counts = {
                cue: count
                for cue, count in counts.items()
                if not wanted[cue] or not frame.labels.isdisjoint(wanted[cue])
            }
        road = frame.road
        if isinstance(road, RoadMask):
            regions = self.vehicle.regions
            if regions.kind == "area":
                # Known only from many frames together; the stage that has them passes fractions.
                road = NOT_SEEN
            elif regions.kind == "ground":
                road = ground_fractions(road, self.vehicle.camera, regions, place)
            else:
                road = road_fractions(road, regions)
        if road is not None:
            counts |= counts_of("road", road, self.vehicle)
        found = FrameCues(counts, road, frame.objects)
        if self.tally is not None:
            self._explain(self.tally, frame, pairs, found)
        return found

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

    def _explain(
        self, tally: CueTally, frame: FrameDetections, pairs: Pairs | None, found: FrameCues
    ) -> None:
        tally.labelled("objects", frame.objects, found.counts)
        tally.labelled("signs", frame.boxes, found.counts)
        tally.own(frame.boxes, found.counts)
        is_any = frame.labels is None or not frame.labels.isdisjoint(self.vehicle.cars.labels)
        if pairs is not None and pairs.judged is not None and is_any:
            tally.followed(frame.objects, pairs.judged, found.counts)
        elif self._before is not None and frame.objects and is_any:
            again = 0 if pairs is None else len(pairs.nose)
            tally.cars(frame.objects, len(self._before), again, found.counts)
        if frame.doubles:
            tally.doubles(frame.doubles, found.counts)
        if found.road is not None:
            tally.road(found.road)

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
        standing = self._tracks.standing()
        judged = count_cars(found, standing, self._tracks.seen, camera, cars, place)
        judged = judged._replace(past=cars_past(self._tracks.longer(), camera, cars, place))
        return Pairs(
            np.array([car.step_px for car in found]).reshape(-1, 2),
            np.array([car.center_px for car in found]).reshape(-1, 2),
            np.sign([car.nose for car in found]).astype(np.int64),
            boxes[0].size_px[0],
            judged,
        )

    def _pairs(self, boxes: Sequence[Detections]) -> Pairs | None:
        """Cars found in the previous frame and this one; None in the first frame."""
        now = car_shapes(boxes, self.vehicle.cars)
        before, self._before = self._before, now
        return None if before is None else self.tracker(before, now, self.vehicle.cars)


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
