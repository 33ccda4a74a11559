"""The sign score to ask for, so that nearly all that is found is right."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from crosscue.detectors.boxes import overlaps


@dataclass(frozen=True, slots=True, eq=False)
class Judged:
    """What was found in labelled frames, as columns of length N, and how much there was to find.

    Attributes:
        scores: Shape (N,), float64.
        is_right: Shape (N,), bool: over a true sign that no better one took.
        signs: True signs.
    """

    scores: NDArray[np.float64]
    is_right: NDArray[np.bool_]
    signs: int


@dataclass(frozen=True, slots=True)
class Rates:
    """How good a threshold is on some frames.

    Attributes:
        found: Detections at or above it.
        right: Of these.
        signs: True signs.
    """

    found: int
    right: int
    signs: int

    @property
    def precision(self) -> float:
        """Right of found; NaN where nothing was found."""
        return self.right / self.found if self.found else float("nan")

    @property
    def recall(self) -> float:
        """Right of true signs; NaN where there were none."""
        return self.right / self.signs if self.signs else float("nan")


def judge(
    boxes_px: NDArray[np.float64],
    scores: NDArray[np.float64],
    truth_px: NDArray[np.float64],
    min_overlap: float,
    min_height_px: float = 0.0,
) -> Judged:
    """Which detections of one frame are right: each true sign counts once, the best first.

    Args:
        boxes_px: Shape (N, 4).
        scores: Shape (N,).
        truth_px: Shape (M, 4): boxes of the true signs.
        min_overlap: Intersection over union that makes a detection right.
        min_height_px: True signs that are lower do not count, whether they are found or not.
    """
    heights = truth_px[:, 3] - truth_px[:, 1]
    order = np.argsort(-scores, kind="stable")
    is_right, counts = np.zeros(len(scores), np.bool_), np.ones(len(scores), np.bool_)
    left = set(range(len(truth_px)))
    for i in order.tolist():
        fractions = overlaps(boxes_px[i], truth_px) if len(truth_px) else np.empty(0)
        fits = [k for k in left if fractions[k] >= min_overlap]
        if fits:
            taken = max(fits, key=lambda k: float(fractions[k]))
            left.remove(taken)
            is_right[i] = True
            counts[i] = heights[taken] >= min_height_px
    return Judged(scores[counts], is_right[counts], int((heights >= min_height_px).sum()))


def together(parts: list[Judged]) -> Judged:
    """Several frames as one."""
    return Judged(
        np.concatenate([np.empty(0), *(part.scores for part in parts)]),
        np.concatenate([np.empty(0, np.bool_), *(part.is_right for part in parts)]),
        sum(part.signs for part in parts),
    )


def rates_at(judged: Judged, score: float) -> Rates:
    """Counts at a threshold."""
    keep = judged.scores >= score
    return Rates(int(keep.sum()), int((keep & judged.is_right).sum()), judged.signs)


def threshold_for(judged: Judged, precision: float) -> float | None:
    """The lowest score whose precision, and that of all higher ones, is enough; None where none is.

    Asking it of all higher scores keeps a lucky dip from being chosen.
    """
    chosen: float | None = None
    for score in np.unique(judged.scores)[::-1].tolist():
        if rates_at(judged, score).precision < precision:
            break
        chosen = score
    return chosen
