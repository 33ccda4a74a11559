"""The match threshold for a wanted false-match rate, and how sure one may be of it.

Pairs of pictures, labelled as one place or two, are scored. Half of the query pictures choose the
threshold: the lowest at which no more than the wanted fraction of two-place pairs match. The other
half, never examined until then, yields the rates. Intervals: false matches by Clopper and Pearson
(Biometrika 26, 1934), which holds even where none was seen; found places by Wilson (JASA 22, 1927).
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
        is_same: Shape (N,), bool: both show one place.
        query: Shape (N,), int64: number of the query picture; pairs of one go to one half.
    """

    score: NDArray[np.float64]
    is_same: NDArray[np.bool_]
    query: NDArray[np.int64]

    def __post_init__(self) -> None:
        """Refuse columns that do not line up.

        Raises:
            ValueError: Naming the column, the shape wanted and the shape given.
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
        hits: How many were so.
        of: Of how many.
        low: Lower end.
        high: Upper end.
    """

    hits: int
    of: int
    low: float
    high: float


@dataclass(frozen=True, slots=True)
class LandmarkFit:
    """A threshold and what it is worth.

    Attributes:
        min_score: Matches from here on.
        wanted_rate: The false-match rate asked for.
        fitted_false: On the half that chose it.
        fitted_found: On that half: same-place pairs that match.
        held_out_false: On the other half.
        held_out_found: On the other half.
    """

    min_score: float
    wanted_rate: float
    fitted_false: Rate
    fitted_found: Rate
    held_out_false: Rate
    held_out_found: Rate

    @property
    def is_shown(self) -> bool:
        """Do the held-out pairs show that the rate is no higher than wanted?"""
        return self.held_out_false.high <= self.wanted_rate


def fit_landmarks(pairs: ScoredPairs, wanted_rate: float, seed: int = 0) -> LandmarkFit:
    """Choose the threshold on one half of the queries, measure the rates on the other.

    Args:
        pairs: Labelled and scored.
        wanted_rate: Fraction of two-place pairs that may match.
        seed: Of the split.

    Raises:
        ValueError: A rate out of range, or a half without two-place pairs.
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
    """Half-way between the highest score that must not match and the next one seen."""
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
    """The 95 % score interval of a fraction; 0 to 1 where nothing was tried."""
    if of == 0:
        return Rate(0, 0, 0.0, 1.0)
    fraction, z2 = count / of, Z_95**2
    middle = (fraction + z2 / (2 * of)) / (1 + z2 / of)
    half = Z_95 / (1 + z2 / of) * math.sqrt(fraction * (1 - fraction) / of + z2 / (4 * of * of))
    low = 0.0 if count == 0 else middle - half
    return Rate(count, of, low, 1.0 if count == of else middle + half)


def clopper_pearson(count: int, of: int) -> Rate:
    """The exact 95 % interval of a fraction; 0 to 1 where nothing was tried."""
    if of == 0:
        return Rate(0, 0, 0.0, 1.0)
    low = 0.0 if count == 0 else _fraction_at(count - 1, of, 0.975)
    high = 1.0 if count == of else _fraction_at(count, of, 0.025)
    return Rate(count, of, low, high)


def _fraction_at(count: int, of: int, probability: float) -> float:
    """The fraction at which no more than ``count`` of ``of`` come up with the given probability."""
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
