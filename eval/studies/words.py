"""Format measured numbers as text."""

from __future__ import annotations

import math

from .intervals import TOO_FEW, ValueInterval


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
