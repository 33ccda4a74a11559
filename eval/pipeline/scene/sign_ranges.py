"""Distances to an intersection from the signs and lights of one frame, and why some have none."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from crosscue.detectors.base import Detections
from crosscue.detectors.cues.candidates import (
    BELOW_SCORE,
    NO_CURVE,
    Candidates,
    scores_of,
    thresholds_met,
)
from crosscue.detectors.ranging.height_to_range import range_of
from crosscue.fusion.evidence import SignRange
from crosscue.fusion.intersection_range import Reference
from crosscue.replay.vehicle.vehicle import STOP_SIGN, TRAFFIC_LIGHT, RangeCurve, Vehicle


@dataclass(frozen=True, slots=True)
class SignRanges:
    """A stop sign measures the start of the intersection, a traffic light its end.

    Attributes:
        vehicle: Labels, scores and curves; of objects whose range comes from motion none is made
            here, but candidates are counted.
        by_cue: What became of all candidates so far, by the cue that they belong to.
    """

    vehicle: Vehicle
    by_cue: dict[str, Candidates] = field(default_factory=dict)

    def __call__(
        self, found: Sequence[Detections], heights_px: Sequence[NDArray[np.float64]]
    ) -> tuple[SignRange, ...]:
        """Ranges of one frame.

        Args:
            found: Of the detectors of objects.
            heights_px: For each, the rows that every mask spans.
        """
        return tuple(
            one for row in range(len(MEASURED)) for one in self._of_cue(found, heights_px, row)
        )

    def _of_cue(
        self, found: Sequence[Detections], heights_px: Sequence[NDArray[np.float64]], row: int
    ) -> list[SignRange]:
        """Of one row of ``MEASURED``."""
        cue, reference = MEASURED[row]
        labels = self.vehicle.labels_of(cue)
        curve: RangeCurve | None = getattr(self.vehicle.ranges, cue.name)
        setting, threshold = self.vehicle.threshold_of(cue)
        source = source_of(self.vehicle, cue.name)
        ranges: list[SignRange] = []
        skipped: Counter[str] = Counter()
        for detections, heights in zip(found, heights_px, strict=True):
            are_sure = detections.are_sure(threshold)
            for i, label in enumerate(detections.labels):
                if label not in labels:
                    continue
                why = why_not(detections, heights, i, are_sure, source)
                if why is not None:
                    skipped[why] += 1
                elif curve is not None and source == "curve":
                    range_m = float(range_of(np.array([heights[i]]), curve)[0])
                    ranges.append(SignRange(reference, range_m, curve.residual_sd_m**2))
        counted = self.by_cue.setdefault(cue.name, Candidates("detections", setting, threshold))
        counted.meet(thresholds_met(found, labels, threshold))
        counted.take(scores_of(found, labels), skipped)
        return ranges


BORDER_PX: Final = 2.0
"""A sign that reaches the picture's edge is cut, so its height says nothing of its distance."""

Source = Literal["curve", "motion"]
NO_HEIGHT: Final = "no height"
CUT: Final = "cut by the picture's edge"
MEASURED: Final = ((STOP_SIGN, Reference.START), (TRAFFIC_LIGHT, Reference.END))
"""Cues whose detections measure a distance, and to where: the source's."""


def source_of(vehicle: Vehicle, cue: str) -> Source | None:
    """Where ranges to a cue's objects come from; None if there is neither curve nor camera."""
    chosen = vehicle.ranges.kind
    if chosen != "motion" and getattr(vehicle.ranges, cue) is not None:
        return "curve"
    return None if chosen == "curve" or vehicle.camera.focal_px is None else "motion"


def why_not(
    found: Detections,
    heights_px: NDArray[np.float64],
    i: int,
    are_sure: NDArray[np.bool_],
    source: Source | None,
) -> str | None:
    """Why a detection has no range; None where it has one, or belongs to a track that has."""
    if not are_sure[i]:
        return BELOW_SCORE
    if heights_px[i] <= 0.0:
        return NO_HEIGHT
    width, height = found.size_px
    x0, y0, x1, y1 = found.boxes_px[i].tolist()
    if min(x0, y0) < BORDER_PX or x1 > width - BORDER_PX or y1 > height - BORDER_PX:
        return CUT
    return NO_CURVE if source is None else None


class Usable(NamedTuple):
    """N detections that may give a range.

    Attributes:
        boxes_px: Shape (N, 4).
        heights_px: Shape (N,).
        lenses: N lenses of lights, empty where nobody looked.
    """

    boxes_px: NDArray[np.float64]
    heights_px: NDArray[np.float64]
    lenses: tuple[str, ...]


def usable(
    vehicle: Vehicle,
    row: int,
    found: Sequence[Detections],
    heights_px: Sequence[NDArray[np.float64]],
) -> Usable:
    """Detections of one row of ``MEASURED``; ``SignRanges`` counts the rest."""
    cue, _ = MEASURED[row]
    labels = vehicle.labels_of(cue)
    _, score = vehicle.threshold_of(cue)
    some = [
        (detections.boxes_px[i], float(heights[i]), *(detections.lenses[i : i + 1] or ("",)))
        for detections, heights, are_sure in zip(
            found, heights_px, (one.are_sure(score) for one in found), strict=True
        )
        for i, label in enumerate(detections.labels)
        if label in labels and why_not(detections, heights, i, are_sure, "motion") is None
    ]
    boxes = np.array([box for box, _, _ in some]).reshape(-1, 4)
    heights = np.array([height for _, height, _ in some])
    return Usable(boxes, heights, tuple(lens for _, _, lens in some))
