"""The chi-square distribution, as far as consistency checks need it.

Press et al., *Numerical Recipes*, 3rd ed., section 6.2: the regularised incomplete gamma function
by its series below the mean and by its continued fraction above.
"""

from __future__ import annotations

import math
from typing import Final

_TERMS: Final = 100_000
_PRECISION: Final = 1e-15


def cdf(value: float, dimensions: int) -> float:
    """Probability that a chi-square variable is at most ``value``.

    Raises:
        ValueError: ``dimensions`` below 1 or ``value`` not a number.
    """
    if dimensions < 1:
        raise ValueError(f"dimensions: want >= 1, got {dimensions}")
    if math.isnan(value):
        raise ValueError("value: want a number, got NaN")
    shape, x = dimensions / 2.0, value / 2.0
    if x <= 0.0:
        return 0.0
    if math.isinf(x):
        return 1.0
    if x < shape + 1.0:
        return _series(shape, x)
    return 1.0 - _continued_fraction(shape, x)


def quantile(probability: float, dimensions: int) -> float:
    """The value below which a chi-square variable lies with ``probability``.

    Raises:
        ValueError: ``probability`` outside (0, 1), or ``dimensions`` below 1.
    """
    if not 0.0 < probability < 1.0:
        raise ValueError(f"probability: want in (0, 1), got {probability}")
    low, high = 0.0, float(dimensions) + 10.0
    while cdf(high, dimensions) < probability:
        low, high = high, 2.0 * high
    while True:
        middle = 0.5 * (low + high)
        if middle in (low, high):
            return middle
        if cdf(middle, dimensions) < probability:
            low = middle
        else:
            high = middle


def mean_band(dimensions: int, samples: int, share: float = 0.95) -> tuple[float, float]:
    """Where the mean of independent chi-square samples lies with probability ``share``."""
    total = dimensions * samples
    tail = 0.5 * (1.0 - share)
    return quantile(tail, total) / samples, quantile(1.0 - tail, total) / samples


def _scale(shape: float, x: float) -> float:
    return math.exp(shape * math.log(x) - x - math.lgamma(shape))


def _series(shape: float, x: float) -> float:
    term = total = 1.0 / shape
    for n in range(1, _TERMS):
        term *= x / (shape + n)
        total += term
        if term < total * _PRECISION:
            break
    return total * _scale(shape, x)


def _continued_fraction(shape: float, x: float) -> float:
    """Lentz's method; never divides by zero for x above shape + 1."""
    b = x + 1.0 - shape
    c, d = math.inf, 1.0 / b
    fraction = d
    for n in range(1, _TERMS):
        a = n * (shape - n)
        b += 2.0
        d = 1.0 / (a * d + b)
        c = b + a / c
        fraction *= c * d
        if abs(c * d - 1.0) < _PRECISION:
            break
    return fraction * _scale(shape, x)
