"""Beliefs with fitted parameters: messages, and the combined belief."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from crosscue.fusion.approaches import Approaches
from crosscue.fusion.belief import published_message_model
from crosscue.fusion.calibrated import CalibratedMessageModel, cue_messages_of
from crosscue.fusion.combined import CombinedFilter, CombinedModel, RunningCounts
from crosscue.fusion.factor_graph import graph_of, log_odds
from crosscue.fusion.fit.combined_fit import combined_beliefs, fit_combined, ridge_logistic
from crosscue.fusion.fit.message_fit import fit_messages, log_odds_of
from crosscue.fusion.fit.temporal_fit import AnnotatedDrive, fit_temporal
from crosscue.fusion.situation import Situation
from crosscue.replay.errors import VehicleError
from crosscue.replay.vehicle.fusion import Calibrated, Combined, Fade, Fusion, RangeFilter, Rates
from crosscue.replay.vehicle.vehicle import parse
from support.fusion import FADE_M, RATES, annotated, drive, situation

GRAPH = graph_of(Fusion())
LEFT = GRAPH.feature_names.index("left")
P, Q, FADE = 0.6, 0.1, 5.0
LEARNED = Calibrated(
    fades={"road_left": Fade(way_m=FADE), "cross_traffic_left": Fade(time_s=2.0)},
    rates=tuple(
        Rates(cue=cue, feature="left", near=near, if_there=P, if_not=Q)
        for cue in ("road_left", "cross_traffic_left", "parked_left")
        for near in (False, True)
    ),
)


def left_messages(*observations: Situation, learned: Calibrated = LEARNED) -> list[float]:
    """Return the change in the log odds of left that each observation causes."""
    model = CalibratedMessageModel(len(GRAPH.features), cue_messages_of(GRAPH, learned))
    return [model(observation)[LEFT] for observation in observations]


def road(count: int, moved_m: float = 1.0) -> Situation:
    return situation({"road_left": count}, moved_m=moved_m)


# Messages of a first positive and negative observation: 0.6 / 0.1, and (1 - 0.6) / (1 - 0.1).
SIDE, AWAY = math.log(6.0), math.log(4.0 / 9.0)


def fades(many: float) -> float:
    """Return a distance of several fading lengths of the cue ``road_left``."""
    return many * FADE


def test_messages_are_ratios_of_markov_chains() -> None:
    """After a distance with a correlation of 1/3, half of a frame is independent.

    It stays positive at 0.6 + 0.4 / 3 = 11/15 with the feature and at 0.1 + 0.9 / 3 = 2/5 without
    it: 11/6. It stays negative at 1 - 0.6 * 2/3 = 3/5 and 1 - 0.1 * 2/3 = 14/15: 9/14. A change
    counts fully at first, and by half this soon after the last change in the same direction.
    """
    third = fades(math.log(3.0))
    stays = left_messages(road(1), road(1, third))
    away = left_messages(road(0), road(0, third))
    flickers = left_messages(*(road(n, third / 2.0) for n in (1, 0, 1, 0)))

    assert stays == pytest.approx([SIDE, math.log(11 / 6)])
    assert away == pytest.approx([AWAY, math.log(9 / 14)])
    assert flickers == pytest.approx([SIDE, AWAY, 0.5 * SIDE, 0.5 * AWAY])
    assert left_messages(road(0), road(1, 0.1))[1] == pytest.approx(SIDE)
    assert left_messages(road(1), road(1, 500.0))[1] == pytest.approx(SIDE)


def test_time_replaces_distance_for_moving_objects() -> None:
    """The fade is 2 s: a correlation of 1/3 after 2 log 3 s, in two steps of which one is silent.

    Neither the distance nor a frame in which the cue was not evaluated counts.
    """
    traffic = {"cross_traffic_left": 1}
    first, silent, again = left_messages(
        *(
            situation(counts, moved_m=100.0, passed_s=math.log(3.0))
            for counts in (traffic, {}, traffic)
        )
    )

    assert (first, silent, again) == pytest.approx((SIDE, 0.0, math.log(11 / 6)))


def test_near_and_far_have_their_own_rates_and_published_messages() -> None:
    """Far, 0.6 / 0.1 and exponent 1/2; near, 0.8 / 0.2 and 0.4 / 0.1 for two cues of one feature.

    Where ``road_left`` has no rates for near, its published message counts: 0.77 / 0.23. A one-way
    sign to the right excludes left; without rates, it sends 0.05 / 0.95 at any distance.
    """

    def rates(cue: str, near: bool, there: float, absent: float) -> Rates:
        return Rates(cue=cue, feature="left", near=near, if_there=there, if_not=absent)

    learned = Calibrated(
        exponents={"left": 0.5},
        rates=(
            rates("parked_left", False, 0.6, 0.1),
            rates("parked_left", True, 0.8, 0.2),
            rates("cross_traffic_left", True, 0.4, 0.1),
            rates("road_left", False, 0.5, 0.25),
        ),
    )
    parked = {"parked_left": 1}
    seen = {"far": 6.0, "near": 4.0}
    for distance, ratio in seen.items():
        at = situation(parked, near=distance == "near")
        assert left_messages(at, learned=learned) == pytest.approx([0.5 * math.log(ratio)])
    both = situation({**parked, "cross_traffic_left": 1}, near=True)
    assert left_messages(both, learned=learned) == pytest.approx([0.5 * math.log(16.0)])
    for near, ratio in ((False, 2.0), (True, 0.77 / 0.23)):
        both = situation({"road_left": 1, "one_way_right": 1}, near=near)
        expected = 0.5 * (math.log(ratio) + math.log(0.05 / 0.95))
        assert left_messages(both, learned=learned) == pytest.approx([expected])


def test_published_message_counts_new_objects_fully_and_others_by_independence() -> None:
    """The default fade is 10 m: after 10 log 3 m, half. A new identity counts as the first."""
    model = CalibratedMessageModel(len(GRAPH.features), cue_messages_of(GRAPH, LEARNED))
    moved_m = 10.0 * math.log(3.0)
    signs = [
        situation({"stop_sign": 1}, objects={"stop_sign": ids}, moved_m=moved_m)
        for ids in ((1,), (1,), (2,), (1,))
    ]

    sent = [model(one)[0] for one in signs]

    published = math.log(0.97 / 0.03)
    assert sent == pytest.approx([published, 0.5 * published, published, 0.5 * published])


@given(st.lists(st.integers(0, 3), min_size=1, max_size=30))
def test_stationary_car_counts_cue_and_its_absence_once_each(counts: list[int]) -> None:
    still = [situation({"road_left": min(count, 1)}, moved_m=0.0) for count in counts]

    total = sum(left_messages(road(1), *still))

    gone = math.log((1 - P) / (1 - Q))
    assert total == pytest.approx(math.log(P / Q) + (gone if 0 in counts else 0.0))


def test_repeated_picture_sends_no_message() -> None:
    same = situation({"road_left": 1}, new_picture=False)

    assert left_messages(road(1), same, same)[1:] == [0.0, 0.0]


def test_without_identities_only_highest_count_adds_new_objects() -> None:
    one, two, one_again, two_again = left_messages(
        *(situation({"parked_left": n}, moved_m=0.0) for n in (1, 2, 1, 2))
    )

    assert one == two == pytest.approx(math.log(P / Q))
    assert one_again == two_again == 0.0


def test_gate_applies_to_learned_messages() -> None:
    shut = situation({"parked_left": 3, "road_left": 0}, established=False)

    assert left_messages(shut) == [pytest.approx(math.log((1 - P) / (1 - Q)))]


def test_message_memory_is_reset_for_each_approach() -> None:
    fusion = Fusion(kind="calibrated", calibrated=LEARNED)
    loop = Approaches(GRAPH, fusion, RangeFilter())
    seen = {"stop_sign": (60.0, 1), "road_left": (25.0, 1)}

    first = [loop(one).probabilities for one in drive(70.0, -20.0, seen)]
    second = [loop(one).probabilities for one in drive(70.0, -20.0, seen, begin_ns=10**12)]

    assert first == [pytest.approx(one) for one in second]
    assert loop.counts["approaches opened"] == 2


def test_fit_recovers_true_rates_and_fade_length() -> None:
    fit = fit_messages(annotated(1, 300), GRAPH)

    learned = [one for one in fit.rates if one.rates is not None]
    assert {one.cue for one in fit.calibrated.rates} == {*RATES}
    for one in learned:
        found = (one.rates.if_there, one.rates.if_not) if one.rates else ()
        for rate, side, fraction in zip(
            RATES[one.cue], (one.there, one.missing), found, strict=True
        ):
            four_sd = 4 * math.sqrt(rate * (1 - rate) / side.observations)
            assert fraction == pytest.approx(rate, abs=four_sd)
    # At 10 m/s, fades over distance and over time are equivalent here.
    fades = [one.fade for one in fit.fades if one.is_learned]
    scales_m = [fade.way_m or (fade.time_s or 0.0) * 10.0 for fade in fades]
    assert scales_m == pytest.approx([FADE_M] * 3, rel=0.35)


def test_calibrated_model_beats_source_on_held_out_simulated_approaches() -> None:
    learned = fit_messages(annotated(5, 100), GRAPH).calibrated
    ours = theirs = 0.0
    for one in annotated(6, 100):
        is_left = one.features["left"]
        odds = log_odds_of(one, GRAPH, learned)[:, LEFT]
        ours += float(np.logaddexp(0.0, -odds if is_left else odds).mean())
        model = published_message_model(GRAPH, 0.49)
        frames = range(len(one.way_m))
        observations = ({cue: int(n[i]) for cue, n in one.counts.items()} for i in frames)
        messages = [
            model(situation(observation, near=bool(one.is_near[i])))
            for i, observation in enumerate(observations)
        ]
        source = np.cumsum(np.array(messages), axis=0)[:, LEFT]
        theirs += float(np.logaddexp(0.0, -source if is_left else source).mean())

    assert ours < 0.5 * theirs


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("kind = 'calibrated'", "needs .fusion.calibrated.; make it with: crosscue fit messages"),
        ("calibrated.fades = { road_lft = { way_m = 3.0 } }", r"did you mean road_left\?"),
        ("calibrated.fades = { road_left = { way_m = 3.0, time_s = 1.0 } }", "either way_m or"),
        ("calibrated.fades = { road_left = {} }", "either way_m or"),
        ("calibrated.exponents = { lft = 0.5 }", "no 'lft' .did you mean left"),
        (
            "calibrated.rates = [{ cue = 'road_left', feature = 'right', near = true, "
            "if_there = 0.5, if_not = 0.5 }]",
            "no edge from road_left to right",
        ),
        (
            "calibrated.rates = ["
            + "{ cue = 'road_left', feature = 'left', near = true, if_there = 0.5, if_not = 0.4 },"
            * 2
            + "]",
            "road_left and left occur twice",
        ),
    ],
)
def test_invalid_calibrated_settings_are_refused(text: str, match: str) -> None:
    with pytest.raises(VehicleError, match=match):
        parse(f"version = 1\n[fusion]\n{text}", "car.toml")


NAMES = GRAPH.feature_names


def annotated_drive(place: str, features: dict[str, bool], seed: int) -> AnnotatedDrive:
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
        found.append(annotated_drive(f"place {i}", features, i))
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
