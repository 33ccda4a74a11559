"""How sure a fraction or a mean is.

Wilson's interval (E. B. Wilson, JASA 22, 1927) takes every count as independent. Frames of one
drive are not: a sign missed in one frame is missed in the next. So wherever several drives or
approaches are merged, an interval by resampling whole clusters stands beside it (the cluster
bootstrap; Davison and Hinkley, *Bootstrap Methods*, section 3.8). Trust the wider one.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import Final, NamedTuple

import numpy as np

from crosscue.replay.columns import Floats, Int64s

CONFIDENCE: Final = 0.95
ROUNDS: Final = 2000
SEED: Final = 0
MAX_KEPT: Final = 500
"""Draws for so many clusters are kept for the next interval; they take 8 MB."""
MIN_CLUSTERS: Final = 5
"""Of fewer, resampling can only give back the smallest and the largest: no interval is given."""


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
        clusters_low: Lower end when whole clusters are resampled; NaN for fewer than five.
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
    """A mean over rows whose clusters were resampled for its interval.

    Attributes:
        value: NaN for no rows.
        low: NaN for fewer than five clusters: few drives say little about the next.
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
    z = float(ndtri(0.5 + 0.5 * confidence))
    share, shrink = right / of, 1.0 + z * z / of
    middle = (share + 0.5 * z * z / of) / shrink
    half = z * math.sqrt(share * (1.0 - share) / of + 0.25 * (z / of) ** 2) / shrink
    # At the ends the formula is exact but rounding is not.
    low = 0.0 if right == 0 else middle - half
    high = 1.0 if right == of else middle + half
    return Interval(low, high)


def share(is_right: np.typing.NDArray[np.bool_], clusters: Int64s, seed: int = SEED) -> Proportion:
    """The fraction of true rows with both intervals.

    Args:
        is_right: Shape (N,).
        clusters: Shape (N,): which drive or approach a row belongs to.
        seed: Of the resampling.
    """
    right, of = int(is_right.sum()), len(is_right)
    ends = wilson(right, of)
    by_cluster = resampled(is_right.astype(np.float64), clusters, seed)
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


def mean(values: Floats, clusters: Int64s, seed: int = SEED) -> Mean:
    """The mean of finite values, with an interval from resampling clusters."""
    kept = np.isfinite(values)
    values, clusters = values[kept], clusters[kept]
    ends = resampled(values, clusters, seed)
    value = float(values.mean()) if len(values) else math.nan
    return Mean(value, ends.low, ends.high, len(values), len(np.unique(clusters)))


def resampled(
    values: Floats, clusters: Int64s, seed: int = SEED, confidence: float = CONFIDENCE
) -> Interval:
    """Percentile interval of the mean over rows when whole clusters are drawn with replacement.

    Args:
        values: Shape (N,).
        clusters: Shape (N,).
        seed: The same gives the same.
        confidence: Of the interval.
    """
    names, which = np.unique(clusters, return_inverse=True)
    n = len(names)
    if n < MIN_CLUSTERS:
        return UNKNOWN
    total = np.bincount(which, values, n)
    rows = np.bincount(which, minlength=n).astype(np.float64)
    means = np.concatenate([(part @ total) / (part @ rows) for part in _draws(n, seed)])
    tail = 50.0 * (1.0 - confidence)
    low, high = np.percentile(means, [tail, 100.0 - tail])
    return Interval(float(low), float(high))


def _draws(n: int, seed: int) -> Iterator[Floats]:
    """How often each of ``n`` clusters is drawn, in parts of a bounded size, rounds by clusters."""
    if n <= MAX_KEPT:
        yield _drawn(n, seed, ROUNDS)
        return
    step = max(ROUNDS * MAX_KEPT // n, 1)
    for part, first in enumerate(range(0, ROUNDS, step)):
        yield _draw(n, (seed, n, part), min(step, ROUNDS - first))


@lru_cache(maxsize=16)
def _drawn(n: int, seed: int, rounds: int) -> Floats:
    return _draw(n, (seed, n), rounds)


def _draw(n: int, seed: tuple[int, ...], rounds: int) -> Floats:
    counts = np.random.default_rng(seed).multinomial(n, np.full(n, 1.0 / n), rounds)
    drawn = counts.astype(np.float64)
    drawn.setflags(write=False)
    return drawn
