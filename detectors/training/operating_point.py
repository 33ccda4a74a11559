"""Choose the minimum score of a sign for a given precision."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from crosscue.detectors.boxes import box_ious


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


def match_signs(
    boxes_px: NDArray[np.float64],
    scores: NDArray[np.float64],
    truth_px: NDArray[np.float64],
    min_overlap: float,
    min_height_px: float = 0.0,
) -> Verdicts:
    """Match the detections of one frame to true signs, each at most once, best scores first.

    Args:
        boxes_px: Shape (N, 4).
        scores: Shape (N,).
        truth_px: Shape (M, 4): boxes of the true signs.
        min_overlap: Minimum intersection over union of a correct detection.
        min_height_px: Height below which true signs and their detections are ignored.
    """
    heights = truth_px[:, 3] - truth_px[:, 1]
    order = np.argsort(-scores, kind="stable")
    is_right, counts = np.zeros(len(scores), np.bool_), np.ones(len(scores), np.bool_)
    left = set(range(len(truth_px)))
    for i in order.tolist():
        fractions = box_ious(boxes_px[i], truth_px) if len(truth_px) else np.empty(0)
        fits = [k for k in left if fractions[k] >= min_overlap]
        if fits:
            taken = max(fits, key=lambda k: float(fractions[k]))
            left.remove(taken)
            is_right[i] = True
            counts[i] = heights[taken] >= min_height_px
    return Verdicts(scores[counts], is_right[counts], int((heights >= min_height_px).sum()))


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
