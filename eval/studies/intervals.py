"""Numbers with their 95 % intervals: means, shares, ratios, and the range at a success rate.

Bootstrap: Efron, Tibshirani, *An Introduction to the Bootstrap*, section 13.3 (percentiles).
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np

from crosscue.eval.scoring.intervals import wilson
from crosscue.replay.columns import Floats

Z_95: Final = 1.959964
REPLICATES: Final = 400
NEWTON_STEPS: Final = 40
RIDGE: Final = 1e-6
STEEPEST: Final = 40.0


class Measured(NamedTuple):
    """A value and its 95 % interval; infinite where it lies beyond what was driven."""

    value: float
    low: float
    high: float


def mean_of(values: Floats) -> Measured:
    """Mean, with the interval of the normal distribution; NaN without values."""
    n = len(values)
    if n == 0:
        return Measured(math.nan, math.nan, math.nan)
    mean = float(values.mean())
    half = Z_95 * float(values.std(ddof=1)) / math.sqrt(n) if n > 1 else math.inf
    return Measured(mean, mean - half, mean + half)


def fraction_of(right: int, of: int) -> Measured:
    """A share with Wilson's interval (1927)."""
    if not of:
        return Measured(math.nan, 0.0, 1.0)
    return Measured(right / of, *wilson(right, of))


def weights_of(n: int, replicates: int = REPLICATES, seed: int = 0) -> Floats:
    """Shape (1 + replicates, n): ones, then how often each bootstrap replicate drew each drive."""
    rng = np.random.default_rng(seed)
    drawn: Floats = rng.multinomial(n, np.full(n, 1.0 / n), replicates).astype(np.float64)
    return np.vstack([np.ones((1, n)), drawn])


def measured(values: Floats) -> Measured:
    """The first value, with the percentiles of the replicates that follow it."""
    # Infinite replicates are legitimate: percentiles by rank, without interpolation.
    low, high = np.quantile(values[1:], [0.025, 0.975], method="nearest")
    return Measured(float(values[0]), float(low), float(high))


def ratio_of(top: Floats, bottom: Floats) -> Measured:
    """Ratio of two paired sums."""
    weights = weights_of(len(top))
    return measured((weights @ top) / (weights @ bottom))


def ratio_of_means(top: Floats, of_top: Floats, bottom: Floats, of_bottom: Floats) -> Measured:
    """Ratio of two means, each over the drives that its 0 or 1 chooses; drives are paired.

    NaN where none is chosen; replicates without any are left out.
    """
    if not (of_top.any() and of_bottom.any()):
        return Measured(math.nan, math.nan, math.nan)
    weights = weights_of(len(top))
    tops, bottoms = weights @ of_top, weights @ of_bottom
    has_both = (tops > 0.0) & (bottoms > 0.0)
    means = [
        (weights[has_both] @ (way * chosen)) / count[has_both]
        for way, chosen, count in ((top, of_top, tops), (bottom, of_bottom, bottoms))
    ]
    return measured(means[0] / means[1])


def range_at(distances_m: Floats, is_success: Floats, share: float) -> Measured:
    """The distance at which success has fallen to ``share``, from a logistic curve.

    Args:
        distances_m: Shape (N,): from start to goal.
        is_success: Shape (N,): 1 or 0.
        share: Between 0 and 1.

    Returns:
        Infinite where the curve stays above ``share`` up to the farthest goal driven to; zero
        where it begins below.
    """
    weights = weights_of(len(distances_m))
    a, b = logistic(distances_m, is_success, weights)
    farthest_m = float(distances_m.max())
    level = math.log(share / (1.0 - share))
    with np.errstate(divide="ignore", invalid="ignore"):
        found = (level - a) / b
    at_end = a + b * farthest_m
    found = np.where(at_end >= level, np.inf, np.where(a <= level, 0.0, found))
    return measured(found)


def logistic(x: Floats, is_success: Floats, weights: Floats) -> tuple[Floats, Floats]:
    """Intercepts and slopes of weighted logistic regressions, by Newton's method.

    Args:
        x: Shape (N,).
        is_success: Shape (N,): 1 or 0.
        weights: Shape (R, N): one regression for each row.

    Returns:
        Shapes (R,) and (R,). A trace of ridge keeps the slope finite where the data separate.
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
