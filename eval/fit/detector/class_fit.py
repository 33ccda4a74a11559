"""Fit of one class of a detector: threshold and calibration, tested on held-out pictures."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from crosscue.detectors.catalog.class_scores import ClassScores, Isotonic, Platt
from crosscue.detectors.training.operating_point import fit_isotonic, fit_platt
from crosscue.eval.scoring.boxes.reliability import class_calibration
from crosscue.eval.scoring.intervals import Interval, wilson

from .threshold import best_bound, bounded_threshold, fewest_detections, lower_bound, round_between

CalibrationKind: TypeAlias = Literal["platt", "isotonic", "none"]
# What is labelled: boxes, or whether a picture shows such an object.
LabelUnit: TypeAlias = Literal["boxes", "pictures"]
CALIBRATIONS: Final[tuple[CalibrationKind, ...]] = ("platt", "isotonic", "none")
NOT_LABELLED: Final = "not labelled"
# Min number of labelled boxes to fit a class.
MIN_LABELS: Final = 20
# Min number of right and of wrong detections to calibrate scores.
MIN_EACH: Final = 10


@dataclass(frozen=True, slots=True, eq=False)
class ClassDetections:
    """Detections of one class in some pictures.

    Attributes:
        scores: Scores of the detections, shape (N,).
        is_right: True for detections that match a label, shape (N,).
        labels: Number of labelled boxes, or of pictures that show such an object.
        unit: What is labelled; of pictures, the best detection counts.
    """

    scores: NDArray[np.float64]
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
    """

    name: str
    members: tuple[str, ...]
    labels: int
    detections: int
    right: int
    scores: ClassScores | None
    bound: float
    held_out: HeldOut | None
    notes: tuple[str, ...]
    unit: LabelUnit = "boxes"

    @property
    def counted(self) -> tuple[str, str]:
        """What ``labels`` and ``detections`` count, in words."""
        return _COUNTED[self.unit]


_COUNTED: Final[dict[LabelUnit, tuple[str, str]]] = {
    "boxes": ("boxes", "detections"),
    "pictures": ("pictures with it", "pictures with a detection"),
}


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
    if not chosen_on.labels + held_out.labels:
        return ClassFit(name, members, 0, n, right, None, math.nan, None, (NOT_LABELLED,), unit)
    if chosen_on.labels < MIN_LABELS:
        why = f"{chosen_on.labels} {_COUNTED[unit][0]}, {MIN_LABELS} needed: not fitted"
        return ClassFit(
            name, members, chosen_on.labels, n, right, None, math.nan, None, (why,), unit
        )
    notes = []
    calibration = _calibration(chosen_on, kind)
    if calibration is None and kind != "none":
        notes.append(
            f"scores not calibrated: {right} right and {n - right} wrong detections, {MIN_EACH} of "
            "each needed"
        )
    found = bounded_threshold(chosen_on.scores, chosen_on.is_right, precision, confidence)
    if found is None:
        notes.append(_why_none(chosen_on, precision, confidence))
        scores = None if calibration is None else ClassScores(calibration=calibration)
        held = None if scores is None else _held_out(held_out, scores, confidence)
        return ClassFit(
            name, members, chosen_on.labels, n, right, scores, math.nan, held, tuple(notes), unit
        )
    low, high = _applied(calibration, np.array([found.score, found.next_score])).tolist()
    scores = ClassScores(threshold=round_between(low, high), calibration=calibration)
    return ClassFit(
        name,
        members,
        chosen_on.labels,
        n,
        right,
        scores,
        found.bound,
        _held_out(held_out, scores, confidence),
        tuple(notes),
        unit,
    )


def _calibration(judged: ClassDetections, kind: CalibrationKind) -> Platt | Isotonic | None:
    right = int(judged.is_right.sum())
    if kind == "none" or min(right, len(judged.is_right) - right) < MIN_EACH:
        return None
    return (fit_platt if kind == "platt" else fit_isotonic)(judged.scores, judged.is_right)


def _applied(
    calibration: Platt | Isotonic | None, scores: NDArray[np.float64]
) -> NDArray[np.float64]:
    return scores if calibration is None else calibration.probabilities(scores)


def _why_none(judged: ClassDetections, precision: float, confidence: float) -> str:
    fewest = fewest_detections(precision, confidence)
    if len(judged.scores) < fewest:
        return f"no threshold: {len(judged.scores)} detections, at least {fewest} needed"
    best = best_bound(judged.scores, judged.is_right, precision, confidence)
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
