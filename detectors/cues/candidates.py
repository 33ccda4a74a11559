"""What became of everything that a cue or a range could have come from: used, or skipped and why.

A cue that stays negative reads the same whether there was nothing to see or a threshold was too
high. So candidates are counted, and with them the highest score that was met.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final, Literal

from crosscue.detectors.base import MIN_SCORE, Detections

SAME_OBJECT: Final = "found by another detector with a better score"
BELOW_SCORE: Final = "below score"
TOO_LITTLE_ROAD: Final = "too little road"
REGION_NOT_SEEN: Final = "region not seen: its place unknown, or too far to be resolved"
NOT_FROM_THE_SIDE: Final = "not seen from the side"
NOT_FOUND_BEFORE: Final = "not found in the frame before"
OTHER_MOTION: Final = "moves or faces otherwise"
NOT_PAST: Final = "not surely past the intersection, or not moving along the road"
CUT_OR_FAR: Final = "cut by the picture's edge or too far"
TOO_FEW_FRAMES: Final = "not followed over frames enough"
ELSEWHERE: Final = "not at the intersection, as far as its place is known"
NO_CURVE: Final = "no range curve"
NOT_COUNTED: Final = "not counted by its rule"

Unit = Literal["detections", "frames"]


@dataclass(slots=True)
class Candidates:
    """Of one cue or range, over a run: ``seen`` = ``used`` + all ``skipped``.

    Attributes:
        unit: What is counted: detections with the cue's labels, or frames with road in its region.
        setting: Where the threshold is set in the vehicle file; None where it has none.
        threshold: Only a higher score counts; the lowest, where detectors differ.
        seen: How many there were.
        used: How many became the cue or the range.
        skipped: How many did not, by reason.
        max_score: The highest score met; None without any.
    """

    unit: Unit
    setting: str | None = None
    threshold: float | None = None
    seen: int = 0
    used: int = 0
    skipped: dict[str, int] = field(default_factory=dict)
    max_score: float | None = None

    def meet(self, thresholds: Sequence[float]) -> None:
        """Keep the lowest threshold that a candidate was held to."""
        met = [*thresholds, *(() if self.threshold is None else (self.threshold,))]
        self.threshold = min(met, default=None)

    def take(self, scores: Sequence[float], skipped: Mapping[str, int]) -> None:
        """Count candidates with these scores, of which so many were skipped."""
        self.seen += len(scores)
        self.used += len(scores) - sum(skipped.values())
        for reason, number in skipped.items():
            if number:
                self.skipped[reason] = self.skipped.get(reason, 0) + number
        if scores:
            best = max(scores)
            self.max_score = best if self.max_score is None else max(self.max_score, best)


def scores_of(boxes: Sequence[Detections], labels: Sequence[str]) -> list[float]:
    """Scores of all detections with one of the labels."""
    return [
        score
        for found in boxes
        for label, score in zip(found.labels, found.scores.tolist(), strict=True)
        if label in labels
    ]


def unsure_of(boxes: Sequence[Detections], labels: Sequence[str], setting: float | None) -> int:
    """How many detections with one of the labels are not sure enough for a cue."""
    return sum(
        label in labels and not is_sure
        for found in boxes
        for label, is_sure in zip(found.labels, found.are_sure(setting).tolist(), strict=True)
    )


def thresholds_met(
    boxes: Sequence[Detections], labels: Sequence[str], setting: float | None
) -> list[float]:
    """The thresholds that detections with one of the labels are held to."""
    if setting is not None:
        return [setting]
    return [
        MIN_SCORE if found.min_scores is None else float(found.min_scores[i])
        for found in boxes
        for i, label in enumerate(found.labels)
        if label in labels
    ]
