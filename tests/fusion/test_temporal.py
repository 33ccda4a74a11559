"""Hidden Markov model: compared with enumeration, and its invariants."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from typing import Final

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from crosscue.fusion.approaches import Approaches
from crosscue.fusion.evidence import FrameEvidence, SignRange
from crosscue.fusion.factor_graph import CueNode, Edge, FactorGraph, Feature
from crosscue.fusion.intersection_range import Reference
from crosscue.fusion.temporal import MeasuredRange, TemporalFilter, temporal_model
from crosscue.replay.columns import Floats
from crosscue.replay.vehicle.fusion import Fusion, RangeFilter
from crosscue.replay.vehicle.temporal import CueChain, Temporal

FILTER: Final = RangeFilter()
TEMPORAL: Final[dict[str, object]] = {"kind": "temporal"}
GRAPH: Final = FactorGraph(
    (Feature("intersection", establishes=True), Feature("left", establishes=True)),
    (CueNode("sign", 0.9, can_start=True), CueNode("road", 0.7, can_start=True)),
    (Edge("sign", "intersection"), Edge("road", "left")),
)


def chain(
    cue: str,
    first: tuple[float, ...],
    stays: tuple[float, ...],
    appears: tuple[float, ...],
    there: tuple[str, ...] = (),
    missing: tuple[str, ...] = (),
) -> CueChain:
    return CueChain(
        cue=cue, there=there, missing=missing, first=first, stays=stays, appears=appears
    )


CHAINS: Final = (
    chain("sign", (0.05,), (0.6,), (0.02,)),
    chain("sign", (0.8, 0.3), (0.9, 0.8), (0.5, 0.1), ("intersection",)),
    chain("road", (0.1,), (0.5,), (0.05,)),
    chain("road", (0.7, 0.4), (0.9, 0.7), (0.4, 0.2), ("intersection", "left")),
    chain("road", (0.2, 0.1), (0.5, 0.5), (0.1, 0.05), ("intersection",), ("left",)),
)


def learned(**changes: object) -> Temporal:
    usual = {
        "ahead": 0.6,
        "ways": {"left": 0.7, "none": 0.3},
        "edges_m": (0.0, 4.0, 8.0),
        "chains": CHAINS,
        "spacing_m": 20.0,
        "behind_m": 2.0,
        "step_m": 1.5,
    }
    return Temporal.model_validate({**usual, **changes})


Frame = tuple[dict[str, int], float, list[MeasuredRange]]
State = tuple[int, int]
"""Index of a cell, and outgoing roads: left, none, or no intersection."""
CELLS, LEFT, NO_WAY, NOWHERE = 5, 0, 1, 2
P_WAY: Final = (0.7, 0.3)


def enumerated(about: Temporal, frames: list[Frame]) -> Floats:
    """Return the probabilities of intersection and left, summed over all paths of states."""
    states = list(itertools.product(range(CELLS), range(3)))
    total = np.zeros(3)
    for path in itertools.product(states, repeat=len(frames)):
        weight = path_weight(about, frames, path)
        way = path[-1][1]
        total += weight * np.array([1.0, way != NOWHERE, way == LEFT])
    return np.asarray(total[1:] / total[0])


def path_weight(about: Temporal, frames: list[Frame], path: tuple[State, ...]) -> float:
    cell_m, gone_m = about.cell_m, 0.0
    before: dict[str, bool] = {}
    weight = prior(about, path[0])
    for i, (counts, moved_m, ranges) in enumerate(frames):
        crossed = int((gone_m + moved_m) // cell_m) - int(gone_m // cell_m)
        gone_m += moved_m
        if i:
            weight *= transition_probability(about, path[i - 1], path[i], crossed)
        if weight == 0.0:
            return 0.0
        cell, way = path[i]
        center_m = (cell + 0.5) * cell_m - about.behind_m - gone_m % cell_m
        for cue, count in counts.items():
            p = detection_probability(about, cue, way, center_m, before.get(cue))
            weight *= (p if count else 1.0 - p) ** about.exponent
        before = {cue: count > 0 for cue, count in counts.items()}
        for one in ranges:
            var_m2 = one.var_m2 + cell_m**2 / 12.0
            normal = math.exp(-0.5 * (center_m - one.range_m) ** 2 / var_m2)
            normal /= math.sqrt(2 * math.pi * var_m2)
            weight *= (1 - about.stray) * normal + about.stray / 150.0
    return weight


def prior(about: Temporal, state: State) -> float:
    cell, way = state
    # The first cell is behind the rear axle.
    place = 1.0 / (CELLS - 1) if cell > 0 else 0.0
    return place * (1.0 - about.ahead if way == NOWHERE else about.ahead * P_WAY[way])


def transition_probability(about: Temporal, old: State, new: State, cells: int) -> float:
    assert cells in (0, 1)
    if cells == 0:
        return float(old == new)
    comes = about.cell_m / about.spacing_m
    if old[1] == NOWHERE and new[1] == NOWHERE:
        return (1.0 - comes) * (new[0] == (old[0] - 1) % CELLS)
    if old[1] == NOWHERE:
        return comes * P_WAY[new[1]] * (new[0] == CELLS - 1)
    if old[0] == 0:
        return (new[1] == NOWHERE) / CELLS
    return float(new == (old[0] - 1, old[1]))


def detection_probability(
    about: Temporal, cue: str, way: int, center_m: float, before: bool | None
) -> float:
    there = {LEFT: {"intersection", "left"}, NO_WAY: {"intersection"}, NOWHERE: set[str]()}[way]
    (one,) = (
        one
        for one in about.chains
        if one.cue == cue
        and bool(one.there or one.missing) == (way != NOWHERE)
        and there.issuperset(one.there)
        and there.isdisjoint(one.missing)
    )
    row = {None: one.first, True: one.stays, False: one.appears}[before]
    return row[0 if way == NOWHERE else int(center_m >= 4.0)]


@pytest.mark.parametrize("exponent", [1.0, 0.4])
def test_filter_equals_sum_over_all_state_paths(exponent: float) -> None:
    frames: list[Frame] = [
        ({"sign": 0, "road": 1}, 0.0, []),
        ({"sign": 1}, 1.9, [MeasuredRange(4.5, 2.0)]),
        ({"sign": 2, "road": 0}, 2.0, [MeasuredRange(1.0, 1.0)]),
    ]
    about = learned(exponent=exponent)
    belief = TemporalFilter(temporal_model(GRAPH, about))

    for counts, moved_m, ranges in frames:
        belief.update(counts, ranges, moved_m, 0.0, 0.1)

    np.testing.assert_allclose(belief.probabilities(), enumerated(about, frames), rtol=1e-10)


STEPS = st.lists(
    st.tuples(
        st.dictionaries(st.sampled_from(["sign", "road"]), st.integers(0, 2)),
        st.floats(-3.0, 6.0),
        st.floats(0.0, 9.0),
        st.lists(st.tuples(st.floats(-20.0, 160.0), st.floats(1e-3, 1e4)), max_size=2),
    ),
    max_size=25,
)


@given(STEPS)
@settings(max_examples=30, deadline=None)
def test_left_never_exceeds_intersection_and_mass_is_conserved(
    steps: list[tuple[dict[str, int], float, float, list[tuple[float, float]]]],
) -> None:
    belief = TemporalFilter(temporal_model(GRAPH, learned()))

    for counts, moved_m, var_m2, ranges in steps:
        belief.update(counts, [MeasuredRange(*one) for one in ranges], moved_m, var_m2, 0.1)
        intersection, left = belief.probabilities()
        assert left <= intersection
        assert belief.nowhere.sum() + belief.ahead.sum() == pytest.approx(1.0)
        assert (belief.nowhere >= 0.0).all()
        assert (belief.ahead >= 0.0).all()


def test_consistent_ranges_update_distance_but_not_presence() -> None:
    belief = TemporalFilter(temporal_model(GRAPH, learned(spacing_m=1e9)))
    before = belief.probabilities()[0]

    for _ in range(3):
        belief.update({}, [MeasuredRange(5.0, 1.0)])

    assert belief.probabilities()[0] == pytest.approx(before)
    assert belief.distance_m() == pytest.approx(5.0, abs=0.5)


def test_lapse_mixes_prior_into_probabilities() -> None:
    sure, careful = (
        TemporalFilter(temporal_model(GRAPH, learned(lapse=lapse))) for lapse in (0.0, 0.1)
    )
    for belief in (sure, careful):
        for _ in range(3):
            belief.update({"sign": 1, "road": 1}, moved_m=2.0)

    usual = careful.model.usual
    np.testing.assert_allclose(
        careful.probabilities(), 0.9 * sure.probabilities() + 0.1 * usual, rtol=1e-12
    )
    assert careful.probabilities()[1] <= careful.probabilities()[0]


def test_stationary_car_gains_no_evidence_from_repeated_pictures() -> None:
    belief = TemporalFilter(temporal_model(GRAPH, learned()))
    belief.update({"sign": 1}, moved_m=2.0, passed_s=0.1)
    before = belief.probabilities()[0]

    for _ in range(100):
        belief.update({"sign": 1}, passed_s=0.1, is_new_picture=False)

    assert belief.probabilities()[0] == pytest.approx(before)


def test_persisting_cue_is_weaker_evidence_than_appearing_cue() -> None:
    once, again = (TemporalFilter(temporal_model(GRAPH, learned())) for _ in range(2))
    once.update({"sign": 0}, moved_m=0.0)
    again.update({"sign": 1}, moved_m=0.0)
    odds = [math.log(p / (1 - p)) for p in (once.probabilities()[0], again.probabilities()[0])]

    for belief in (once, again):
        belief.update({"sign": 1}, moved_m=1.6)
    after = [math.log(p / (1 - p)) for p in (once.probabilities()[0], again.probabilities()[0])]

    assert after[0] - odds[0] > after[1] - odds[1]


def test_frames_between_filter_steps_change_nothing() -> None:
    about = learned(step_m=2.0, step_s=100.0)
    coarse, fine = (TemporalFilter(temporal_model(GRAPH, about)) for _ in range(2))
    counts = {"sign": 1, "road": 0}

    for belief, frames in ((coarse, 1), (fine, 4)):
        belief.update(counts)
        for _ in range(3 * frames):
            belief.update(counts, moved_m=2.0 / frames, passed_s=0.2 / frames)

    np.testing.assert_allclose(fine.probabilities(), coarse.probabilities(), rtol=1e-12)


def frame(number: int, sign: int, range_m: float | None = None) -> FrameEvidence:
    signs = () if range_m is None else (SignRange(Reference.START, range_m, 4.0),)
    return FrameEvidence(
        number * 200_000_000, 2.0 if number else None, 0.0, signs, {"sign": sign, "road": sign}
    )


def test_presence_is_established_with_hysteresis_and_withdrawn_without_cues() -> None:
    edges_m = (0.0, 80.0)
    chains = tuple(
        one.model_copy(
            update={name: getattr(one, name)[:1] for name in ("first", "stays", "appears")}
        )
        for one in learned().chains
    )
    about = learned(edges_m=edges_m, chains=chains)
    belief = Approaches(GRAPH, Fusion().model_copy(update=TEMPORAL | {"temporal": about}), FILTER)

    seen = [belief(frame(i, 1, 40.0 - 2.0 * i)) for i in range(6)]
    gone = [belief(frame(i, 0)) for i in range(6, 18)]

    assert seen[-1].established
    assert not gone[-1].established
    between = [step.probabilities["intersection"] for step in gone if step.established]
    assert min(between) < 0.9
    for step in (*seen, *gone):
        intersection = step.probabilities["intersection"]
        assert step.probabilities["left"] <= intersection + 1e-9
        assert intersection > 0.5 or not step.established


SEQUENCE = st.lists(
    st.tuples(
        st.dictionaries(st.sampled_from(["sign", "road"]), st.integers(0, 2)),
        st.floats(-1.0, 8.0),
        st.floats(0.0, 4.0),
        st.none() | st.tuples(st.floats(-10.0, 200.0), st.floats(1e-2, 1e3)),
        st.booleans(),
    ),
    min_size=1,
    max_size=40,
)
"""Counts, distance and its variance, a sign's range with its variance, and ``is_new_picture``."""


@given(SEQUENCE, st.floats(0.0, 0.2))
@settings(max_examples=60, deadline=None)
def test_steps_respect_probability_bounds_and_hysteresis(
    frames: list[tuple[dict[str, int], float, float, tuple[float, float] | None, bool]],
    lapse: float,
) -> None:
    fusion = Fusion().model_copy(update=TEMPORAL | {"temporal": learned(lapse=lapse)})
    belief, was, approach = Approaches(GRAPH, fusion, FILTER), False, None

    for i, (counts, way_m, var_m2, sign, is_new) in enumerate(frames):
        signs = () if sign is None else (SignRange(Reference.START, *sign),)
        step = belief(
            FrameEvidence(i * 200_000_000, way_m, var_m2, signs, counts, is_new_picture=is_new)
        )
        if step.approach != approach:
            was, approach = False, step.approach
        if step.approach is None:
            continue
        intersection = step.probabilities["intersection"]
        assert 0.0 < step.probabilities["left"] <= intersection + 1e-12 < 1.0
        # Established above 0.9, withdrawn below 0.5, and unchanged in between.
        limit = fusion.withdrawn if was else fusion.established
        if abs(intersection - limit) > 1e-9:
            assert step.established == (intersection > limit)
        was = step.established


def test_distance_before_first_picture_changes_nothing() -> None:
    settings = Fusion().model_copy(update=TEMPORAL | {"temporal": learned()})
    at_once, later = (Approaches(GRAPH, settings, FILTER) for _ in range(2))

    first = at_once(frame(0, 1, 5.0))
    after_distance = later(replace(frame(0, 1, 5.0), travelled_m=37.0, travelled_var_m2=1.0))

    assert after_distance.probabilities == first.probabilities


def test_restart_resets_belief() -> None:
    settings = Fusion().model_copy(update=TEMPORAL | {"temporal": learned()})
    belief = Approaches(GRAPH, settings, FILTER)
    first = belief(frame(0, 1, 5.0))
    belief(frame(1, 1, 3.0))

    belief.restart()
    again = belief(replace(frame(2, 1, 5.0), travelled_m=None))

    assert again.probabilities == pytest.approx(first.probabilities)


@pytest.mark.parametrize(
    ("given_settings", "why"),
    [
        ({"kind": "temporal"}, "kind temporal needs"),
        ({"kind": "temporal", "temporal": learned(chains=()), "withdrawn": 0.95}, "to be smaller"),
        ({"temporal": learned()}, "no cue 'sign'"),
    ],
)
def test_invalid_fusion_settings_are_refused(given_settings: dict[str, object], why: str) -> None:
    with pytest.raises(ValidationError, match=why):
        Fusion.model_validate(given_settings)


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"edges_m": (0.0, 8.0, 4.0)}, "ascending"),
        ({"edges_m": (0.0, 4.0)}, "expected 1 entries, got 2"),
        ({"ways": {}}, "at least one"),
    ],
)
def test_inconsistent_temporal_model_is_refused(changes: dict[str, object], why: str) -> None:
    with pytest.raises(ValidationError, match=why):
        learned(**changes)
