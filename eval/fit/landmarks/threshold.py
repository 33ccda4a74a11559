"""Fit the match threshold to a target false-match rate, with confidence intervals.

Pairs of pictures are labelled as one place or two, and scored. The threshold is fitted on half of
the query pictures: it is the lowest at which at most the target fraction of two-place pairs match.
The rates are measured on the other half, which is not used before. The interval of false matches is
that of Clopper and Pearson (Biometrika 26, 1934), which is valid even without an observation; that
of found places is Wilson's (JASA 22, 1927).
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from crosscue.eval.scoring.intervals import lower_bound, wilson
from crosscue.replay.columns import ColumnSet, Floats, Int64s


@dataclass(frozen=True, slots=True, eq=False)
class ScoredPairs(ColumnSet):
    """N pairs of pictures.

    Attributes:
        score: Shape (N,).
        is_same: Shape (N,), bool: True if both show one place.
        query: Shape (N,), int64: number of the query picture, whose pairs are all in one half.
    """

    score: Floats
    is_same: NDArray[np.bool_]
    query: Int64s


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


def fit_threshold(pairs: ScoredPairs, wanted_rate: float, seed: int = 0) -> LandmarkFit:
    """Fit the threshold on one half of the queries, and measure the rates on the other.

    Args:
        pairs: Labelled and scored pairs.
        wanted_rate: Maximum fraction of two-place pairs that match, 0 or more, below 1.
        seed: Seed of the split.

    Raises:
        ValueError: A half has no two-place pairs.
    """
    is_fit = fitted_half(pairs, seed)
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
        _false(pairs, min_score, is_fit),
        _found(pairs, min_score, is_fit),
        _false(pairs, min_score, ~is_fit),
        _found(pairs, min_score, ~is_fit),
    )


def fitted_half(pairs: ScoredPairs, seed: int = 0) -> NDArray[np.bool_]:
    """Return the pairs that the threshold is fitted to."""
    queries = np.unique(pairs.query)
    chosen = np.random.default_rng(seed).permutation(queries)[: len(queries) // 2]
    return np.isin(pairs.query, chosen)


def _threshold(score: Floats, is_false: NDArray[np.bool_], wanted_rate: float) -> float:
    """Threshold half-way between the highest score that must not match and the next higher one."""
    worst_first = np.sort(score[is_false])[::-1]
    allowed = math.floor(wanted_rate * len(worst_first) + 1e-9)
    below = float(worst_first[allowed])
    above = score[score > below]
    return below + (0.5 * (float(above.min()) - below) if len(above) else 1.0)


def _false(pairs: ScoredPairs, min_score: float, half: NDArray[np.bool_]) -> Rate:
    hits, of = _counts(pairs, min_score, half & ~pairs.is_same)
    return Rate(hits, of, lower_bound(hits, of, 0.975), 1.0 - lower_bound(of - hits, of, 0.975))


def _found(pairs: ScoredPairs, min_score: float, half: NDArray[np.bool_]) -> Rate:
    hits, of = _counts(pairs, min_score, half & pairs.is_same)
    return Rate(hits, of, *(wilson(hits, of) if of else (0.0, 1.0)))


def _counts(pairs: ScoredPairs, min_score: float, which: NDArray[np.bool_]) -> tuple[int, int]:
    return int((which & (pairs.score >= min_score)).sum()), int(which.sum())
