"""Fit of one class of a detector: threshold and calibration, tested on held-out pictures.

The bound is Clopper and Pearson's (Biometrika 26, 1934), one-sided. The threshold is chosen on the
same detections. Each of ``TRIED`` candidates is therefore held to a part of the allowed risk
(Bonferroni), so that with the stated confidence no candidate that passes is less precise than
required. Candidates are determined by the number of detections above them, and never by which
detections are right.

The bound assumes independent detections. Those of neighbouring frames are not independent, so a
bound from one short drive means little for other drives.
"""

import math
from dataclasses import dataclass, field, replace
from typing import ClassVar, Final, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from crosscue.detectors.catalog.class_scores import ClassScores, Platt
from crosscue.detectors.training.operating_point import fit_platt
from crosscue.eval.scoring.boxes.reliability import class_calibration
from crosscue.eval.scoring.intervals import Interval, lower_bound, wilson
from crosscue.replay.columns import Floats
from crosscue.replay.safe_text import counted
from crosscue.results import HIDDEN, json_key

CalibrationKind: TypeAlias = Literal["platt", "none"]
# What is labelled: boxes, or whether a picture shows such an object.
LabelUnit: TypeAlias = Literal["boxes", "pictures"]
CALIBRATIONS: Final[tuple[CalibrationKind, ...]] = ("platt", "none")
NOT_LABELLED: Final = "not labelled"
# Min number of labelled boxes to fit a class.
MIN_LABELS: Final = 20
# Min number of right and of wrong detections to calibrate scores.
MIN_EACH: Final = 10

TRIED: Final = 8


@dataclass(frozen=True, slots=True, eq=False)
class ClassDetections:
    """Detections of one class in some pictures.

    Attributes:
        scores: Scores of the detections, shape (N,).
        is_right: True for detections that match a label, shape (N,).
        labels: Number of labelled boxes, or of pictures that show such an object.
        unit: What is labelled; of pictures, the best detection counts.
    """

    scores: Floats
    is_right: NDArray[np.bool_]
    labels: int
    unit: LabelUnit = "boxes"


@dataclass(frozen=True, slots=True)
class HeldOut:
    """Result of the fit on held-out pictures.

    Attributes:
        right: Number of detections above the threshold that match a label.
        of: Number of detections above the threshold; 0 without a threshold.
        labels: Number of labelled boxes.
        interval: 95 % interval of the precision, for independent detections.
        bound: One-sided lower bound of the precision, with the confidence of the fit.
        error_before: Expected calibration error of the network's scores.
        error_after: Expected calibration error of the calibrated scores.
        detections: Number of detections behind both errors.
    """

    right: int
    of: int
    labels: int
    interval: Interval
    bound: float
    error_before: float
    error_after: float
    detections: int

    also: ClassVar = {name: name for name in ("precision", "recall")}

    @property
    def is_worse(self) -> bool:
        """Whether the calibrated scores have a larger error than the network's."""
        return self.error_after > self.error_before

    @property
    def precision(self) -> float:
        """Precision; NaN without detections."""
        return self.right / self.of if self.of else math.nan

    @property
    def recall(self) -> float:
        """Recall; NaN without labels."""
        return self.right / self.labels if self.labels else math.nan


@dataclass(frozen=True, slots=True)
class ClassFit:
    """Fit of one class.

    Attributes:
        name: Name of the class.
        members: The detector's labels that count as this class.
        labels: Number of labelled boxes fitted to.
        detections: Number of detections fitted to.
        right: Number of these detections that match a label.
        scores: Entry for the card; None if the class was not fitted.
        bound: Lower bound of the precision above the threshold; NaN without a threshold.
        held_out: Result on held-out pictures; None without a threshold and a calibration.
        notes: Reasons why something was not fitted.
        unit: What is labelled.
        seen: The detections fitted to, and those held out.
    """

    name: str = field(metadata=json_key("class"))
    members: tuple[str, ...] = field(metadata=json_key("labels"))
    labels: int = field(metadata=json_key("boxes"))
    detections: int
    right: int
    scores: ClassScores | None
    bound: float
    held_out: HeldOut | None
    notes: tuple[str, ...]
    unit: LabelUnit = field(metadata=HIDDEN)
    seen: tuple[ClassDetections, ClassDetections] = field(metadata=HIDDEN)

    @property
    def counted(self) -> tuple[str, str]:
        """Numbers of labels and detections, with what they count."""
        return _labels(self.labels, self.unit), _detections(self.detections, self.unit)


def _labels(count: int, unit: LabelUnit) -> str:
    if unit == "boxes":
        return counted(count, "box", "boxes")
    return counted(count, "picture with it", "pictures with it")


def _detections(count: int, unit: LabelUnit) -> str:
    if unit == "boxes":
        return counted(count, "detection")
    return counted(count, "picture with a detection", "pictures with a detection")


def fit_class(
    name: str,
    members: tuple[str, ...],
    chosen_on: ClassDetections,
    held_out: ClassDetections,
    precision: float,
    confidence: float,
    kind: CalibrationKind,
) -> ClassFit:
    """Fit one class.

    Args:
        name: Name of the class.
        members: The detector's labels of the class.
        chosen_on: Detections to fit to.
        held_out: Detections to test on.
        precision: Required precision.
        confidence: Confidence of the precision's lower bound.
        kind: Kind of calibration.
    """
    n, right = len(chosen_on.scores), int(chosen_on.is_right.sum())
    unit = chosen_on.unit
    base = ClassFit(
        name, members, chosen_on.labels, n, right, None, math.nan, None, (), unit,
        (chosen_on, held_out),
    )  # fmt: skip
    if not chosen_on.labels + held_out.labels:
        return replace(base, notes=(NOT_LABELLED,))
    if chosen_on.labels < MIN_LABELS:
        why = f"{_labels(chosen_on.labels, unit)}, {MIN_LABELS} needed: not fitted"
        return replace(base, notes=(why,))
    notes = []
    calibration = _calibration(chosen_on, kind)
    if calibration is None and kind != "none":
        notes.append(
            f"scores not calibrated: {right} right and {counted(n - right, 'wrong detection')}, "
            f"{MIN_EACH} of each needed"
        )
    found = bounded_threshold(chosen_on.scores, chosen_on.is_right, precision, confidence)
    if found is None:
        notes.append(_why_none(chosen_on, precision, confidence))
        scores = None if calibration is None else ClassScores(calibration=calibration)
        held = None if scores is None else _held_out(held_out, scores, confidence)
        return replace(base, scores=scores, held_out=held, notes=tuple(notes))
    low, high = _applied(calibration, np.array([found.score, found.next_score])).tolist()
    scores = ClassScores(threshold=round_between(low, high), calibration=calibration)
    held = _held_out(held_out, scores, confidence)
    return replace(base, scores=scores, bound=found.bound, held_out=held, notes=tuple(notes))


def _calibration(judged: ClassDetections, kind: CalibrationKind) -> Platt | None:
    right = int(judged.is_right.sum())
    if kind == "none" or min(right, len(judged.is_right) - right) < MIN_EACH:
        return None
    return fit_platt(judged.scores, judged.is_right)


def _applied(calibration: Platt | None, scores: Floats) -> Floats:
    return scores if calibration is None else calibration.probabilities(scores)


def _why_none(judged: ClassDetections, precision: float, confidence: float) -> str:
    fewest = fewest_detections(precision, confidence)
    if len(judged.scores) < fewest:
        return f"no threshold: {counted(len(judged.scores), 'detection')}, at least {fewest} needed"
    found = _candidates(judged.scores, judged.is_right, precision, confidence)
    best = max(one.bound for one in found)
    return f"no threshold reaches {precision:g}: the best lower bound is {best:.3f}"


def _held_out(judged: ClassDetections, by: ClassScores, confidence: float) -> HeldOut:
    after = _applied(by.calibration, judged.scores)
    sure = after > (math.inf if by.threshold is None else by.threshold)
    right, of = int((judged.is_right & sure).sum()), int(sure.sum())
    return HeldOut(
        right,
        of,
        judged.labels,
        wilson(right, of),
        lower_bound(right, of, confidence),
        class_calibration("", judged.scores, judged.is_right).error,
        class_calibration("", after, judged.is_right).error,
        len(after),
    )


@dataclass(frozen=True, slots=True)
class Threshold:
    """A score threshold and the detections above it.

    Attributes:
        score: The threshold; detections with a higher score count.
        next_score: The lowest score above the threshold.
        right: Number of detections above the threshold that are right.
        of: Number of detections above the threshold.
        bound: Lower bound of their precision, with the required confidence.
    """

    score: float
    next_score: float
    right: int
    of: int
    bound: float


def fewest_detections(precision: float, confidence: float) -> int:
    """Return the min number of detections needed for a threshold if all of them are right."""
    risk = (1.0 - confidence) / TRIED
    return math.ceil(math.log(risk) / math.log(precision))


def bounded_threshold(
    scores: Floats, is_right: NDArray[np.bool_], precision: float, confidence: float
) -> Threshold | None:
    """Return the lowest candidate whose bound is high enough, or None.

    Args:
        scores: Scores of the detections, shape (N,).
        is_right: True for detections that match a label, shape (N,).
        precision: Required precision, in (0, 1).
        confidence: Confidence of the bound, in (0, 1).
    """
    found = _candidates(scores, is_right, precision, confidence)
    good = [one for one in found if one.bound >= precision]
    return good[-1] if good else None


def _candidates(
    scores: Floats, is_right: NDArray[np.bool_], precision: float, confidence: float
) -> list[Threshold]:
    """Return candidates whose numbers of detections above them increase geometrically."""
    n, fewest = len(scores), fewest_detections(precision, confidence)
    if n < fewest:
        return []
    order = np.argsort(-scores, kind="stable")
    falling, right = scores[order], np.cumsum(is_right[order])
    counts = np.unique(np.rint(np.geomspace(fewest, n, TRIED)).astype(np.int64))
    each = 1.0 - (1.0 - confidence) / TRIED
    found = []
    for count in counts.tolist():
        # Detections with equal scores are on the same side of a threshold.
        of = int(np.searchsorted(-falling, -falling[count - 1], side="right"))
        above = float(falling[of - 1])
        below = float(falling[of]) if of < n else max(above - 0.01, 0.0)
        bound = lower_bound(int(right[of - 1]), of, each)
        found.append(Threshold(below, above, int(right[of - 1]), of, bound))
    return found


def round_between(low: float, high: float) -> float:
    """Return the shortest decimal number in [low, high), for files that people read."""
    for digits in range(2, 17):
        found = round(0.5 * (low + high), digits)
        if low <= found < high:
            return found
    return low
