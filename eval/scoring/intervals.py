"""Confidence intervals of fractions and means.

Wilson's interval (E. B. Wilson, JASA 22, 1927) assumes that counts are independent. Frames of one
drive are not: a sign missed in one frame is missed in the next. Drives of
one place are not, either. Therefore, an interval over clusters, which are places (``places``), is
shown as well. Trust the wider one.

Bootstrap intervals over few clusters are too narrow: with five to eight clusters, intervals of
nominally 95 % cover 82 to 88 %. Here the variance is that of the jackknife over clusters
(MacKinnon, Nielsen, Webb, *Fast and Reliable Jackknife and Bootstrap Methods for Cluster-Robust
Inference*, 2023). The quantile is that of Student's t for the effective number of clusters of equal
size (Kish, *Survey Sampling*, section 8.2). For fractions, the interval is Wilson's with the
effective number of rows (Korn, Graubard, *Survey Methodology* 24, 1998), which stays within 0 and
1. Where a few clusters have most of the errors, their variance is known less well, and Student's t
has fewer degrees of freedom, by the clusters' kurtosis (Satterthwaite, *Biometrics Bulletin* 2,
1946).

From twelve clusters on, intervals of fractions cover 93 to 97 % for correlations within clusters of
up to 0.4, and at most 98 % beyond; over six to eight, 92 to 98 %, and 89 % at worst
(``benchmarks/interval_coverage``). There is none over fewer, whose coverage would depend on the
correlation, which so few hardly show.
"""

import math
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from crosscue.replay.columns import Floats, Int64s

CONFIDENCE: Final = 0.95
# Over fewer, coverage depends on a correlation that they hardly show, and no swap of them decides.
MIN_CLUSTERS: Final = 6
# Minimum number of clusters whose kurtosis is estimated.
KURTOSIS_CLUSTERS: Final = 8
# Text in place of an interval over too few places.
TOO_FEW: Final = "too few places"


class Interval(NamedTuple):
    """Ends of an interval; NaN if undefined."""

    low: float
    high: float


UNKNOWN: Final = Interval(math.nan, math.nan)


def between(low: float, high: float, digits: str = ".2f") -> str:
    """Return the ends of an interval as text, in a format of digits, or why it is missing."""
    return TOO_FEW if math.isnan(low) else f"{low:{digits}} to {high:{digits}}"


@dataclass(frozen=True, slots=True)
class Proportion:
    """``right`` out of ``of``.

    Attributes:
        value: Fraction; NaN for 0 out of 0.
        low: Lower end of Wilson's interval, which assumes independent counts.
        high: Upper end of Wilson's interval.
        clusters: Number of places that the counts come from.
        clusters_low: Lower end of the interval over clusters; NaN for fewer than six.
        clusters_high: Upper end of the interval over clusters.
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
    """Mean over rows, with an interval over clusters.

    Attributes:
        value: Mean; NaN without rows.
        low: Lower end; NaN for fewer than six clusters.
        high: Upper end; NaN for fewer than six clusters.
        of: Number of rows.
        clusters: Number of places.
    """

    value: float
    low: float
    high: float
    of: int
    clusters: int


def wilson(right: int, of: int, confidence: float = CONFIDENCE) -> Interval:
    """Return Wilson's score interval for ``right`` out of ``of`` independent trials.

    Raises:
        ValueError: ``right`` is outside 0 to ``of``, or ``confidence`` is outside (0, 1).
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
    # At the ends, the formula yields exactly 0 or 1 except for rounding errors.
    return Interval(
        0.0 if fraction == 0.0 else middle - half, 1.0 if fraction == 1.0 else middle + half
    )


def lower_bound(right: int, of: int, confidence: float) -> float:
    """Return Clopper and Pearson's one-sided lower bound of a fraction.

    Args:
        right: Number of successes.
        of: Number of trials.
        confidence: Confidence in (0, 1).
    """
    from scipy.stats import beta

    return 0.0 if right == 0 else float(beta.ppf(1.0 - confidence, right, of - right + 1))


def fraction(is_right: np.typing.NDArray[np.bool_], clusters: Int64s) -> Proportion:
    """Return the fraction of true rows, with both intervals.

    Args:
        is_right: Shape (N,).
        clusters: Shape (N,): number of the place of each row.
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


def mean(values: Floats, clusters: Int64s) -> Mean:
    """Return the mean of finite values, with an interval over clusters."""
    kept = np.isfinite(values)
    values, clusters = values[kept], clusters[kept]
    ends = mean_by_cluster(values, clusters)
    value = float(values.mean()) if len(values) else math.nan
    return Mean(value, ends.low, ends.high, len(values), len(np.unique(clusters)))


def mean_by_cluster(values: Floats, clusters: Int64s) -> Interval:
    """Return the interval of a mean over N rows, with clusters as independent units."""
    found = _spread(values, clusters)
    if found is None:
        return UNKNOWN
    half = found.quantile() * found.sd
    return Interval(found.mean - half, found.mean + half)


def fraction_by_cluster(is_right: np.typing.NDArray[np.bool_], clusters: Int64s) -> Interval:
    """Return the interval of the fraction of true rows, with clusters as independent units.

    If all clusters agree, the correlation within clusters is unknown. Each cluster then counts as
    one row.
    """
    found = _spread(is_right.astype(np.float64), clusters)
    return UNKNOWN if found is None else found.within_0_and_1(len(is_right))


class Spread(NamedTuple):
    """Mean over rows and its standard deviation, from clusters.

    Attributes:
        mean: Mean over rows.
        sd: Standard deviation of the mean.
        clusters: Number of clusters.
        equal_clusters: Effective number of clusters of equal size.
        kurtosis: Kurtosis of the clusters' effects on the mean; 3 if they are normal, or unknown.
    """

    mean: float
    sd: float
    clusters: int
    equal_clusters: float
    kurtosis: float = 3.0

    def quantile(self, freedom: float = math.inf) -> float:
        """Return the two-sided quantile of Student's t, with at most ``freedom`` degrees."""
        from scipy.special import stdtrit

        freedom = max(min(freedom, self.equal_clusters - 1.0), 1.0)
        return float(stdtrit(freedom, 0.5 + 0.5 * CONFIDENCE))

    def within_0_and_1(self, rows: float) -> Interval:
        """Return Wilson's interval for the effective number of rows, at most ``rows``."""
        from scipy.special import ndtri

        if self.sd == 0.0:
            return _wilson(self.mean, self.clusters, float(ndtri(0.5 + 0.5 * CONFIDENCE)))
        effective = min(self.mean * (1.0 - self.mean) / self.sd**2, rows)
        # The relative variance of a variance of n values is (kurtosis - 1) / n.
        freedom = 2.0 * self.equal_clusters / max(self.kurtosis - 1.0, 1e-9)
        return _wilson(self.mean, effective, self.quantile(freedom))


def _spread(values: Floats, clusters: Int64s) -> Spread | None:
    """Return the mean and its standard deviation by the jackknife; None for too few clusters."""
    names, which = np.unique(clusters, return_inverse=True)
    n = len(names)
    if n < MIN_CLUSTERS:
        return None
    total = np.bincount(which, values, n)
    rows = np.bincount(which, minlength=n).astype(np.float64)
    whole = float(total.sum() / rows.sum())
    without = (total.sum() - total) / (rows.sum() - rows)
    squares = (without - whole) ** 2
    sd = math.sqrt((n - 1) / n * float(squares.sum()))
    equal = float(rows.sum() ** 2 / (rows**2).sum())
    return Spread(whole, sd, n, equal, _kurtosis(squares))


def _kurtosis(squares: Floats) -> float:
    """Return the kurtosis of values by their squares, unbiased for normal values (G2 + 3).

    Joanes, Gill, *Comparing measures of sample skewness and kurtosis*, The Statistician 47, 1998.
    """
    n, total = len(squares), float(squares.sum())
    if n < KURTOSIS_CLUSTERS or total == 0.0:
        return 3.0
    excess = n * float((squares**2).sum()) / total**2 - 3.0
    return 3.0 + (n - 1) / ((n - 2) * (n - 3)) * ((n + 1) * excess + 6.0)
