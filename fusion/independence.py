"""Weights of correlated observations."""

import math


def effective_sample_fraction(fades: float) -> float:
    """Weight of an observation ``fades`` fading lengths after the last, in independent ones.

    Observations of correlation rho count as (1 - rho) / (1 + rho) independent ones each
    (first-order autoregression). With rho = exp(-fades) that is tanh(fades / 2).
    """
    return math.tanh(0.5 * fades)
