"""Tests of the curves from heights to ranges: exact without errors, robust to wrong masks."""

import numpy as np
import pytest
from scipy.optimize import curve_fit

from crosscue.detectors.ranging.height_to_range import FAMILIES, Family, fit_range, range_of
from crosscue.replay.columns import Floats
from crosscue.replay.vehicle.vehicle import RangeCurve

TRUE: dict[Family, tuple[float, ...]] = {
    "pinhole": (1400.0,),
    "pinhole-offset": (1300.0, 1.8),
    "power": (900.0, -0.9),
}


def pairs(family: Family, seed: int, sd: float, pairs: int = 300) -> tuple[Floats, Floats]:
    """Draw heights of 12 to 400 px, and ranges of a true curve with a relative error of ``sd``."""
    rng = np.random.default_rng(seed)
    height_px = np.exp(rng.uniform(np.log(12.0), np.log(400.0), pairs))
    curve = RangeCurve(family=family, parameters=TRUE[family], residual_sd_m=1.0)
    return height_px, range_of(height_px, curve) * (1.0 + sd * rng.normal(size=pairs))


@pytest.mark.parametrize("family", FAMILIES)
def test_pairs_without_errors_recover_the_curve_exactly(family: Family) -> None:
    found = fit_range(*pairs(family, 1, 0.0), family)

    assert found.curve.parameters == pytest.approx(TRUE[family], rel=1e-6)
    assert (found.pairs, found.outliers) == (300, 0)


@pytest.mark.parametrize("family", FAMILIES)
def test_pairs_with_equal_errors_match_least_squares_without_outliers(family: Family) -> None:
    height_px, range_m = pairs(family, 2, 0.05)
    models = {
        "pinhole": lambda h, a: a / h,
        "pinhole-offset": lambda h, a, b: a / h + b,
        "power": lambda h, a, b: a * h**b,
    }
    plain, _ = curve_fit(models[family], height_px, range_m, TRUE[family])

    found = fit_range(height_px, range_m, family)

    assert found.outliers == 0
    assert found.curve.parameters == pytest.approx(tuple(plain), rel=1e-4)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("family", FAMILIES)
def test_outlying_heights_are_rejected_and_counted(family: Family, seed: int) -> None:
    height_px, range_m = pairs(family, seed, 0.04)
    clean = fit_range(height_px, range_m, family)
    rng = np.random.default_rng(100 + seed)
    wrong = rng.choice(300, 45, replace=False)
    height_px[wrong] *= rng.uniform(1.8, 3.0, 45)

    found = fit_range(height_px, range_m, family)

    heights = np.array([15.0, 40.0, 150.0, 350.0])
    assert range_of(heights, found.curve) == pytest.approx(
        range_of(heights, clean.curve), rel=0.05, abs=0.5
    )
    assert 15 <= found.outliers <= 47
    assert found.pairs + found.outliers == 300
    assert found.curve.residual_sd_m < 1.3 * clean.curve.residual_sd_m
