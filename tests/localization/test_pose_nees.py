"""The benchmark of dead reckoning states how far a mean NEES may be from its expectation."""

from collections.abc import Callable
from pathlib import Path
from runpy import run_path
from typing import cast

import numpy as np
import pytest

from crosscue.replay.columns import Floats

NAMES = run_path(str(Path(__file__).parents[2] / "benchmarks" / "pose_nees.py"))
interval = cast("Callable[[list[Floats]], tuple[float, float]]", NAMES["interval"])


def drawn(rng: np.random.Generator, parts: int, windows: int, shared: float) -> list[Floats]:
    """NEES by part; windows overlap by half, and share a fraction of their error's variance."""
    found = []
    for _ in range(parts):
        own = rng.normal(size=(windows + 1, 2))
        error = np.sqrt(shared) * rng.normal(size=2)
        error = error + np.sqrt(0.5 * (1.0 - shared)) * (own[1:] + own[:-1])
        found.append(np.sum(error**2, axis=1))
    return found


def test_one_prediction_of_0_88_is_consistent() -> None:
    low, high = interval([np.array([0.88])])

    # Two over a chi-square quantile of two degrees of freedom.
    assert low == pytest.approx(0.88 * 2.0 / 7.378, rel=1e-3)
    assert high == pytest.approx(0.88 * 2.0 / 0.0506, rel=1e-3)


@pytest.mark.parametrize("parts", [1, 2, 4, 6, 24])
@pytest.mark.parametrize("shared", [0.0, 0.5, 0.95])
def test_interval_of_a_mean_nees_covers_its_expectation(parts: int, shared: float) -> None:
    rng = np.random.default_rng(parts)
    intervals = [interval(drawn(rng, parts, 6, shared)) for _ in range(300)]

    # Three standard errors below 95 %.
    assert np.mean([low <= 2.0 <= high for low, high in intervals]) >= 0.912


def test_interval_of_many_independent_predictions_decides() -> None:
    rng = np.random.default_rng(1)
    ratios = [np.divide(*interval(drawn(rng, 24, 16, 0.0))[::-1]) for _ in range(50)]

    assert np.median(ratios) < 1.5
