"""Fit the match threshold to a target false-match rate, with confidence intervals.

Pairs of pictures are labelled as one place or two, and scored. The threshold is fitted on half of
the query pictures: it is the lowest at which at most the target fraction of two-place pairs match.
The rates are measured on the other half, which is not used before. The interval of false matches is
that of Clopper and Pearson (Biometrika 26, 1934), which is valid even without an observation; that
of found places is Wilson's (JASA 22, 1927).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

Z_95: Final = 1.959963984540054


@dataclass(frozen=True, slots=True, eq=False)
class ScoredPairs:
    """N pairs of pictures.

    Attributes:
        score: Shape (N,).
        is_same: Shape (N,), bool: True if both show one place.
        query: Shape (N,), int64: number of the query picture, whose pairs are all in one half.
    """

    score: NDArray[np.float64]
    is_same: NDArray[np.bool_]
    query: NDArray[np.int64]

    def __post_init__(self) -> None:
        """Reject columns of unequal length.

        Raises:
            ValueError: A shape is wrong; the message has column, expected and actual shape.
        """
        for name in ("is_same", "query"):
            if getattr(self, name).shape != self.score.shape:
                raise ValueError(
                    f"{name}: expected {self.score.shape}, got {getattr(self, name).shape}"
                )

    def __len__(self) -> int:
        return len(self.score)


@dataclass(frozen=True, slots=True)
class Rate:
    """A fraction with its 95 % interval.

    Attributes:
        hits: Numerator.
        of: Denominator.
        low: Lower bound.
        high: Upper bound.
    """

    hits: int
    of: int
    low: float
    high: float


@dataclass(frozen=True, slots=True)
class LandmarkFit:
    """A fitted threshold and its rates.

    Attributes:
        min_score: Minimum score of a match.
        wanted_rate: Target false-match rate.
        fitted_false: Rate of two-place pairs that match, on the half of the fit.
        fitted_found: Rate of same-place pairs that match, on the half of the fit.
        held_out_false: Rate of two-place pairs that match, on the held-out half.
        held_out_found: Rate of same-place pairs that match, on the held-out half.
    """

    min_score: float
    wanted_rate: float
    fitted_false: Rate
    fitted_found: Rate
    held_out_false: Rate
    held_out_found: Rate

    @property
    def is_shown(self) -> bool:
        """Whether the held-out pairs show that the rate does not exceed the target."""
        return self.held_out_false.high <= self.wanted_rate


def fit_landmarks(pairs: ScoredPairs, wanted_rate: float, seed: int = 0) -> LandmarkFit:
    """Fit the threshold on one half of the queries, and measure the rates on the other.

    Args:
        pairs: Labelled and scored pairs.
        wanted_rate: Maximum fraction of two-place pairs that match.
        seed: Seed of the split.

    Raises:
        ValueError: The rate is out of range, or a half has no two-place pairs.
    """
    if not 0.0 <= wanted_rate < 1.0:
        raise ValueError(f"wanted_rate: expected 0 to 1, got {wanted_rate}")
    queries = np.unique(pairs.query)
    chosen = np.random.default_rng(seed).permutation(queries)[: len(queries) // 2]
    is_fit = np.isin(pairs.query, chosen)
    for name, half in (("first", is_fit), ("second", ~is_fit)):
        if not (half & ~pairs.is_same).any():
            raise ValueError(
                f"pairs: expected two-place pairs of at least two queries, got none in "
                f"the {name} half"
            )
    min_score = _threshold(pairs.score, is_fit & ~pairs.is_same, wanted_rate)
    return LandmarkFit(
        min_score,
        wanted_rate,
        _rate(pairs, min_score, is_fit & ~pairs.is_same, clopper_pearson),
        _rate(pairs, min_score, is_fit & pairs.is_same, wilson),
        _rate(pairs, min_score, ~is_fit & ~pairs.is_same, clopper_pearson),
        _rate(pairs, min_score, ~is_fit & pairs.is_same, wilson),
    )


def _threshold(
    score: NDArray[np.float64], is_false: NDArray[np.bool_], wanted_rate: float
) -> float:
    """Threshold half-way between the highest score that must not match and the next higher one."""
    worst_first = np.sort(score[is_false])[::-1]
    allowed = math.floor(wanted_rate * len(worst_first) + 1e-9)
    below = float(worst_first[allowed])
    above = score[score > below]
    return below + (0.5 * (float(above.min()) - below) if len(above) else 1.0)


def _rate(
    pairs: ScoredPairs,
    min_score: float,
    which: NDArray[np.bool_],
    interval: Callable[[int, int], Rate],
) -> Rate:
    return interval(int((which & (pairs.score >= min_score)).sum()), int(which.sum()))


def wilson(count: int, of: int) -> Rate:
    """Wilson's 95 % score interval of a fraction; 0 to 1 without trials."""
    if of == 0:
        return Rate(0, 0, 0.0, 1.0)
    fraction, z2 = count / of, Z_95**2
    middle = (fraction + z2 / (2 * of)) / (1 + z2 / of)
    half = Z_95 / (1 + z2 / of) * math.sqrt(fraction * (1 - fraction) / of + z2 / (4 * of * of))
    low = 0.0 if count == 0 else middle - half
    return Rate(count, of, low, 1.0 if count == of else middle + half)


def clopper_pearson(count: int, of: int) -> Rate:
    """Exact 95 % interval of a fraction; 0 to 1 without trials."""
    if of == 0:
        return Rate(0, 0, 0.0, 1.0)
    low = 0.0 if count == 0 else _fraction_at(count - 1, of, 0.975)
    high = 1.0 if count == of else _fraction_at(count, of, 0.025)
    return Rate(count, of, low, high)


def _fraction_at(count: int, of: int, probability: float) -> float:
    """Fraction at which at most ``count`` of ``of`` trials succeed with the given probability."""
    low, high = 0.0, 1.0
    for _ in range(60):
        middle = 0.5 * (low + high)
        if _at_most(count, of, middle) > probability:
            low = middle
        else:
            high = middle
    return 0.5 * (low + high)


def _at_most(count: int, of: int, fraction: float) -> float:
    """Binomial distribution function."""
    if fraction <= 0.0 or fraction >= 1.0:
        return 1.0 if fraction <= 0.0 else 0.0
    k = np.arange(count + 1)
    steps = np.log(of - k[:-1]) - np.log(k[1:])
    log_choose = np.concatenate([[0.0], np.cumsum(steps)])
    logs = log_choose + k * math.log(fraction) + (of - k) * math.log1p(-fraction)
    peak = float(logs.max())
    return min(math.exp(peak) * float(np.exp(logs - peak).sum()), 1.0)
