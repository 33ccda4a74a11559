"""Account for the candidates of every cue, frame by frame."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from crosscue.detectors.base import Detections
from crosscue.replay.vehicle.vehicle import CUES, CueSpec, Input, Vehicle

from .candidates import (
    BELOW_SCORE,
    CUT_OR_FAR,
    ELSEWHERE,
    NOT_COUNTED,
    NOT_FOUND_BEFORE,
    NOT_FROM_THE_SIDE,
    NOT_PAST,
    OTHER_MOTION,
    REGION_NOT_SEEN,
    SAME_OBJECT,
    TOO_FEW_FRAMES,
    TOO_LITTLE_ROAD,
    Candidates,
    Unit,
    label_scores,
    thresholds_met,
    unsure_of,
)
from .observed import CarCounts, RoadFractions, of_side


@dataclass(frozen=True, slots=True)
class CueTally:
    """Candidates of every evaluated cue, over the frames of a run.

    Attributes:
        vehicle: Labels and thresholds.
        by_cue: Candidates by cue, updated frame by frame; only cues with a label or a region.
    """

    vehicle: Vehicle
    by_cue: dict[str, Candidates] = field(default_factory=dict)

    def labelled(
        self, observed_by: Input, boxes: Sequence[Detections], counts: Mapping[str, int]
    ) -> None:
        """Account for cues that count detections by label.

        Args:
            observed_by: Input of the cues.
            boxes: Detections in which they were counted.
            counts: Counts of all cues.
        """
        for cue in CUES.values():
            labels = self.vehicle.labels_of(cue) if cue.observed_by == observed_by else ()
            if labels and cue.name in counts:
                setting, threshold = self.vehicle.threshold_of(cue)
                low = Counter() if setting is None else unsure_of(boxes, labels, threshold)
                self._count(cue.name, label_scores(boxes, labels), low, counts, setting)
                if setting is not None:
                    self.by_cue[cue.name].meet(thresholds_met(boxes, labels, threshold))

    def own(self, boxes: Sequence[Detections], counts: Mapping[str, int]) -> None:
        """Account for the user's cues."""
        for name, cue in self.vehicle.cues.own.items():
            if name not in counts:
                continue
            scores, setting = label_scores(boxes, cue.labels), f"[cues.own.{name}] score"
            low = unsure_of(boxes, cue.labels, cue.score)
            self._count(name, scores, low, counts, setting)
            self.by_cue[name].meet([cue.score])

    def cars(
        self, boxes: Sequence[Detections], shapes: int, pairs: int, counts: Mapping[str, int]
    ) -> None:
        """Account for cues that pair cars of consecutive frames.

        Args:
            boxes: All detections of the frame.
            shapes: Number of cars that pass the rules of shape and score.
            pairs: Number of those that were also in the previous frame.
            counts: Counts of all cues.
        """
        scores, low = self._cars(boxes)
        for cue in CUES.values():
            if cue.observed_by == "car pairs" and cue.group != "cars_past":
                self._of_cars(cue, boxes).take(
                    scores,
                    {
                        BELOW_SCORE: low,
                        NOT_FROM_THE_SIDE: len(scores) - low - shapes,
                        NOT_FOUND_BEFORE: shapes - pairs,
                        OTHER_MOTION: pairs - min(counts.get(cue.name, 0), pairs),
                    },
                )

    def followed(
        self, boxes: Sequence[Detections], judged: CarCounts, counts: Mapping[str, int]
    ) -> None:
        """Account for cues that track cars over several frames.

        Args:
            boxes: All detections of the frame.
            judged: Counts of the cars by behaviour.
            counts: Counts of all cues.
        """
        scores, low = self._cars(boxes)
        for cue in CUES.values():
            if cue.group == "cars_past" and cue.name in counts:
                self._of_cars(cue, boxes).take(
                    scores,
                    {BELOW_SCORE: low, NOT_PAST: len(scores) - low - counts[cue.name]},
                )
            if cue.group in ("cross_traffic", "parked"):
                here, there = _judged(judged, cue)
                self._of_cars(cue, boxes).take(
                    scores,
                    {
                        BELOW_SCORE: low,
                        CUT_OR_FAR: len(scores) - low - judged.seen,
                        TOO_FEW_FRAMES: judged.seen - judged.followed,
                        OTHER_MOTION: judged.followed - here - there,
                        ELSEWHERE: there,
                    },
                )

    def doubles(self, boxes: Sequence[Detections], counts: Mapping[str, int]) -> None:
        """Account for detections of objects that another detector found with a better score.

        Args:
            boxes: Detections that were left out.
            counts: Counts of all cues.
        """
        for name, labels in self.vehicle.cue_labels().items():
            scores = label_scores(boxes, labels) if name in counts else []
            if scores and name in self.by_cue:
                self.by_cue[name].take(scores, {SAME_OBJECT: len(scores)})

    def road(self, fractions: RoadFractions) -> None:
        """Account for cues of road in a region."""
        threshold = self.vehicle.cues.road_fraction
        for cue in CUES.values():
            side = cue.supports[0] if cue.supports else ""
            if cue.observed_by != "road" or side not in RoadFractions.__slots__:
                continue
            fraction: float = getattr(fractions, side)
            if math.isnan(fraction):
                unseen = self._of(cue.name, "frames", "[cues] road_fraction", threshold)
                unseen.take([0.0], {REGION_NOT_SEEN: 1})
                continue
            found = [fraction] if fraction > 0.0 else []
            low = sum(one <= threshold for one in found)
            counted = self._of(cue.name, "frames", "[cues] road_fraction", threshold)
            counted.take(found, {TOO_LITTLE_ROAD: low})

    def _count(
        self,
        name: str,
        scores: Sequence[float],
        low: Counter[str],
        counts: Mapping[str, int],
        setting: str | None,
    ) -> None:
        high = len(scores) - low.total()
        skipped = {**low, NOT_COUNTED: high - min(counts[name], high)}
        self._of(name, "detections", setting, None).take(scores, skipped)

    def _cars(self, boxes: Sequence[Detections]) -> tuple[list[float], int]:
        """Scores of all cars, and the number of scores that are too low."""
        cars = self.vehicle.cars
        low = unsure_of(boxes, cars.labels, cars.score).total()
        return label_scores(boxes, cars.labels), low

    def _of_cars(self, cue: CueSpec, boxes: Sequence[Detections]) -> Candidates:
        cars = self.vehicle.cars
        counted = self._of(cue.name, "detections", "[cars] score", None)
        counted.meet(thresholds_met(boxes, cars.labels, cars.score))
        return counted

    def _of(
        self, name: str, unit: Unit, setting: str | None, threshold: float | None
    ) -> Candidates:
        return self.by_cue.setdefault(name, Candidates(unit, setting, threshold))


def _judged(judged: CarCounts, cue: CueSpec) -> tuple[int, int]:
    """Number of cars that count for the cue, and of those that are not at the intersection."""
    if cue.group == "cross_traffic":
        return of_side(judged.crossing, cue), of_side(judged.crossing_elsewhere, cue)
    return of_side(judged.parked, cue), of_side(judged.parked_elsewhere, cue)
