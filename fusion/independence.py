"""What one more look at the same thing is worth."""

from __future__ import annotations

import math


def effective_sample_fraction(fades: float) -> float:
    """How many independent observations one is that comes ``fades`` fading lengths after the last.

    Looks that resemble each other by rho are worth (1 - rho) / (1 + rho) independent ones each
    (first-order autoregression); with rho = exp(-fades) that is tanh(fades / 2).
    """
    return math.tanh(0.5 * fades)
