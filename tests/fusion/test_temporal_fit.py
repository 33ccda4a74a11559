"""Fit of the hidden Markov model: it recovers rates, and its exponent reflects repetition."""

from dataclasses import replace
from typing import Final

import numpy as np
import pytest

from crosscue.fusion.factor_graph import CueNode, Edge, FactorGraph, Feature
from crosscue.fusion.fit.temporal_fit import (
    EXPONENTS,
    LAPSES,
    AnnotatedDrive,
    filtered,
    fit_temporal,
    log_loss,
)
from crosscue.fusion.temporal import MeasuredRange, TemporalFilter, temporal_model
from crosscue.replay.vehicle.fusion import CueChain, Temporal

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
PAIR: Final = FactorGraph(GRAPH.features, GRAPH.cues[:2], GRAPH.edges[:2])


def hand_drive(
    place: str,
    sign: list[int],
    start_m: list[float],
    *,
    left: bool | None = None,
    ranges_m: tuple[float, ...] = (),
    advanced_m: list[float] | None = None,
    passed_s: list[float] | None = None,
    road: list[int] | None = None,
) -> AnnotatedDrive:
    """Return a drive with a step of 2 m per frame, to an intersection if ``start_m`` is finite."""
    n = len(sign)
    is_ahead = bool(np.isfinite(start_m).all())
    features = {"intersection": is_ahead} | ({} if left is None else {"left": left})
    counts = {"sign": sign} | ({} if road is None else {"road": road})
    return AnnotatedDrive(
        np.array([2.0] * n if advanced_m is None else advanced_m),
        np.zeros(n),
        np.zeros(n) if passed_s is None else np.array(passed_s),
        np.array(start_m, np.float64),
        {name: np.array(count, np.int64) for name, count in counts.items()},
        (tuple(MeasuredRange(range_m, 9.0) for range_m in ranges_m), *[()] * (n - 1)),
        features,
        place,
    )


NONE_AHEAD: Final = [float("nan")] * 4
SEEN: Final = hand_drive(
    "a",
    # Frames 1 and 3 are no steps: after 1 m (then -0.5 m), and after 9 s and 0.75 m (then as far).
    [1, 0, 1, 1, 0, 1, 1, 1],
    [60.0, 44.0, 43.0, 9.0, 9.0, 0.0, 0.0, 0.0],
    left=True,
    ranges_m=(69.0, 69.01, 60.0, 60.0, 60.0),
    advanced_m=[0.0, 1.0, -0.5, 0.75, 0.75, 1.5, 1.5, 1.5],
    passed_s=[0.0, 0.0, 0.0, 9.0, 0.0, 0.0, 0.0, 0.0],
)
UNSEEN: Final = hand_drive("b", [0, 1, -1, 0], NONE_AHEAD, left=False, ranges_m=(30.0,))


def test_chains_are_frequencies_shrunk_towards_more_general_ones() -> None:
    """The sign is seen at 60 and 43 m, not at 9 m, and three times at 0 m; elsewhere it is 0 1 - 0.

    Overall it is positive in (6 + 20 / 2) / (9 + 20) = 16/29, stays so in (3 + 10) / 24, and
    appears in (2 + 10) / 22. A more special frequency has its own steps and 20 of the more general
    one: without an intersection (1 + 20 * 0.5517) / 23; ahead at all distances
    (5 + 20 * 0.5517) / 26 = 0.6167; within 10 m (3 + 20 * 0.6167) / 24; and the others likewise.
    """
    learned = fit_temporal([SEEN, UNSEEN], PAIR)

    nowhere, ahead = learned.temporal.chains
    assert nowhere == chain_of("sign", (), (0.5232,), (0.5417,), (0.5671,))
    assert ahead == chain_of(
        "sign",
        ("intersection",),
        (0.6389, 0.6167, 0.6167, 0.635, 0.635),
        (0.5882, 0.5764, 0.5764, 0.5966, 0.5764),
        (0.5877, 0.5671, 0.5671, 0.5671, 0.5671),
    )
    assert (learned.drives, learned.places, learned.steps) == (2, 2, 10)
    # One of two places is an intersection. Of five ranges one is stray: 9 m is not above 3 * 3 m.
    assert learned.temporal.ahead == 0.5
    assert learned.temporal.stray == 0.2857
    # One half of the places has no intersection, so nothing can be validated.
    assert (learned.temporal.exponent, learned.temporal.lapse) == (1.0, 0.0)
    assert learned.log_scores == {}
    assert learned.model.settings == learned.temporal


def test_outgoing_roads_are_counted_once_per_place_and_half_a_place_more() -> None:
    """2 + 1/2, 1 + 1/2, 1/2 and 1 + 1/2 of 6; 4 of 5 places are intersections: 5/7."""
    graph = FactorGraph((*GRAPH.features, Feature("right")), GRAPH.cues[:1], GRAPH.edges[:1])
    roads = [("a", True, True), ("b", True, True), ("c", True, False), ("d", False, False)]
    some = [
        replace(
            hand_drive(place, [-1], [5.0]),
            features={"intersection": True, "left": left, "right": right},
        )
        for place, left, right in (*roads, roads[0])
    ]

    learned = fit_temporal([*some, replace(UNSEEN, place="e")], graph).temporal

    assert learned.ways == {"left+right": 0.4167, "left": 0.25, "right": 0.0833, "none": 0.25}
    assert learned.ahead == 0.7143


def test_chains_of_a_direction_depend_on_whether_its_road_is_there() -> None:
    """A road is positive with left and not without it, both at 10 m and thus from 10 to 20 m.

    Of all, (3 + 10) / 26 = 1/2 are positive; with left (3 + 10) / 23 = 0.5652 and without it
    10 / 23 = 0.4348, and from 10 to 20 m (3 + 20 * 0.5652) / 23 and 20 * 0.4348 / 23. Beyond 80 m,
    and where left is unknown, nothing is counted for them.
    """
    at, road = [10.0] * 3, [1, 1, 1]
    some = [
        hand_drive("e", [-1] * 3, at, left=True),
        hand_drive("a", [-1] * 3, at, left=True, road=road),
        hand_drive("b", [-1] * 3, at, left=False, road=[0, 0, 0]),
        hand_drive("c", [-1] * 2, [80.0, 80.0], left=True, road=[1, 0]),
        hand_drive("d", [-1] * 2, [5.0, 5.0], road=[1, 0]),
    ]

    chains = fit_temporal(some, PAIR).temporal.chains

    assert [(one.cue, one.there, one.missing) for one in chains] == [
        ("road", (), ()),
        ("road", ("intersection", "left"), ()),
        ("road", ("intersection",), ("left",)),
    ]
    nowhere, there, missing = chains
    assert nowhere.first == (0.5,)
    assert there.first == (0.5652, 0.6219, 0.5652, 0.5652, 0.5652)
    assert missing.first == (0.4348, 0.3781, 0.4348, 0.4348, 0.4348)


def test_frequencies_stay_0_002_away_from_zero_and_one() -> None:
    """After 500 positive steps, a frequency is 0.998, and after as many negative ones 0.002."""
    for value, rate in ((1, 0.998), (0, 0.002)):
        long = hand_drive("a", [value] * 500, [5.0] * 500, left=True)
        chains = fit_temporal([long, UNSEEN], PAIR).temporal.chains
        assert chains[1].first[0] == rate


def test_log_loss_is_mean_over_frames_and_known_features() -> None:
    """-log of 1/2, 1/4 and 1 - 1/4 twice: (3 log 2 + 2 log(4/3)) / 4; unknown left, 3 log 2 / 2."""
    beliefs = np.array([[0.5, 0.25], [0.25, 0.25]])
    known = hand_drive("a", [0, 0], [5.0, 4.0], left=False)
    unknown = hand_drive("a", [0, 0], [5.0, 4.0])

    assert log_loss(known, PAIR, beliefs) == pytest.approx(
        (3.0 * np.log(2.0) + 2.0 * np.log(4.0 / 3.0)) / 4.0
    )
    assert log_loss(unknown, PAIR, beliefs) == pytest.approx(1.5 * np.log(2.0))


def test_exponent_and_lapse_have_lowest_log_score_on_the_other_half_of_the_places() -> None:
    """Places a and c validate the fit of b and d, and the other way round.

    The halves contradict each other, so the lowest exponent and the highest lapse are best.
    """
    some = [
        hand_drive("a", [1, 1, 0, 1], [40.0, 30.0, 20.0, 10.0], left=True, road=[1, 0, 1, 1]),
        hand_drive("b", [0, 0, 0, 0], [40.0, 30.0, 20.0, 10.0], left=False, road=[0, 0, 1, 0]),
        hand_drive("c", [0, 0, 0, 1], NONE_AHEAD, left=False, road=[0, 1, 0, 0]),
        hand_drive("d", [1, 1, 1, 1], NONE_AHEAD, left=False, road=[0, 0, 0, 0]),
    ]
    halves = [some[0], some[2]], [some[1], some[3]]

    learned = fit_temporal(some, PAIR)

    assert len(learned.log_scores) == len(EXPONENTS) * len(LAPSES)
    for exponent, lapse in ((1.0, 0.0), (0.25, 0.05)):
        losses = []
        for half, other in (halves, halves[::-1]):
            changes = {"exponent": exponent, "lapse": lapse}
            about = fit_temporal(other, PAIR).temporal.model_copy(update=changes)
            model = temporal_model(PAIR, about)
            losses += [log_loss(one, PAIR, filtered(one, model)) for one in half]
        assert learned.log_scores[exponent, lapse] == pytest.approx(np.mean(losses))
    assert min(learned.log_scores, key=learned.log_scores.__getitem__) == (0.18, 0.1)
    assert (learned.temporal.exponent, learned.temporal.lapse) == (0.18, 0.1)


def test_filtered_probabilities_are_those_of_the_drive() -> None:
    """Each frame's distance, variance, time, ranges and evaluated cues reach the filter."""
    model = temporal_model(PAIR, fit_temporal([SEEN, UNSEEN], PAIR).temporal)
    drive = AnnotatedDrive(
        np.array([0.0, 3.0, -1.0]),
        np.array([0.0, 4.0, 1.0]),
        np.array([0.0, 0.0, 0.5]),
        np.array([20.0, 17.0, 18.0]),
        {"sign": np.array([1, -1, 0])},
        ((), (MeasuredRange(17.0, 1.0),), ()),
        {},
        "a",
    )
    belief = TemporalFilter(model)
    expected = []
    for counts, ranges, moved_m, var_m2, passed_s in (
        ({"sign": 1}, [], 0.0, 0.0, 0.0),
        ({}, [MeasuredRange(17.0, 1.0)], 3.0, 4.0, 0.0),
        ({"sign": 0}, [], -1.0, 1.0, 0.5),
    ):
        belief.update(counts, ranges, moved_m, var_m2, passed_s)
        expected.append(belief.probabilities())

    np.testing.assert_array_equal(filtered(drive, model), expected)
    none = hand_drive("a", [], [])
    assert filtered(none, model).shape == (0, 2)


def chain_of(
    cue: str,
    there: tuple[str, ...],
    first: tuple[float, ...],
    stays: tuple[float, ...],
    appears: tuple[float, ...],
) -> CueChain:
    return CueChain(cue=cue, there=there, first=first, stays=stays, appears=appears)


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


def test_redundant_cue_lowers_exponent(learned: Temporal, drives: list[AnnotatedDrive]) -> None:
    once = fit_temporal(drives, GRAPH.without("again")).temporal

    assert learned.exponent < once.exponent


def test_filter_recovers_features_of_held_out_drives(learned: Temporal) -> None:
    model = temporal_model(GRAPH, learned)
    for is_ahead, left in ((True, True), (True, False), (False, False)):
        ends = [
            filtered(drive(1000 + i, is_ahead=is_ahead, left=left), model)[-2] for i in range(8)
        ]
        assert np.mean([abs(p - is_ahead) for p, _ in ends]) < 0.2
        assert np.mean([abs(p - left) for _, p in ends]) < 0.25


def test_fit_without_second_place_or_intersection_is_refused() -> None:
    wanted = "^expected drives at two places or more, one with an intersection$"
    for some in ([SEEN], [UNSEEN, replace(UNSEEN, place="c")]):
        with pytest.raises(ValueError, match=wanted):
            fit_temporal(some, PAIR)
