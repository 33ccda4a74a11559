"""One class of a detector: threshold and calibration on some pictures, and the result on others."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from crosscue.detectors.catalog.class_scores import ClassScores, Isotonic, Platt
from crosscue.detectors.training.platt import fit_isotonic, fit_platt
from crosscue.eval.scoring.boxes.reliability import reliability
from crosscue.eval.scoring.intervals import Interval, wilson

from .threshold import best_bound, fewest_detections, lower_bound, round_between, threshold_for

CalibrationKind: TypeAlias = Literal["platt", "isotonic", "none"]
CALIBRATIONS: Final[tuple[CalibrationKind, ...]] = ("platt", "isotonic", "none")
MIN_LABELS: Final = 20
"""A class with fewer labelled boxes is left as it is."""
MIN_EACH: Final = 10
"""Without so many right and so many wrong detections, scores are not calibrated."""


@dataclass(frozen=True, slots=True, eq=False)
class Judged:
    """Detections of one class in some pictures.

    Attributes:
        scores: Shape (N,).
        is_right: Shape (N,).
        labels: Boxes to be found.
    """

    scores: NDArray[np.float64]
    is_right: NDArray[np.bool_]
    labels: int


@dataclass(frozen=True, slots=True)
class HeldOut:
    """What the fit is worth on pictures that it has not seen.

    Attributes:
        right: Detections above the threshold on a label.
        of: All above the threshold.
        labels: Boxes to be found.
        interval: Of the precision, 95 %, as if detections were independent.
        bound: Of it too, one-sided, with the confidence of the fit: what is shown of it.
        error_before: Expected calibration error of the network's scores.
        error_after: Of the calibrated ones.
        detections: That both are made of.
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
    def precision(self) -> float:
        """NaN for none."""
        return self.right / self.of if self.of else math.nan

    @property
    def recall(self) -> float:
        """NaN for none."""
        return self.right / self.labels if self.labels else math.nan


@dataclass(frozen=True, slots=True)
class ClassFit:
    """One class.

    Attributes:
        name: As judged.
        members: The detector's labels that it is made of.
        labels: Boxes that were fitted to.
        detections: Likewise.
        right: Of these.
        scores: What the card gets; None where the class is left as it is.
        bound: Lower bound of the precision above the threshold; NaN without one.
        held_out: The result on other pictures; None without a threshold.
        notes: Why something was not fitted.
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


def fit_class(
    name: str,
    members: tuple[str, ...],
    chosen_on: Judged,
    held_out: Judged,
    precision: float,
    confidence: float,
    kind: CalibrationKind,
) -> ClassFit:
    """Fit one class.

    Args:
        name: Of the class.
        members: The detector's labels.
        chosen_on: What it is fitted to.
        held_out: What shows the result.
        precision: Required.
        confidence: Of its bound.
        kind: Of calibration.
    """
    n, right = len(chosen_on.scores), int(chosen_on.is_right.sum())
    if chosen_on.labels < MIN_LABELS:
        why = f"{chosen_on.labels} labelled boxes, {MIN_LABELS} needed: left as it is"
        return ClassFit(name, members, chosen_on.labels, n, right, None, math.nan, None, (why,))
    notes = []
    calibration = _calibration(chosen_on, kind)
    if calibration is None and kind != "none":
        notes.append(
            f"scores not calibrated: {right} right and {n - right} wrong detections, {MIN_EACH} of "
            "each needed"
        )
    found = threshold_for(chosen_on.scores, chosen_on.is_right, precision, confidence)
    if found is None:
        notes.append(_why_none(chosen_on, precision, confidence))
        scores = None if calibration is None else ClassScores(calibration=calibration)
        return ClassFit(
            name, members, chosen_on.labels, n, right, scores, math.nan, None, tuple(notes)
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
    )


def _calibration(judged: Judged, kind: CalibrationKind) -> Platt | Isotonic | None:
    right = int(judged.is_right.sum())
    if kind == "none" or min(right, len(judged.is_right) - right) < MIN_EACH:
        return None
    return (fit_platt if kind == "platt" else fit_isotonic)(judged.scores, judged.is_right)


def _applied(
    calibration: Platt | Isotonic | None, scores: NDArray[np.float64]
) -> NDArray[np.float64]:
    return scores if calibration is None else calibration.probabilities(scores)


def _why_none(judged: Judged, precision: float, confidence: float) -> str:
    fewest = fewest_detections(precision, confidence)
    if len(judged.scores) < fewest:
        return f"no threshold: {len(judged.scores)} detections, at least {fewest} needed"
    best = best_bound(judged.scores, judged.is_right, precision, confidence)
    return f"no threshold reaches {precision:g}: the best is surely above {best:.3f} only"


def _held_out(judged: Judged, by: ClassScores, confidence: float) -> HeldOut:
    after = _applied(by.calibration, judged.scores)
    sure = after > (by.threshold or 0.0)
    right, of = int((judged.is_right & sure).sum()), int(sure.sum())
    return HeldOut(
        right,
        of,
        judged.labels,
        wilson(right, of),
        lower_bound(right, of, confidence),
        reliability("", judged.scores, judged.is_right).error,
        reliability("", after, judged.is_right).error,
        len(after),
    )
