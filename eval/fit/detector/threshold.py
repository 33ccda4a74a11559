"""The lowest score above which a detector is precise enough, with a bound that can be relied on.

The bound is Clopper and Pearson's (Biometrika 26, 1934), one-sided. Since the threshold is chosen
by looking at the same detections, each of ``TRIED`` candidates is held to a part of the allowed
risk (Bonferroni), so that with the stated confidence no candidate that passes is less precise than
asked for. Candidates are fixed by how many detections are above them, never by which are right.

The bound takes detections as independent. Those of neighbouring frames are not: a bound from one
short drive says little of other drives.
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
    """A score, and what is known of detections above it.

    Attributes:
        score: Detections with a higher score are counted.
        next_score: The lowest of these.
        right: Of these.
        of: How many they are.
        bound: With the confidence asked for, they are no less often right than this.
    """

    score: float
    next_score: float
    right: int
    of: int
    bound: float


def lower_bound(right: int, of: int, confidence: float) -> float:
    """Clopper and Pearson's one-sided lower bound of a fraction.

    Args:
        right: So many.
        of: So many.
        confidence: In (0, 1).
    """
    from scipy.stats import beta

    return 0.0 if right == 0 else float(beta.ppf(1.0 - confidence, right, of - right + 1))


def fewest_detections(precision: float, confidence: float) -> int:
    """So many have to be there for a threshold, even if all are right."""
    risk = (1.0 - confidence) / TRIED
    return math.ceil(math.log(risk) / math.log(precision))


def best_bound(
    scores: NDArray[np.float64], is_right: NDArray[np.bool_], precision: float, confidence: float
) -> float:
    """The highest bound that any candidate reaches; NaN without candidates."""
    found = _candidates(scores, is_right, precision, confidence)
    return max((one.bound for one in found), default=math.nan)


def threshold_for(
    scores: NDArray[np.float64], is_right: NDArray[np.bool_], precision: float, confidence: float
) -> Threshold | None:
    """The lowest candidate whose bound is high enough; None where none is.

    Args:
        scores: Shape (N,).
        is_right: Shape (N,).
        precision: Required, in (0, 1).
        confidence: Of the bound, in (0, 1).
    """
    found = _candidates(scores, is_right, precision, confidence)
    good = [one for one in found if one.bound >= precision]
    return good[-1] if good else None


def _candidates(
    scores: NDArray[np.float64], is_right: NDArray[np.bool_], precision: float, confidence: float
) -> list[Threshold]:
    """Those with more and more detections above them, evenly in ratio."""
    n, fewest = len(scores), fewest_detections(precision, confidence)
    if n < fewest:
        return []
    order = np.argsort(-scores, kind="stable")
    falling, right = scores[order], np.cumsum(is_right[order])
    counts = np.unique(np.rint(np.geomspace(fewest, n, TRIED)).astype(np.int64))
    each = 1.0 - (1.0 - confidence) / TRIED
    found = []
    for count in counts.tolist():
        # Detections with equal scores are on the same side.
        of = int(np.searchsorted(-falling, -falling[count - 1], side="right"))
        above = float(falling[of - 1])
        below = float(falling[of]) if of < n else max(above - 0.01, 0.0)
        bound = lower_bound(int(right[of - 1]), of, each)
        found.append(Threshold(below, above, int(right[of - 1]), of, bound))
    return found


def round_between(low: float, high: float) -> float:
    """The shortest number in [low, high), for a file that people read."""
    for digits in range(2, 17):
        found = round(0.5 * (low + high), digits)
        if low <= found < high:
            return found
    return low
