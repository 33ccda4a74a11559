"""How sure a fraction or a mean is.

Wilson's interval (E. B. Wilson, JASA 22, 1927) takes every count as independent. Frames of one
drive are not: a sign missed in one frame is missed in the next. So wherever several drives or
approaches are merged, an interval over whole clusters is shown beside it. Trust the wider one.

Resampling clusters covers too little for few of them: 82 to 88 % of five to eight, where 95 % is
stated. Here the variance is the jackknife's over clusters (MacKinnon, Nielsen, Webb, *Fast and
Reliable Jackknife and Bootstrap Methods for Cluster-Robust Inference*, 2023), and the quantile that
of Student's t for so many clusters of equal size as would do as well (Kish, *Survey Sampling*,
section 8.2). A fraction has the same as a Wilson interval of its effective number of rows (Korn,
Graubard, *Survey Methodology* 24, 1998), which stays within 0 and 1.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

CONFIDENCE: Final = 0.95
MIN_CLUSTERS: Final = 4
TOO_FEW: Final = "too few clusters"
"""What is printed where an interval needs more drives or approaches than exist."""


class Interval(NamedTuple):
    """Both ends; NaN where nothing can be said."""

    low: float
    high: float


UNKNOWN: Final = Interval(math.nan, math.nan)


@dataclass(frozen=True, slots=True)
class Proportion:
    """``right`` out of ``of``.

    Attributes:
        value: NaN for none out of none.
        low: Lower end of Wilson's interval, as if counts were independent.
        high: Its upper end.
        clusters: How many drives or approaches the counts come from.
        clusters_low: Lower end over whole clusters; NaN for fewer than four.
        clusters_high: Its upper end.
    """

    right: int
    of: int
    value: float
    low: float
    high: float
    clusters: int = 0
    clusters_low: float = math.nan
    clusters_high: float = math.nan


@dataclass(frozen=True, slots=True)
class Mean:
    """A mean over rows, its interval over whole clusters.

    Attributes:
        value: NaN for no rows.
        low: NaN for fewer than four clusters: few drives say little about the next.
        high: The same.
        of: Rows.
        clusters: Drives or approaches.
    """

    value: float
    low: float
    high: float
    of: int
    clusters: int


def wilson(right: int, of: int, confidence: float = CONFIDENCE) -> Interval:
    """Wilson's score interval for ``right`` out of ``of`` independent trials.

    Raises:
        ValueError: ``right`` is not within 0 to ``of``, or ``confidence`` not in (0, 1).
    """
    from scipy.special import ndtri

    if not 0 <= right <= of:
        raise ValueError(f"right: expected 0 to {of}, got {right}")
    if not 0.0 < confidence < 1.0:
        raise ValueError(f"confidence: expected in (0, 1), got {confidence}")
    if of == 0:
        return UNKNOWN
    return _wilson(right / of, of, float(ndtri(0.5 + 0.5 * confidence)))


def _wilson(fraction: float, of: float, z: float) -> Interval:
    shrink = 1.0 + z * z / of
    middle = (fraction + 0.5 * z * z / of) / shrink
    half = z * math.sqrt(fraction * (1.0 - fraction) / of + 0.25 * (z / of) ** 2) / shrink
    # At the ends the formula is exact but rounding is not.
    return Interval(
        0.0 if fraction == 0.0 else middle - half, 1.0 if fraction == 1.0 else middle + half
    )


def fraction(is_right: np.typing.NDArray[np.bool_], clusters: NDArray[np.int64]) -> Proportion:
    """The fraction of true rows with both intervals.

    Args:
        is_right: Shape (N,).
        clusters: Shape (N,): which drive or approach a row belongs to.
    """
    right, of = int(is_right.sum()), len(is_right)
    ends = wilson(right, of)
    by_cluster = fraction_by_cluster(is_right, clusters)
    return Proportion(
        right=right,
        of=of,
        value=right / of if of else math.nan,
        low=ends.low,
        high=ends.high,
        clusters=len(np.unique(clusters)),
        clusters_low=by_cluster.low,
        clusters_high=by_cluster.high,
    )


def mean(values: NDArray[np.float64], clusters: NDArray[np.int64]) -> Mean:
    """The mean of finite values, with an interval over whole clusters."""
    kept = np.isfinite(values)
    values, clusters = values[kept], clusters[kept]
    ends = mean_by_cluster(values, clusters)
    value = float(values.mean()) if len(values) else math.nan
    return Mean(value, ends.low, ends.high, len(values), len(np.unique(clusters)))


def mean_by_cluster(
    values: NDArray[np.float64], clusters: NDArray[np.int64], confidence: float = CONFIDENCE
) -> Interval:
    """Interval of the mean over rows that counts whole clusters as independent.

    Args:
        values: Shape (N,).
        clusters: Shape (N,).
        confidence: Of the interval.
    """
    found = _spread(values, clusters)
    if found is None:
        return UNKNOWN
    half = found.quantile(confidence) * found.sd
    return Interval(found.mean - half, found.mean + half)


def fraction_by_cluster(
    is_right: np.typing.NDArray[np.bool_],
    clusters: NDArray[np.int64],
    confidence: float = CONFIDENCE,
) -> Interval:
    """Interval of the fraction of true rows that counts whole clusters as independent.

    Where all clusters agree nothing shows how alike rows of one cluster are: each cluster counts as
    one row then.
    """
    found = _spread(is_right.astype(np.float64), clusters)
    return UNKNOWN if found is None else found.within_0_and_1(len(is_right), confidence)


class Spread(NamedTuple):
    """What clusters say of a mean, or of a number like one.

    Attributes:
        mean: Over rows.
        sd: Its standard deviation.
        clusters: How many.
        equal_clusters: So many clusters of equal size would do as well.
    """

    mean: float
    sd: float
    clusters: int
    equal_clusters: float

    def quantile(self, confidence: float) -> float:
        """Of Student's t."""
        from scipy.special import stdtrit

        return float(stdtrit(max(self.equal_clusters - 1.0, 1.0), 0.5 + 0.5 * confidence))

    def within_0_and_1(self, rows: float, confidence: float = CONFIDENCE) -> Interval:
        """Wilson's interval of the effective number of rows, which are at most ``rows``."""
        from scipy.special import ndtri

        if self.sd == 0.0:
            return _wilson(self.mean, self.clusters, float(ndtri(0.5 + 0.5 * confidence)))
        effective = min(self.mean * (1.0 - self.mean) / self.sd**2, rows)
        return _wilson(self.mean, effective, self.quantile(confidence))


def _spread(values: NDArray[np.float64], clusters: NDArray[np.int64]) -> Spread | None:
    """Mean over rows and its standard deviation by the jackknife; None for too few clusters."""
    names, which = np.unique(clusters, return_inverse=True)
    n = len(names)
    if n < MIN_CLUSTERS:
        return None
    total = np.bincount(which, values, n)
    rows = np.bincount(which, minlength=n).astype(np.float64)
    whole = float(total.sum() / rows.sum())
    without = (total.sum() - total) / (rows.sum() - rows)
    sd = math.sqrt((n - 1) / n * float(((without - whole) ** 2).sum()))
    return Spread(whole, sd, n, float(rows.sum() ** 2 / (rows**2).sum()))
