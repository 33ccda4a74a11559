"""Smallest difference that a comparison finds, by simulated repetitions of its test.

A repetition draws the effects of as many places as there are on all metrics, and adds a difference
to one of them. Effects are normal, with the covariance of the places' effects between metrics; as
few places determine a scale poorly, each repetition draws one (chi-squared). The test is that of
``paired``: its swaps, its correction for all metrics, and its interval. Effects are linear (the
jackknife's), and all other metrics are unchanged.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final, NamedTuple

import numpy as np

from crosscue.replay.columns import Floats

REPETITIONS: Final = 200
# Max swaps per repetition.
SWAPS: Final = 512
POWER: Final = 0.8
SEED: Final = 0
# Halvings of the interval in which the difference is searched, and its doublings before.
HALVINGS: Final = 10
DOUBLINGS: Final = 8
ROUNDING: Final = 1e-9


class Effects(NamedTuple):
    """Effects of G places on the difference of one metric.

    Attributes:
        residuals: Shape (G,): influence on the difference, without the difference itself.
        weights: Shape (G,): part of a common difference that is the place's; sums up to 1.
        sign: 1 or -1, the direction in which a difference is sought.
        half: Half the interval of the difference, in its standard deviations.
    """

    residuals: Floats
    weights: Floats
    sign: float
    half: float


def detectable(effects: Mapping[str, Effects], swaps: Floats, alarms: float) -> dict[str, float]:
    """Return the difference of each metric that is found in ``POWER`` of the repetitions.

    Args:
        effects: Effects of the same places on each metric.
        swaps: Shape (S, G), as in ``paired``: 1 if a place's results are swapped.
        alarms: Max corrected p value of a verdict.

    Returns:
        Infinite where no difference is found so often.
    """
    if not effects:
        return {}
    signs = 1.0 - 2.0 * swaps[:SWAPS]
    places = signs.shape[1]
    rng = np.random.default_rng(SEED)
    normal = rng.normal(0.0, 1.0, (REPETITIONS, places, places))
    scales = np.sqrt((places - 1.0) / rng.chisquare(places - 1, REPETITIONS))
    normal *= scales[:, None, None]
    # The largest and the second largest statistic of the unchanged metrics, under each swap.
    first = second = np.zeros((len(signs), REPETITIONS))
    leader = np.full(first.shape, -1)
    for number, one in enumerate(effects.values()):
        swapped = np.abs(signs @ _repeated(one, normal).T)
        scaled = swapped / np.maximum(_rms(swapped), ROUNDING)
        is_first = scaled > first
        second = np.where(is_first, first, np.maximum(second, scaled))
        leader = np.where(is_first, number, leader)
        first = np.where(is_first, scaled, first)
    return {
        path: _smallest(one, normal, signs, np.where(leader == number, second, first), alarms)
        for number, (path, one) in enumerate(effects.items())
    }


def _repeated(one: Effects, normal: Floats) -> Floats:
    """Return effects of other places on the difference, shape (repetitions, G)."""
    mine = one.weights > 0.0
    return np.asarray(normal @ one.residuals / math.sqrt(mine.sum() - 1) * mine)


def _rms(swapped: Floats) -> Floats:
    return np.asarray(np.sqrt((swapped**2).mean(axis=0)))


def _smallest(one: Effects, normal: Floats, signs: Floats, others: Floats, alarms: float) -> float:
    residuals, n = _repeated(one, normal), np.count_nonzero(one.weights)
    by_chance, by_change = signs @ residuals.T, one.sign * (signs @ one.weights)[:, None]
    chance = residuals.sum(axis=1)
    off = residuals - chance[:, None] * one.weights
    half = one.half * np.sqrt(n / (n - 1) * (off**2).sum(axis=1))

    def power(difference: float) -> float:
        swapped = np.abs(by_chance + difference * by_change)
        found = one.sign * chance + difference
        scaled = swapped / np.maximum(_rms(swapped), ROUNDING)
        p = (np.maximum(scaled, others) >= scaled[0] - ROUNDING).mean(axis=0)
        return float(((p <= alarms) & (found > half)).mean())

    high = float(np.abs(chance).mean()) or ROUNDING
    for _ in range(DOUBLINGS):
        if power(high) >= POWER:
            break
        high *= 2.0
    else:
        return math.inf
    low = 0.0
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if power(middle) >= POWER else (middle, high)
    return high
