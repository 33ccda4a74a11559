"""The lowest score above which a detector is precise enough, with a lower confidence bound.

The bound is Clopper and Pearson's (Biometrika 26, 1934), one-sided. The threshold is chosen on the
same detections. Each of ``TRIED`` candidates is therefore held to a part of the allowed risk
(Bonferroni), so that with the stated confidence no candidate that passes is less precise than
required. Candidates are determined by the number of detections above them, and never by which
detections are right.

The bound assumes independent detections. Those of neighbouring frames are not independent, so a
bound from one short drive means little for other drives.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

TRIED: Final = 8


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


def lower_bound(right: int, of: int, confidence: float) -> float:
    """Return Clopper and Pearson's one-sided lower bound of a fraction.

    Args:
        right: Number of successes.
        of: Number of trials.
        confidence: Confidence in (0, 1).
    """
    from scipy.stats import beta

    return 0.0 if right == 0 else float(beta.ppf(1.0 - confidence, right, of - right + 1))


def fewest_detections(precision: float, confidence: float) -> int:
    """Return the min number of detections needed for a threshold if all of them are right."""
    risk = (1.0 - confidence) / TRIED
    return math.ceil(math.log(risk) / math.log(precision))


def best_bound(
    scores: NDArray[np.float64], is_right: NDArray[np.bool_], precision: float, confidence: float
) -> float:
    """Return the highest bound of any candidate; NaN without candidates."""
    found = _candidates(scores, is_right, precision, confidence)
    return max((one.bound for one in found), default=math.nan)


def bounded_threshold(
    scores: NDArray[np.float64], is_right: NDArray[np.bool_], precision: float, confidence: float
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
    scores: NDArray[np.float64], is_right: NDArray[np.bool_], precision: float, confidence: float
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
