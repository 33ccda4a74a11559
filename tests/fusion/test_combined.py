"""The combined belief: running counts, their regression, and the mean with another belief."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from crosscue.fusion.combined import CombinedFilter, CombinedModel, RunningCounts
from crosscue.fusion.factor_graph import graph_of, log_odds
from crosscue.fusion.fit.combined_fit import combined_beliefs, fit_combined, ridge_logistic
from crosscue.fusion.fit.temporal_fit import AnnotatedDrive, fit_temporal
from crosscue.replay.vehicle.fusion import Fusion
from crosscue.replay.vehicle.temporal import Combined

GRAPH = graph_of(Fusion())
NAMES = GRAPH.feature_names


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


def test_counts_are_of_steps_and_fade_over_distance() -> None:
    running = RunningCounts(["sign", "road"], step_m=2.0, fade_m=10.0)

    running.update({"sign": 2, "other": 1}, 0.0)
    running.update({"sign": 1}, 1.0, adds=False)
    assert np.sinh(running.statistics()) / 2.0 == pytest.approx([math.exp(-0.1), 0.0, 0.0, 0.0])
    running.update({"sign": 0, "road": 1}, 0.5)
    fading = math.exp(-0.15)
    assert np.sinh(running.statistics()) / 2.0 == pytest.approx([fading, 0.75, 0.75, 0.0])


def test_counts_do_not_depend_on_the_frame_rate() -> None:
    def counted(per_m: int) -> float:
        running = RunningCounts(["sign"], step_m=5.0, fade_m=50.0)
        for _ in range(40 * per_m):
            running.update({"sign": 1}, 1.0 / per_m)
        return float(np.sinh(running.statistics()[0]))

    assert counted(10) == pytest.approx(counted(1), rel=0.12)


@given(st.lists(st.floats(1e-6, 1.0 - 1e-6), min_size=len(NAMES), max_size=len(NAMES)))
def test_belief_is_mean_of_log_odds_limited_by_the_intersection(probabilities: list[float]) -> None:
    cue = GRAPH.cues[1].name
    intercepts = dict(zip(NAMES, np.linspace(-2.0, 2.0, len(NAMES)).tolist(), strict=True))
    model = CombinedModel(
        GRAPH,
        Combined(
            intercepts=intercepts, positive={"left": {cue: 1.5}}, negative={"left": {cue: -0.5}}
        ),
    )
    statistics = np.zeros(2 * len(GRAPH.cues))
    statistics[2:4] = 1.0, 2.0
    found = model.mixed(np.array(probabilities), statistics)

    regressed = intercepts | {"left": intercepts["left"] + 1.5 - 0.5 * 2.0}
    wanted = [
        1.0 / (1.0 + math.exp(-0.5 * (log_odds(p) + regressed[name])))
        for name, p in zip(NAMES, probabilities, strict=True)
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
    temporal, combined = fit_temporal(learned, GRAPH), fit_combined(learned, GRAPH)
    assert combined == fit_combined(learned, GRAPH)
    losses = []
    for one in drives(100, 12):
        believed = combined_beliefs(one, GRAPH, temporal, combined)
        filter_ = CombinedFilter(temporal.model, CombinedModel(GRAPH, combined))
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
