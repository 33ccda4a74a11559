"""The combined belief: sums of evidence, their regression, and the mean with another belief."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from crosscue.fusion.combined import CombinedFilter, EvidenceSums, mixed
from crosscue.fusion.factor_graph import graph_of, log_odds
from crosscue.fusion.fit.combined_fit import combined_beliefs, fit_combined, ridge_logistic
from crosscue.fusion.fit.temporal_fit import AnnotatedDrive, fit_temporal
from crosscue.replay.vehicle.combined import Combined
from crosscue.replay.vehicle.fusion import Fusion
from crosscue.replay.vehicle.vehicle import parse

GRAPH = graph_of(Fusion())
NAMES = GRAPH.feature_names
PRECISION = {cue.name: cue.precision for cue in GRAPH.cues}
NEUTRAL = Combined(
    intercepts=dict.fromkeys(NAMES, 0.0), weights={name: {name: 1.0} for name in NAMES}
)


def drive(place: str, features: dict[str, bool], seed: int) -> AnnotatedDrive:
    """Thirty frames of 2 m; each cue is positive in 60 % of those in which it is right."""
    rng = np.random.default_rng(seed)
    rates = {"stop_sign": "intersection", "road_left": "left", "road_right": "right"}
    counts = {
        cue: rng.binomial(1, 0.6 if features.get(feature) else 0.05, 30)
        for cue, feature in rates.items()
    }
    start_m = np.arange(60.0, 0.0, -2.0) if features["intersection"] else np.full(30, np.nan)
    step = np.full(30, 2.0)
    return AnnotatedDrive(
        step, np.zeros(30), np.full(30, 0.2), start_m, counts, ((),) * 30, features, place
    )


def drives(first: int, count: int) -> list[AnnotatedDrive]:
    """Drives to intersections of all kinds, and along roads without one."""
    found = []
    for i in range(first, first + count):
        there = i % 4 != 3
        features = {
            "intersection": there,
            "left": there and i % 2 == 0,
            "right": there and i % 3 > 0,
        }
        found.append(drive(f"place {i}", features, i))
    return found


def test_sums_are_published_log_odds_once_per_step_and_fade_over_distance() -> None:
    sums = EvidenceSums(GRAPH, fade_m=10.0, step_m=2.0)
    says, excludes = (log_odds(PRECISION[name]) for name in ("road_left", "one_way_right"))

    sums.update({"road_left": 2, "one_way_right": 0}, 0.0)
    assert np.sinh(sums.statistics()[NAMES.index("left")]) == pytest.approx(says)
    sums.update({"road_left": 1}, 1.0)
    assert np.sinh(sums.statistics()[NAMES.index("left")]) == pytest.approx(says * math.exp(-0.1))
    sums.update({"one_way_right": 1}, 1.0)
    left = says * math.exp(-0.2) - excludes
    assert np.sinh(sums.statistics()[NAMES.index("left")]) == pytest.approx(left)


@given(st.lists(st.floats(1e-6, 1.0 - 1e-6), min_size=len(NAMES), max_size=len(NAMES)))
def test_belief_is_mean_of_log_odds_limited_by_the_intersection(probabilities: list[float]) -> None:
    statistics = np.linspace(-2.0, 2.0, len(NAMES))
    found = mixed(np.array(probabilities), statistics, NEUTRAL, GRAPH)

    wanted = [
        1.0 / (1.0 + math.exp(-0.5 * (log_odds(p) + z)))
        for p, z in zip(probabilities, statistics, strict=True)
    ]
    assert found == pytest.approx(np.minimum(wanted, wanted[0]), rel=1e-9)


def test_ridge_regression_solves_its_equations() -> None:
    rng = np.random.default_rng(3)
    x, weight = rng.normal(0.0, 1.0, (200, 3)), rng.uniform(0.5, 1.5, 200)
    truth = (rng.random(200) < 1.0 / (1.0 + np.exp(-x @ np.array([2.0, -1.0, 0.0])))) * 1.0
    found = ridge_logistic(x, truth, weight, ridge=5.0)

    p = 1.0 / (1.0 + np.exp(-(found[0] + x @ found[1:])))
    assert x.T @ (weight * (truth - p)) == pytest.approx(5.0 * found[1:], abs=1e-6)
    weaker = ridge_logistic(x, truth, weight, ridge=0.01)
    assert np.linalg.norm(weaker[1:]) > np.linalg.norm(found[1:])


def test_fit_and_filter_agree_and_predict_other_places() -> None:
    learned = drives(0, 24)
    temporal = fit_temporal(learned, GRAPH)
    combined = fit_combined(learned, GRAPH, temporal)
    assert combined == fit_combined(learned, GRAPH, temporal)
    losses = []
    for one in drives(100, 12):
        believed = combined_beliefs(one, GRAPH, temporal, combined)
        filter_ = CombinedFilter(GRAPH, temporal.model, combined)
        for i in range(len(one.start_m)):
            filter_.update(
                {cue: int(count[i]) for cue, count in one.counts.items()},
                moved_m=float(one.advanced_m[i]),
                passed_s=0.2,
            )
            assert filter_.probabilities() == pytest.approx(believed[i], abs=1e-9)
        for name, is_there in one.features.items():
            losses.append((believed[-1, NAMES.index(name)] - is_there) ** 2)

    assert np.mean(losses) < 0.08


def test_combined_belief_needs_its_parameters() -> None:
    with pytest.raises(Exception, match="fit temporal"):
        parse("version = 1\n[fusion]\nkind = 'combined'\n", "car.toml")
