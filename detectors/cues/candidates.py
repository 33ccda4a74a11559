"""Account of the candidates of each cue and range: used, or skipped with a reason.

A negative cue does not show whether nothing was visible or a threshold was too high. Therefore
candidates are counted, and the highest score is recorded.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final, Literal

if TYPE_CHECKING:
    from crosscue.detectors.base import Detections


SAME_OBJECT: Final = "found by another detector with a better score"
BELOW_SCORE: Final = "below score"
TOO_LITTLE_ROAD: Final = "too little road"
REGION_NOT_SEEN: Final = "not seen: hidden, too far, or never in view"
NOT_FROM_THE_SIDE: Final = "not seen from the side"
NOT_FOUND_BEFORE: Final = "not found in the frame before"
OTHER_MOTION: Final = "moves or faces otherwise"
NOT_PAST: Final = "not surely past the intersection, or not moving along the road"
CUT_OR_FAR: Final = "cut by the picture's edge or too far"
TOO_FEW_FRAMES: Final = "not followed over frames enough"
ELSEWHERE: Final = "not at the intersection, as far as its place is known"
NO_CURVE: Final = "no range curve"
TOO_LITTLE_EVIDENCE: Final = "not enough evidence over frames"
NOT_COUNTED: Final = "not counted by its rule"

Unit = Literal["detections", "frames"]


@dataclass(frozen=True, slots=True)
class Count:
    """What a rule returns: the count of its cue in one frame, and what became of each candidate.

    Attributes:
        number: The count; None where the cue is not known in this frame.
        scores: Score of each candidate.
        skipped: Number of candidates that are not in the count, by reason.
        thresholds: Scores that a candidate had to exceed.
        setting: Key of the threshold in the vehicle file; None without one.
        unit: What the candidates are; None where the rule does not report them.
    """

    number: int | None
    scores: Sequence[float] = ()
    skipped: Mapping[str, int] = field(default_factory=dict)
    thresholds: Sequence[float] = ()
    setting: str | None = None
    unit: Unit | None = "detections"


@dataclass(slots=True)
class Candidates:
    """Candidates of one cue or range over a run: ``seen`` = ``used`` + all ``skipped``.

    Attributes:
        unit: Unit of the counts: detections with the cue's labels, or frames with road in its
            region.
        setting: Key of the threshold in the vehicle file; None without a threshold.
        threshold: Score that a candidate must exceed; the lowest if detectors differ.
        seen: Number of candidates.
        used: Number of candidates that became the cue or the range.
        skipped: Number of skipped candidates, by reason.
        max_score: Highest score of a candidate; None without candidates.
    """

    unit: Unit
    setting: str | None = None
    threshold: float | None = None
    seen: int = 0
    used: int = 0
    skipped: dict[str, int] = field(default_factory=dict)
    max_score: float | None = None

    def take(self, found: Count) -> None:
        """Add the candidates of one frame."""
        self.seen += len(found.scores)
        self.used += len(found.scores) - sum(found.skipped.values())
        for reason, number in found.skipped.items():
            if number:
                self.skipped[reason] = self.skipped.get(reason, 0) + number
        known = (self.max_score,) if self.max_score is not None else ()
        self.max_score = max((*found.scores, *known), default=None)
        known = (self.threshold,) if self.threshold is not None else ()
        self.threshold = min((*found.thresholds, *known), default=None)


def take(by_cue: dict[str, Candidates], cue: str, found: Count) -> None:
    """Add the candidates of one frame to those of their cue, if the rule reports them."""
    if found.unit is None:
        return
    by_cue.setdefault(cue, Candidates(found.unit, found.setting)).take(found)


def count_by_label(
    boxes: Sequence[Detections],
    labels: Sequence[str],
    number: int,
    setting: str | None,
    score: float | None,
) -> Count:
    """Return a count of detections with one of the labels, and why the others are not in it.

    Args:
        boxes: Detections of a frame.
        labels: Labels of the candidates.
        number: The count.
        setting: Key of the threshold in the vehicle file; None if the rule has no threshold.
        score: The threshold; None uses the detectors'.
    """
    scores = label_scores(boxes, labels)
    if setting is None:
        return Count(number, scores, {NOT_COUNTED: len(scores) - min(number, len(scores))})
    low = unsure_of(boxes, labels, score)
    high = len(scores) - low.total()
    skipped = {**low, NOT_COUNTED: high - min(number, high)}
    return Count(number, scores, skipped, thresholds_met(boxes, labels, score), setting)


def label_scores(boxes: Sequence[Detections], labels: Sequence[str]) -> list[float]:
    """Scores of all detections with one of the labels."""
    return [
        score
        for found in boxes
        for label, score in zip(found.labels, found.scores.tolist(), strict=True)
        if label in labels
    ]


def unsure_of(
    boxes: Sequence[Detections], labels: Sequence[str], setting: float | None
) -> Counter[str]:
    """Numbers of detections with one of the labels that are no cue, by reason."""
    return Counter(
        (found.decisions[i] if found.decisions else "") or BELOW_SCORE
        for found in boxes
        for i, is_sure in enumerate(found.are_sure(setting).tolist())
        if found.labels[i] in labels and not is_sure
    )


def thresholds_met(
    boxes: Sequence[Detections], labels: Sequence[str], setting: float | None
) -> list[float]:
    """Thresholds that apply to the detections with one of the labels."""
    if setting is not None:
        return [setting]
    from crosscue.detectors.base import MIN_SCORE  # the account needs no detectors

    return [
        MIN_SCORE if found.min_scores is None else float(found.min_scores[i])
        for found in boxes
        for i, label in enumerate(found.labels)
        if label in labels
    ]
