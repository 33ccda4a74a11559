"""Tests of range and height from growth: exact without errors, and consistent with errors.

Tracks are simulated by the model itself: sizes from the prior, correlated errors of the frames.
"""

import numpy as np
import pytest

from crosscue.detectors.ranging.range_from_motion import (
    HeightErrors,
    MotionRange,
    range_from_motion,
)
from crosscue.detectors.ranging.standard_sizes import SizePrior
from crosscue.replay.columns import Floats

FOCAL_PX = 1500.0
LIGHT = SizePrior(1.2, 0.25)
NO_ERRORS = HeightErrors(fraction=1e-5, edges_px=0.0)


def correlated_errors(travelled_m: Floats, over_m: float, rng: np.random.Generator) -> Floats:
    """Draw standard normal errors with autocorrelation exp(-distance / over_m)."""
    errors = [float(rng.normal())]
    for step_m in np.abs(np.diff(travelled_m)).tolist():
        rho = float(np.exp(-step_m / over_m))
        errors.append(rho * errors[-1] + np.sqrt(1.0 - rho * rho) * float(rng.normal()))
    return np.array(errors)


def track(
    travelled_m: Floats, rng: np.random.Generator, size: SizePrior = LIGHT
) -> tuple[Floats, float]:
    """Simulate the heights of one track, and return them with its true range at the end."""
    errors = HeightErrors()
    last_m = float(np.exp(rng.uniform(np.log(15.0), np.log(120.0))))
    height_m = np.exp(size.log_mean + np.sqrt(size.log_var) * rng.normal())
    true_px = FOCAL_PX * height_m / (last_m + travelled_m[-1] - travelled_m)
    sd = np.hypot(errors.fraction, errors.edges_px / true_px)
    return true_px * np.exp(sd * correlated_errors(travelled_m, errors.resemble_m, rng)), last_m


@pytest.mark.parametrize("height_m", [0.7, 1.2, 1.7])
@pytest.mark.parametrize("last_m", [4.0, 35.0, 90.0])
def test_track_without_errors_yields_exact_range_and_height(height_m: float, last_m: float) -> None:
    travelled_m = np.linspace(3.0, 28.0, 60)
    height_px = FOCAL_PX * height_m / (last_m + travelled_m[-1] - travelled_m)

    found = range_from_motion(travelled_m, height_px, FOCAL_PX, LIGHT, NO_ERRORS)

    assert found.mean_m == pytest.approx(last_m, rel=2e-3)
    assert found.height_m == pytest.approx(height_m, rel=2e-3)


@pytest.mark.slow
@pytest.mark.parametrize(("gone_m", "step_m"), [(0.0, 0.0), (5.0, 0.3), (20.0, 0.3), (40.0, 0.7)])
def test_range_interval_has_its_nominal_coverage(gone_m: float, step_m: float) -> None:
    rng = np.random.default_rng(7)
    travelled_m = np.arange(0.0, gone_m + 1e-9, step_m) if step_m else np.zeros(10)
    pairs = [track(travelled_m, rng) for _ in range(1000)]

    found = [range_from_motion(travelled_m, px, FOCAL_PX, LIGHT) for px, _ in pairs]

    sigmas = np.array([_sigmas(one, m) for one, (_, m) in zip(found, pairs, strict=True)])
    assert 0.93 <= float(np.mean(np.abs(sigmas) < 1.96)) <= 0.97
    off = np.array([one.mean_m / m - 1.0 for one, (_, m) in zip(found, pairs, strict=True)])
    # The mean of a posterior skewed to the far side is slightly beyond its median.
    assert abs(float(np.median(off))) < 0.06
    assert abs(float(sigmas.mean())) < 0.15


def _sigmas(found: MotionRange, true_m: float) -> float:
    return float((found.mean_m - true_m) / np.sqrt(found.var_m2))


def test_range_and_variance_fall_as_the_car_approaches() -> None:
    travelled_m = np.arange(0.0, 45.0, 0.5)
    height_px = FOCAL_PX * 1.3 / (60.0 - travelled_m)

    found = [
        range_from_motion(travelled_m[:n], height_px[:n], FOCAL_PX, LIGHT) for n in range(1, 90, 4)
    ]

    assert (np.diff([one.mean_m for one in found]) < 0.0).all()
    assert (np.diff([one.var_m2 for one in found]) < 0.0).all()
    assert found[-1].mean_m == pytest.approx(60.0 - travelled_m[88], rel=0.03)


def test_outlying_box_heights_change_the_range_little() -> None:
    travelled_m = np.arange(0.0, 40.0, 0.5)
    height_px = FOCAL_PX * 1.3 / (60.0 - travelled_m)
    height_px[::7] *= 1.8

    found = range_from_motion(travelled_m, height_px, FOCAL_PX, LIGHT)

    assert found.mean_m == pytest.approx(60.0 - travelled_m[-1], rel=0.05)


@pytest.mark.parametrize(
    ("travelled_m", "height_px", "focal_px"),
    [
        ([], [], 1500.0),
        ([0.0, 1.0], [30.0], 1500.0),
        ([0.0], [0.0], 1500.0),
        ([0.0], [float("nan")], 1500.0),
        ([float("inf")], [30.0], 1500.0),
        ([0.0], [30.0], 0.0),
    ],
)
def test_invalid_observations_are_refused(
    travelled_m: list[float], height_px: list[float], focal_px: float
) -> None:
    with pytest.raises(ValueError, match="expected"):
        range_from_motion(np.array(travelled_m), np.array(height_px), focal_px, LIGHT)


@pytest.mark.parametrize("height_px", [300.0, 40.0, 8.0, 2.5])
def test_one_observation_says_nothing_by_motion_at_any_range(height_px: float) -> None:
    """The variance before motion is in closed form; with one observation it is that on the grid.

    At 2.5 px the greatest range cuts the distribution off.
    """
    found = range_from_motion(np.zeros(1), np.array([height_px]), 1000.0, SizePrior(1.0, 0.2))

    assert found.by_motion == pytest.approx(0.0, abs=2e-3)
