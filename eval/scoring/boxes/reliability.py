"""Calibration of scores: the fraction of correct detections by score.

The expected calibration error is the mean difference of score and fraction over ten bins of the
score, weighted by detections (Naeini et al., AAAI 2015).
"""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from crosscue.eval.scoring.intervals import Interval, wilson
from crosscue.replay.columns import Floats

from .matching import Bools

BINS: Final = 10


@dataclass(frozen=True, slots=True)
class ScoreBin:
    """Detections in one bin of the score.

    Attributes:
        low: Lower edge.
        high: Upper edge.
        detections: Number of detections.
        right: Number of correct detections.
        mean_score: Mean score; NaN without detections.
        interval: Interval of the correct fraction, which assumes independent detections.
    """

    low: float
    high: float
    detections: int
    right: int
    mean_score: float
    interval: Interval

    @property
    def fraction(self) -> float:
        """Fraction of correct detections; NaN without detections."""
        return self.right / self.detections if self.detections else math.nan


@dataclass(frozen=True, slots=True)
class Reliability:
    """Calibration of one class.

    Attributes:
        label: The class.
        bins: Ten bins of equal width.
        error: Expected calibration error; NaN without detections.
        detections: Number of detections.
    """

    label: str
    bins: tuple[ScoreBin, ...]
    error: float
    detections: int


def class_calibration(label: str, scores: Floats, is_right: Bools) -> Reliability:
    """Return the calibration of one class.

    Args:
        label: The class.
        scores: Shape (N,), in [0, 1].
        is_right: Shape (N,).
    """
    edges = np.linspace(0.0, 1.0, BINS + 1)
    which = np.clip(np.searchsorted(edges, scores, side="right") - 1, 0, BINS - 1)
    bins = []
    for k in range(BINS):
        mine = which == k
        n, right = int(mine.sum()), int(is_right[mine].sum())
        mean = float(scores[mine].mean()) if n else math.nan
        bins.append(ScoreBin(edges[k], edges[k + 1], n, right, mean, wilson(right, n)))
    error = (
        sum(one.detections * abs(one.fraction - one.mean_score) for one in bins if one.detections)
        / len(scores)
        if len(scores)
        else math.nan
    )
    return Reliability(label, tuple(bins), error, len(scores))
