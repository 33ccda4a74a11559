"""Calibrate the scores of detections, and choose the minimum score of a sign for a precision."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from crosscue.detectors.boxes import box_ious
from crosscue.detectors.catalog.class_scores import Platt


@dataclass(frozen=True, slots=True, eq=False)
class Verdicts:
    """Judged detections in annotated frames, as columns of length N.

    Attributes:
        scores: Shape (N,), float64.
        is_right: Shape (N,), bool: matched to a true sign that no better detection matched.
        signs: Number of true signs.
    """

    scores: NDArray[np.float64]
    is_right: NDArray[np.bool_]
    signs: int


@dataclass(frozen=True, slots=True)
class DetectionCounts:
    """Counts of detections at a threshold.

    Attributes:
        found: Number of detections at or above the threshold.
        right: Number of correct ones among them.
        signs: Number of true signs.
    """

    found: int
    right: int
    signs: int

    @property
    def precision(self) -> float:
        """Fraction of detections that are correct; NaN without detections."""
        return self.right / self.found if self.found else float("nan")

    @property
    def recall(self) -> float:
        """Fraction of true signs that are found; NaN without true signs."""
        return self.right / self.signs if self.signs else float("nan")


def match_boxes(
    boxes_px: NDArray[np.float64],
    scores: NDArray[np.float64],
    truth_px: NDArray[np.float64],
    min_overlap: float,
    counts: NDArray[np.bool_],
) -> Verdicts:
    """Match the detections of one frame to true boxes, each at most once, best scores first.

    Args:
        boxes_px: Shape (N, 4).
        scores: Shape (N,).
        truth_px: Shape (M, 4): true boxes.
        min_overlap: Minimum intersection over union of a correct detection.
        counts: Shape (M,), bool: False for true boxes to ignore, with their detections.
    """
    order = np.argsort(-scores, kind="stable")
    is_right, is_judged = np.zeros(len(scores), np.bool_), np.ones(len(scores), np.bool_)
    is_free = np.ones(len(truth_px), np.bool_)
    for i in order.tolist() if len(truth_px) else ():
        overlap = np.where(is_free, box_ious(boxes_px[i], truth_px), -1.0)
        best = int(overlap.argmax())
        if overlap[best] >= min_overlap:
            is_free[best] = False
            is_right[i] = True
            is_judged[i] = counts[best]
    return Verdicts(scores[is_judged], is_right[is_judged], int(counts.sum()))


def concatenate_verdicts(parts: list[Verdicts]) -> Verdicts:
    """Concatenate the judged detections of several frames."""
    return Verdicts(
        np.concatenate([np.empty(0), *(part.scores for part in parts)]),
        np.concatenate([np.empty(0, np.bool_), *(part.is_right for part in parts)]),
        sum(part.signs for part in parts),
    )


def rates_at(judged: Verdicts, score: float) -> DetectionCounts:
    """Count detections at a threshold."""
    keep = judged.scores >= score
    return DetectionCounts(int(keep.sum()), int((keep & judged.is_right).sum()), judged.signs)


def threshold_at_precision(judged: Verdicts, precision: float) -> float | None:
    """Lowest score at which, and above which, the precision is reached; None if none exists.

    The condition on all higher scores excludes chance fluctuations.
    """
    chosen: float | None = None
    for score in np.unique(judged.scores)[::-1].tolist():
        if rates_at(judged, score).precision < precision:
            break
        chosen = score
    return chosen


def fit_platt(scores: NDArray[np.float64], is_right: NDArray[np.bool_]) -> Platt:
    """Logistic regression on the score's logit (Platt 1999).

    Args:
        scores: Shape (N,), in [0, 1].
        is_right: Shape (N,); both values occur.
    """
    from scipy.optimize import minimize

    kept = np.clip(scores, 1e-6, 1.0 - 1e-6)
    logit = np.log(kept / (1.0 - kept))
    right = int(is_right.sum())
    # Platt's targets: one more correct and one more wrong detection than observed.
    target = np.where(is_right, (right + 1) / (right + 2), 1 / (len(is_right) - right + 2))

    def cost(at: NDArray[np.float64]) -> float:
        z = np.exp(at[0]) * logit + at[1]
        return float((np.logaddexp(0.0, z) - target * z).mean())

    best = minimize(cost, np.zeros(2), method="Nelder-Mead").x
    slope, offset = float(np.clip(np.exp(best[0]), 0.05, 20.0)), float(np.clip(best[1], -20, 20))
    return Platt(kind="platt", slope=round(slope, 5), offset=round(offset, 5))
