"""Fit of the landmark threshold: required rates, intervals, pairs from tables."""

from pathlib import Path

import numpy as np
import pytest

from crosscue.eval.fit.landmarks.threshold import Rate, ScoredPairs, fit_threshold
from crosscue.replay.vehicle.vehicle import load
from support.commands import json_of, output_of
from support.landmark_files import write_walls


def simulated_pairs(seed: int, false: int = 4000, same: int = 400) -> ScoredPairs:
    """Simulate exponential two-place scores of mean 5, and same-place scores around 40."""
    rng = np.random.default_rng(seed)
    score = np.concatenate([rng.exponential(5.0, false), rng.normal(40.0, 12.0, same)])
    is_same = np.arange(false + same) >= false
    return ScoredPairs(score, is_same, rng.integers(0, (false + same) // 20, false + same))


@pytest.mark.parametrize("required", [0.0, 0.002, 0.05])
def test_threshold_is_the_lowest_that_meets_the_required_rate(required: float) -> None:
    pairs = simulated_pairs(1)
    fitted = fit_threshold(pairs, required)

    assert fitted.fitted_false.hits <= required * fitted.fitted_false.of
    assert fitted.fitted_false.hits + 1 > required * fitted.fitted_false.of - 1
    assert fitted.fitted_false.of + fitted.held_out_false.of == 4000
    assert fitted.fitted_found.of + fitted.held_out_found.of == 400


def test_intervals_equal_published_values() -> None:
    """Clopper and Pearson's of 10 of 100, from published tables; all is possible without pairs."""
    pairs = ScoredPairs(np.arange(200.0), np.zeros(200, bool), np.arange(200))
    fitted = fit_threshold(pairs, 0.1)

    false = fitted.fitted_false
    assert (false.hits, false.of) == (10, 100)
    assert (false.low, false.high) == pytest.approx((0.0490047, 0.1762226), abs=1e-6)
    assert fitted.fitted_found == fitted.held_out_found == Rate(0, 0, 0.0, 1.0)


def test_threshold_fitted_to_a_table_of_pairs_is_written(tmp_path: Path) -> None:
    """Eight simulated walls, each observed again, compared with all eight."""
    write_walls(tmp_path, 8, (320, 240))
    car = tmp_path / "car.toml"
    car.write_text("version = 1 # mine\n")
    command = ["fit", "landmarks", "--pairs", str(tmp_path / "pairs.csv"), "--vehicle", str(car)]
    fitted = json_of(*command, "-o", car)
    assert (fitted["held_out_found"]["hits"], fitted["held_out_found"]["of"]) == (4, 4)
    # OpenCV 4.14 and 5.0 match features differently: one of the 28 passes, or none.
    assert fitted["held_out_false"]["of"] == 28
    assert fitted["held_out_false"]["hits"] <= 1
    assert not fitted["is_shown"]
    assert load(car).landmarks.min_score == fitted["min_score"]
    assert "# mine" in car.read_text()
    assert "28 held-out pairs cannot show a rate of 0.001" in output_of(*command)
