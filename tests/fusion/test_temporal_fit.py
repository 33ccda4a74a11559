"""Fit of the hidden Markov model: it recovers rates, and its exponent reflects repetition."""

from __future__ import annotations

from typing import Final

import numpy as np
import pytest

from crosscue.fusion.factor_graph import CueNode, Edge, FactorGraph, Feature
from crosscue.fusion.fit.temporal_fit import AnnotatedDrive, filtered, fit_temporal
from crosscue.fusion.temporal import MeasuredRange, temporal_model
from crosscue.replay.vehicle.temporal import CueChain, Temporal

GRAPH: Final = FactorGraph(
    (Feature("intersection", establishes=True), Feature("left", establishes=True)),
    (
        CueNode("sign", 0.9, can_start=True),
        CueNode("road", 0.7, can_start=True),
        CueNode("again", 0.7, can_start=True),
        CueNode("unseen", 0.7),
    ),
    (
        Edge("sign", "intersection"),
        Edge("road", "left"),
        Edge("again", "left"),
        Edge("unseen", "left"),
    ),
)
STAYS, APPEARS = 0.8, 0.15


def drive(number: int, *, is_ahead: bool, left: bool) -> AnnotatedDrive:
    """Return 30 frames at intervals of 2 m; ``road`` is a Markov chain and ``again`` repeats it."""
    rng = np.random.default_rng([number, 3])
    n = 30
    road = np.zeros(n, np.int64)
    for i in range(n):
        chance = (STAYS if i and road[i - 1] else APPEARS) if left else 0.05
        road[i] = rng.random() < chance
    start_m = np.full(n, np.nan)
    if is_ahead:
        start_m = 59.0 - 2.0 * np.arange(n, dtype=np.float64)
    features = {"intersection": is_ahead, "left": left}
    sign = (rng.random(n) < (0.6 if is_ahead else 0.02)).astype(np.int64)
    return AnnotatedDrive(
        np.where(np.arange(n) > 0, 2.0, 0.0),
        np.full(n, 0.01),
        np.full(n, 0.2),
        start_m,
        {"sign": sign, "road": road, "again": road.copy()},
        tuple(
            (MeasuredRange(float(start_m[i]) + rng.normal(), 1.0),) if is_ahead and i % 3 else ()
            for i in range(n)
        ),
        features,
        f"place {number // 2}",
    )


@pytest.fixture(scope="module")
def drives() -> list[AnnotatedDrive]:
    kinds = [(True, True), (True, False), (False, False)]
    return [drive(i, is_ahead=kinds[i // 2 % 3][0], left=kinds[i // 2 % 3][1]) for i in range(48)]


@pytest.fixture(scope="module")
def learned(drives: list[AnnotatedDrive]) -> Temporal:
    return fit_temporal(drives, GRAPH).temporal


def chain(learned: Temporal, cue: str, there: tuple[str, ...]) -> CueChain:
    return next(one for one in learned.chains if one.cue == cue and one.there == there)


def test_fit_recovers_chain_rates(learned: Temporal) -> None:
    found = chain(learned, "road", ("intersection", "left"))

    assert np.mean(found.stays) == pytest.approx(STAYS, abs=0.08)
    assert np.mean(found.appears) == pytest.approx(APPEARS, abs=0.08)
    assert chain(learned, "road", ("intersection",)).appears[0] < 0.1


def test_outgoing_roads_and_presence_are_counted_once_per_place(learned: Temporal) -> None:
    # 24 places: 8 with a left road, 8 without, 8 that are not an intersection.
    assert learned.ahead == pytest.approx(17.0 / 26.0, abs=1e-4)
    assert learned.ways == pytest.approx({"left": 0.5, "none": 0.5})


def test_cue_without_observations_has_no_chain(learned: Temporal) -> None:
    assert {one.cue for one in learned.chains} == {"sign", "road", "again"}


def test_redundant_cue_lowers_exponent(learned: Temporal, drives: list[AnnotatedDrive]) -> None:
    once = fit_temporal(drives, GRAPH.without("again")).temporal

    assert learned.exponent < once.exponent


def test_consistent_ranges_yield_low_stray_probability(learned: Temporal) -> None:
    assert learned.stray < 0.03


def test_filter_recovers_features_of_held_out_drives(
    learned: Temporal,
) -> None:
    model = temporal_model(GRAPH, learned)
    for is_ahead, left in ((True, True), (True, False), (False, False)):
        ends = [
            filtered(drive(1000 + i, is_ahead=is_ahead, left=left), model)[-2] for i in range(8)
        ]
        assert np.mean([abs(p - is_ahead) for p, _ in ends]) < 0.2
        assert np.mean([abs(p - left) for _, p in ends]) < 0.25


def test_fit_from_single_place_is_refused(drives: list[AnnotatedDrive]) -> None:
    with pytest.raises(ValueError, match="two places"):
        fit_temporal(drives[:2], GRAPH)
