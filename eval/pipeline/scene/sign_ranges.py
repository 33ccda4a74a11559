"""Ranges to an intersection from the heights of signs and lights in one frame."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

from crosscue.detectors.base import Detections
from crosscue.detectors.cues.candidates import (
    Candidates,
    Count,
    label_scores,
    take,
    thresholds_met,
)
from crosscue.detectors.ranging.height_to_range import range_of
from crosscue.detectors.ranging.usable import source_of, why_not
from crosscue.fusion.evidence import SignRange
from crosscue.fusion.intersection_range import Reference
from crosscue.replay.vehicle.vehicle import STOP_SIGN, TRAFFIC_LIGHT, RangeCurve, Vehicle

# Cues of the dissertation whose detections measure a range, with its reference.
MEASURED: Final = ((STOP_SIGN, Reference.START), (TRAFFIC_LIGHT, Reference.END))


@dataclass(frozen=True, slots=True)
class SignRanges:
    """Ranges from heights: stop signs measure the intersection's start, traffic lights its end.

    Attributes:
        vehicle: Labels, scores and curves. Objects whose range comes from motion only have their
            candidates counted here.
        by_cue: Numbers of all candidates so far by outcome, by cue.
    """

    vehicle: Vehicle
    by_cue: dict[str, Candidates] = field(default_factory=dict)

    def __call__(self, found: Sequence[Detections]) -> tuple[SignRange, ...]:
        """Return the ranges of one frame, from the detections of each detector of objects."""
        return tuple(one for row in range(len(MEASURED)) for one in self._of_cue(found, row))

    def _of_cue(self, found: Sequence[Detections], row: int) -> list[SignRange]:
        cue, reference = MEASURED[row]
        labels = self.vehicle.labels_of(cue)
        curve: RangeCurve | None = getattr(self.vehicle.ranges, cue.name)
        setting, threshold = self.vehicle.threshold_of(cue)
        source = source_of(self.vehicle, cue.name)
        ranges: list[SignRange] = []
        skipped: Counter[str] = Counter()
        for detections in found:
            are_sure = detections.are_sure(threshold)
            for i, label in enumerate(detections.labels):
                if label not in labels:
                    continue
                why = why_not(detections, i, are_sure, source)
                if why is not None:
                    skipped[why] += 1
                elif curve is not None and source == "curve":
                    range_m = float(range_of(detections.heights_px[i : i + 1], curve)[0])
                    ranges.append(SignRange(reference, range_m, curve.residual_sd_m**2))
        met = thresholds_met(found, labels, threshold)
        take(self.by_cue, cue.name, Count(None, label_scores(found, labels), skipped, met, setting))
        return ranges
