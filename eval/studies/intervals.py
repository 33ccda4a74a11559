"""Numbers with their 95 % intervals: means, fractions, ratios, and the range at a success rate.

Means and ratios use Student's t; the variance of a ratio is linearised (Cochran, *Sampling
Techniques*, section 6.4). All others use the bootstrap, with percentiles widened for few drives
(Hesterberg, *What Teachers Should Know About the Bootstrap*, The American Statistician 69, 2015,
section 4.3).
"""

import math
from typing import Final, NamedTuple

import numpy as np

from crosscue.eval.scoring.intervals import MIN_CLUSTERS, TOO_FEW, wilson
from crosscue.replay.columns import Floats

REPLICATES: Final = 400
NEWTON_STEPS: Final = 40
RIDGE: Final = 1e-6
STEEPEST: Final = 40.0


class ValueInterval(NamedTuple):
    """A value and its 95 % interval; infinite beyond the longest drive, NaN for too few drives."""

    value: float
    low: float
    high: float


def mean_of(values: Floats) -> ValueInterval:
    """Return the mean, with the interval of Student's t; NaN without values."""
    return ratio_of(values, np.ones(len(values)))


def fraction_of(right: int, of: int) -> ValueInterval:
    """Return a fraction with Wilson's interval (1927)."""
    if not of:
        return ValueInterval(math.nan, 0.0, 1.0)
    return ValueInterval(right / of, *wilson(right, of))


def weights_of(n: int, replicates: int = REPLICATES, seed: int = 0) -> Floats:
    """Return weights of drives, shape (1 + replicates, n): ones, then bootstrap counts."""
    rng = np.random.default_rng(seed)
    drawn: Floats = rng.multinomial(n, np.full(n, 1.0 / n), replicates).astype(np.float64)
    return np.vstack([np.ones((1, n)), drawn])


def measured(values: Floats, drives: int) -> ValueInterval:
    """Return the first value, with percentiles of the bootstrap replicates that follow it."""
    from scipy.special import ndtr, stdtrit

    if drives < MIN_CLUSTERS:
        return ValueInterval(float(values[0]), math.nan, math.nan)
    tail = float(ndtr(math.sqrt(drives / (drives - 1)) * stdtrit(drives - 1, 0.025)))
    # Replicates can be infinite, so percentiles are by rank, without interpolation.
    low, high = np.quantile(values[1:], [tail, 1.0 - tail], method="nearest")
    return ValueInterval(float(values[0]), float(low), float(high))


def ratio_of(top: Floats, bottom: Floats) -> ValueInterval:
    """Return the ratio of two sums over the same drives; NaN without drives."""
    if not bottom.any():
        return ValueInterval(math.nan, math.nan, math.nan)
    ratio = float(top.sum() / bottom.sum())
    return _with_t(ratio, (top - ratio * bottom) / bottom.sum())


def _with_t(value: float, influence: Floats) -> ValueInterval:
    """Return a value with Student's interval, from the influence of each drive on it."""
    from scipy.special import stdtrit

    n = len(influence)
    if n < MIN_CLUSTERS:
        return ValueInterval(value, math.nan, math.nan)
    half = float(stdtrit(n - 1, 0.975)) * math.sqrt(n / (n - 1) * float(influence @ influence))
    return ValueInterval(value, value - half, value + half)


def ratio_of_means(top: Floats, of_top: Floats, bottom: Floats, of_bottom: Floats) -> ValueInterval:
    """Return the ratio of two means over paired drives, each over the drives of weight 1.

    NaN if all weights of a mean are 0.
    """
    if not (of_top.any() and of_bottom.any()):
        return ValueInterval(math.nan, math.nan, math.nan)
    means = (top @ of_top) / of_top.sum(), (bottom @ of_bottom) / of_bottom.sum()
    moves = (
        (top / means[0] - 1.0) * of_top / of_top.sum(),
        (bottom / means[1] - 1.0) * of_bottom / of_bottom.sum(),
    )
    ratio = float(means[0] / means[1])
    return _with_t(ratio, ratio * (moves[0] - moves[1]))


def range_at(distances_m: Floats, is_success: Floats, fraction: float) -> ValueInterval:
    """Return the distance at which success falls to ``fraction``, from a logistic curve.

    Args:
        distances_m: Shape (N,): distance from start to goal.
        is_success: Shape (N,): 1 or 0.
        fraction: Between 0 and 1.

    Returns:
        Infinite if the curve stays above ``fraction`` up to the farthest goal; zero if it starts
        below.
    """
    weights = weights_of(len(distances_m))
    a, b = logistic(distances_m, is_success, weights)
    farthest_m = float(distances_m.max())
    level = math.log(fraction / (1.0 - fraction))
    with np.errstate(divide="ignore", invalid="ignore"):
        found = (level - a) / b
    at_end = a + b * farthest_m
    found = np.where(at_end >= level, np.inf, np.where(a <= level, 0.0, found))
    return measured(found, len(distances_m))


def logistic(x: Floats, is_success: Floats, weights: Floats) -> tuple[Floats, Floats]:
    """Return intercepts and slopes of weighted logistic regressions, by Newton's method.

    Args:
        x: Shape (N,).
        is_success: Shape (N,): 1 or 0.
        weights: Shape (R, N): one regression per row.

    Returns:
        Shapes (R,) and (R,). A small ridge penalty keeps the slope finite for separable data.
    """
    scale = float(np.abs(x).max()) or 1.0
    u = x / scale
    a, b = np.zeros(len(weights)), np.zeros(len(weights))
    total = weights.sum(axis=1)
    for _ in range(NEWTON_STEPS):
        eta = np.clip(a[:, None] + b[:, None] * u, -STEEPEST, STEEPEST)
        p = 1.0 / (1.0 + np.exp(-eta))
        residual, spread = weights * (is_success - p), weights * p * (1.0 - p)
        ga, gb = residual.sum(axis=1), residual @ u
        ridge = RIDGE * total
        ga, gb = ga - ridge * a, gb - ridge * b
        haa, hab, hbb = spread.sum(axis=1) + ridge, spread @ u, spread @ (u * u) + ridge
        det = haa * hbb - hab * hab
        da, db = (hbb * ga - hab * gb) / det, (haa * gb - hab * ga) / det
        step = np.minimum(1.0, 5.0 / np.maximum(np.hypot(da, db), 1e-12))
        a, b = a + step * da, b + step * db
        if float(np.abs(step * da).max() + np.abs(step * db).max()) < 1e-8:
            break
    return a, b / scale


def km(value: ValueInterval, digits: int = 2) -> str:
    """Return a distance in kilometres with its interval."""
    if math.isinf(value.value):
        return "beyond"
    if math.isnan(value.low):
        return f"{value.value / 1e3:.{digits}f} ({TOO_FEW})"
    high = "beyond" if math.isinf(value.high) else f"{value.high / 1e3:.{digits}f}"
    return f"{value.value / 1e3:.{digits}f} ({value.low / 1e3:.{digits}f}..{high})"


def percent(value: ValueInterval) -> str:
    """Return a fraction in per cent with its interval."""
    if math.isnan(value.low):
        return f"{100 * value.value:.1f} % ({TOO_FEW})"
    return f"{100 * value.value:.1f} % ({100 * value.low:.1f}..{100 * value.high:.1f})"
