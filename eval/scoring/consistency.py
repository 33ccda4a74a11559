"""Quantiles of the chi-square distribution for consistency checks."""


def quantile(probability: float, dimensions: int) -> float:
    """Return the quantile of a chi-square variable with ``dimensions`` degrees of freedom.

    Raises:
        ValueError: ``probability`` is outside (0, 1), or ``dimensions`` is below 1.
    """
    from scipy.special import chdtri

    if not 0.0 < probability < 1.0:
        raise ValueError(f"probability: expected in (0, 1), got {probability}")
    if dimensions < 1:
        raise ValueError(f"dimensions: expected >= 1, got {dimensions}")
    return float(chdtri(dimensions, 1.0 - probability))


def mean_band(dimensions: int, samples: int) -> tuple[float, float]:
    """Return the central 95 % interval of the mean of independent chi-square samples."""
    total = dimensions * samples
    tail = 0.5 * (1.0 - 0.95)
    return quantile(tail, total) / samples, quantile(1.0 - tail, total) / samples
