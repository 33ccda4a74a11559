"""Tests of persistence: single and repeated frames do not count, lasting cues count a few times."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crosscue.fusion.approaches import Approaches, Step, message_models_of
from crosscue.fusion.evidence import FrameEvidence, RangePosterior
from crosscue.fusion.factor_graph import CueNode, Edge, FactorGraph, Feature, graph_of, log_odds
from crosscue.fusion.intersection_range import Reference
from crosscue.fusion.persistence import Confirmed, Persistence, PersistentMessageModel
from crosscue.fusion.situation import Situation
from crosscue.replay.vehicle.fusion import Calibrated, Fade, Fusion, RangeFilter, Rates
from crosscue.replay.vehicle.vehicle import SIMULATED_CAR, Vehicle
from support.fusion import NONE_SEEN, SECOND_NS, situation

FUSION = Fusion(kind="persistent")
GRAPH = graph_of(FUSION)
CUES = [cue.name for cue in GRAPH.cues]
STEP_NS = SECOND_NS // 10


def fusion_steps(frames: Sequence[FrameEvidence], fusion: Fusion = FUSION) -> list[Step]:
    approaches = Approaches(graph_of(fusion), fusion, RangeFilter())
    return [approaches(frame) for frame in frames]


def frames_of(
    cue: str, positive: Sequence[int], step_m: float = 1.0, *, begin: int = 0
) -> list[FrameEvidence]:
    return [
        FrameEvidence((begin + i) * STEP_NS, step_m, 1e-4, (), {**NONE_SEEN, cue: count})
        for i, count in enumerate(positive)
    ]


def max_deviation(steps: Sequence[Step]) -> float:
    """Return the largest deviation of any feature's probability from 0.5."""
    deviations = [abs(p - 0.5) for step in steps for p in step.probabilities.values()]
    return max(deviations, default=0.0)


@pytest.mark.parametrize("cue", [name for name in CUES if name in NONE_SEEN])
@settings(max_examples=15)
@given(at=st.integers(0, 30), many=st.integers(1, 9))
def test_detection_in_single_frame_leaves_probabilities_unchanged(
    cue: str, at: int, many: int
) -> None:
    light = [1] * 40
    counts = [dict(one.counts) for one in frames_of("traffic_light", light)]
    without = [FrameEvidence(i * STEP_NS, 1.0, 1e-4, (), c) for i, c in enumerate(counts)]
    false = dict(counts[at])
    false[cue] = many + false[cue]
    once = [*without]
    once[at] = replace(without[at], counts=false)

    assert fusion_steps(once)[-1].probabilities == fusion_steps(without)[-1].probabilities


@given(st.lists(st.integers(0, 1), min_size=8, max_size=40))
def test_cue_sends_no_message_until_seen_in_three_of_five_frames(positive: list[int]) -> None:
    steps = fusion_steps(frames_of("traffic_light", positive))

    for i, step in enumerate(steps):
        seen = sum(positive[max(0, i - 4) : i + 1])
        if positive[i] and seen < 3:
            assert step.not_believed == {"traffic_light": f"seen in {seen} of 3 frames needed"}
        else:
            assert not step.not_believed
    enough = any(
        positive[i] and sum(positive[max(0, i - 4) : i + 1]) >= 3 for i in range(len(positive))
    )
    assert (max_deviation(steps) > 0.0) == enough


# Messages of log 3 and log 9; distances fade over 10 m and times over 2 s.
HAND_GRAPH = FactorGraph(
    (Feature("left"), Feature("right")),
    (
        CueNode("road", 0.75, can_start=True, absence_counts=True, within_m=30.0),
        CueNode("traffic", 0.75, fade=Fade(time_s=2.0)),
        CueNode("arrow", 0.9, absence_counts=True, seen_frames=2, of_frames=3),
    ),
    (
        Edge("road", "left"),
        Edge("traffic", "left"),
        Edge("arrow", "right"),
        Edge("arrow", "left", False),
    ),
)
LOG_3 = math.log(3.0)
# Distance with a correlation of 1/3, after which a frame counts as half an independent one.
THIRD = 10.0 * LOG_3


def hand_messages(*situations: Situation) -> list[Any]:
    """Return the messages to left and right, with a dissent of 1/4."""
    model = PersistentMessageModel(HAND_GRAPH, 0.25)
    return [pytest.approx([one / LOG_3 for one in model(situation)]) for situation in situations]


def test_frames_count_as_fraction_of_independent_ones_and_dissent_likewise() -> None:
    """After two such distances, (1 - 1/9) / (1 + 1/9) = 4/5; positives and dissent are apart.

    A repeated picture and a frame far away or without the cue send nothing, but their distance
    counts.
    """

    def road(count: int, near: bool = True) -> Situation:
        return situation({"road": count}, near=near, moved_m=THIRD)

    repeated = situation({"road": 1}, new_picture=False, moved_m=THIRD)
    unseen = situation({}, moved_m=THIRD)
    assert hand_messages(road(1), road(1), road(0), road(1), road(0)) == [
        [1.0, 0.0],
        [0.5, 0.0],
        [-1.0, 0.0],
        [0.8, 0.0],
        [-0.8, 0.0],
    ]
    assert hand_messages(road(1), repeated, road(1)) == [[1.0, 0.0], [0.0, 0.0], [0.8, 0.0]]
    assert hand_messages(road(1), unseen, road(1)) == [[1.0, 0.0], [0.0, 0.0], [0.8, 0.0]]
    assert hand_messages(road(0), road(0, False), road(0)) == [[-1.0, 0.0], [0.0, 0.0], [-0.8, 0.0]]


def test_moving_objects_count_by_time() -> None:
    """A correlation of 1/3 over 2 log 3 s; the distance does not matter."""
    traffic = [
        situation({"traffic": 3}, moved_m=100.0, passed_s=LOG_3 * scale) for scale in (1, 2, 2)
    ]

    assert hand_messages(*traffic) == [[1.0, 0.0], [0.5, 0.0], [0.5, 0.0]]


def test_messages_of_several_cues_add_and_only_direct_edges_dissent() -> None:
    """9/10 is log 9 = 2 log 3, for right and against left."""
    every = {"road": 1, "traffic": 1, "arrow": 1}

    assert hand_messages(situation(every)) == [[0.0, 2.0]]
    assert hand_messages(situation(dict.fromkeys(every, 0), near=True)) == [[-1.0, -1.0]]


def test_cue_without_message_reports_reason_of_newest_frame() -> None:
    model = PersistentMessageModel(HAND_GRAPH, 0.25)
    far = replace(situation({"road": 1, "traffic": 0, "arrow": 0}), range_m=30.001)

    assert model.silent == {}
    assert model(far) == [0.0, 0.0]
    assert model.silent == {"road": "intersection further than 30 m"}
    shut = situation({"arrow": 1, "traffic": 0, "road": 1}, established=False)
    assert model(replace(shut, range_m=30.0)) == pytest.approx([LOG_3, 0.0])
    assert model.silent == {"arrow": "no intersection established"}
    assert model(situation({"arrow": 1}, new_picture=False)) == [0.0, 0.0]
    assert model.silent == {}


def test_cue_is_confirmed_by_two_of_three_new_pictures() -> None:
    """1 0 0 1 has one positive among the last three; 1 0 0 1 1 has two."""
    persistence = Persistence(HAND_GRAPH)
    seen = [
        persistence({"unknown": 1, "arrow": count}, is_new_picture=is_new)
        for count, is_new in ((1, True), (1, False), (0, True), (0, True), (1, True), (2, True))
    ]

    rare = Confirmed({}, {"arrow": "seen in 1 of 2 frames needed"})
    absent = Confirmed({"arrow": 0}, {})
    assert seen == [rare, rare, absent, absent, rare, Confirmed({"arrow": 2}, {})]
    persistence.restart()
    assert persistence({"arrow": 2}) == rare
    assert persistence({"road": 1, "arrow": 2}) == Confirmed({"road": 1, "arrow": 2}, {})


@given(frames=st.integers(2, 400), way_m=st.floats(0.0, 80.0))
def test_evidence_over_distance_is_bounded_for_any_number_of_frames(
    frames: int, way_m: float
) -> None:
    model = PersistentMessageModel(GRAPH, FUSION.dissent)
    place = GRAPH.feature_names.index("intersection")
    message = log_odds(FUSION.cues["traffic_light"].precision)

    total = sum(
        model(situation({"traffic_light": 1}, moved_m=way_m / frames))[place] for _ in range(frames)
    )

    # Continuous observation counts as half as many independent ones as there are fading lengths.
    assert message * (1.0 - 1e-9) <= total <= message * (1.0 + way_m / 20.0) + 1e-9


def test_continuous_cue_beyond_validated_range_reports_reason() -> None:
    far = RangePosterior(Reference.END, 130.0, 4.0, 130.0)
    frames = [
        replace(frame, posteriors=(far,)) for frame in frames_of("stop_sign", [1] * 8, step_m=0.1)
    ]

    steps = fusion_steps(frames)

    assert max_deviation(steps) == 0.0
    assert steps[-1].not_believed == {"stop_sign": "intersection further than 100 m"}


def test_cue_is_silent_in_approach_until_seen_in_three_pictures() -> None:
    """A repeated picture does not count, and cues past the intersection wait likewise.

    A frame without an approach has the reason, too, and a restart forgets.
    """
    fusion = Fusion.model_validate(
        {"kind": "persistent", "cues": {"stop_sign": {"seen_frames": 1}}}
    )
    loop = Approaches(graph_of(fusion), fusion, RangeFilter())
    frames = frames_of("traffic_light", [1, 1, 1, 1])
    frames[1] = replace(frames[1], is_new_picture=False)

    def past(_best: object, _reference: object) -> Mapping[str, int]:
        return {"lanes_past": 1}

    steps = [loop(frame, past) for frame in frames]
    loop.restart()
    again = loop(replace(frames[0], counts={"traffic_light": 1, "stop_sign": 1}), past)

    waits = {n: f"seen in {n} of 3 frames needed" for n in (1, 2)}
    assert [step.not_believed for step in steps] == [
        {"traffic_light": waits[1]},
        {"traffic_light": waits[1]},
        {"traffic_light": waits[2]},
        {"lanes_past": waits[1]},
    ]
    assert [step.approach for step in (*steps, again)] == [None, None, None, 1, 2]
    assert again.not_believed == {"traffic_light": waits[1], "lanes_past": waits[1]}
    assert loop.counts["traffic_light not believed: seen in 1 of 3 frames needed"] == 3
    assert loop.counts["lanes_past not believed: seen in 1 of 3 frames needed"] == 2


def test_each_approach_has_new_message_model_of_its_kind() -> None:
    rates = (Rates(cue="road_left", feature="left", near=False, if_there=0.6, if_not=0.1),)
    learned = {"kind": "calibrated", "calibrated": Calibrated(rates=rates)}
    away, road = replace(situation({"road_left": 0}), may_dissent=True), {"road_left": 1}
    place = GRAPH.feature_names.index("left")

    for changes, dissent, support in (
        ({"kind": "persistent", "dissent": 0.25}, -LOG_3, log_odds(0.77)),
        ({"kind": "source", "dissent": 0.25}, -LOG_3, log_odds(0.77)),
        ({"kind": None, "dissent": 0.25}, -LOG_3, log_odds(0.77)),
        (learned, math.log(0.4 / 0.9), math.log(6.0)),
    ):
        create = message_models_of(GRAPH, Fusion().model_copy(update=changes))
        for _ in range(2):
            assert create()(away)[place] == pytest.approx(dissent)
            assert create()(situation(road))[place] == pytest.approx(support)


@pytest.mark.parametrize(
    ("kind", "command"), [("calibrated", "messages"), ("temporal", "temporal")]
)
def test_kind_without_its_fit_is_refused(kind: str, command: str) -> None:
    fusion = Fusion().model_copy(update={"kind": kind})
    wanted = f"^fusion.{kind}: expected what crosscue fit {command} wrote, got None$"

    with pytest.raises(ValueError, match=wanted):
        Approaches(GRAPH, fusion, RangeFilter())


@pytest.mark.parametrize(
    ("kind", "expected"), [("source", "source"), ("persistent", "persistent"), (None, None)]
)
def test_default_fusion_kind_is_source_only_for_simulated_car(
    kind: str | None, expected: str | None
) -> None:
    given_kind: Mapping[str, object] = {} if kind is None else {"fusion": {"kind": kind}}

    real = Vehicle.model_validate({"version": 1, "name": "Golf", **given_kind})
    simulated = Vehicle.model_validate({"version": 1, "name": SIMULATED_CAR, **given_kind})

    assert real.fusion.kind == (expected or "persistent")
    assert simulated.fusion.kind == (expected or "source")


def test_source_kind_counts_every_frame_and_detection() -> None:
    model = message_models_of(GRAPH, Fusion(kind="source"))()
    place = GRAPH.feature_names.index("left")
    counts = {"cross_traffic_left": 2}

    total = sum(model(situation(counts, new_picture=False, moved_m=0.0))[place] for _ in range(7))

    assert total == pytest.approx(7 * 2 * log_odds(0.86))


def test_light_alone_gives_no_more_than_its_limit_until_another_cue_speaks() -> None:
    """A light of 9/10 over many independent frames, at most 19/20, then with a road of 3/4."""
    model = PersistentMessageModel(
        FactorGraph(
            (Feature("intersection"), Feature("left")),
            (
                CueNode("light", 0.9, can_start=True, at_most=0.95),
                CueNode("road", 0.75, can_start=True),
            ),
            (Edge("light", "intersection"), Edge("road", "left")),
        ),
        0.49,
    )
    alone = [model(situation({"light": 1}, moved_m=1e6))[0] for _ in range(20)]
    both = model(situation({"light": 1, "road": 1}, moved_m=1e6))

    assert sum(alone) == pytest.approx(math.log(19.0))
    assert alone[0] == pytest.approx(math.log(9.0))
    assert sum(alone) + both[0] == pytest.approx(21.0 * math.log(9.0))
    assert both[1] == pytest.approx(LOG_3)


def test_real_light_is_believed_but_certain_only_with_a_road_or_traffic() -> None:
    light = frames_of("traffic_light", [1] * 60)
    crossing = frames_of("cross_traffic_left", [1] * 10, begin=60)
    steps = fusion_steps([*light, *crossing])
    signs = fusion_steps(frames_of("stop_sign", [1] * 60))

    assert steps[59].probabilities["intersection"] == pytest.approx(0.95)
    assert steps[59].established
    assert steps[-1].probabilities["intersection"] > 0.99
    assert signs[-1].probabilities["intersection"] > 0.99


def shape_of(seen: Mapping[int, float], frames: int, travelled_m: float | None) -> list[Step]:
    """Belief with a road to the left in some frames, by its log odds; the others show none."""
    fusion = Vehicle(version=1).fusion
    message = log_odds(fusion.cues["road_left"].precision)
    evidence = [
        replace(
            FrameEvidence(i * STEP_NS, travelled_m, 0.0, (), {"road_left": 1} if i in seen else {}),
            weights={"road_left": seen[i] / message} if i in seen else {},
        )
        for i in range(frames)
    ]
    return fusion_steps(evidence, fusion)


@pytest.mark.parametrize("odds", [2.0, 2.5, 6.0])
def test_cue_says_as_much_as_it_is_worth(odds: float) -> None:
    """One message of 0.9 would never exceed 0.9, however sure the network is."""
    for step in shape_of({3: odds}, 5, None)[3:]:
        for feature in ("left", "intersection"):
            assert step.probabilities[feature] == pytest.approx(1.0 / (1.0 + math.exp(-odds)))
        assert step.probabilities["right"] == 0.5


def test_views_over_time_add_up_without_motion_and_none_while_standing() -> None:
    moving, standing = (shape_of(dict.fromkeys(range(20), 2.1), 20, way_m) for way_m in (None, 0.0))
    left = [step.probabilities["left"] for step in moving]
    assert left[0] < 0.9 < left[2] < left[-1]
    assert left == sorted(left)
    assert [step.probabilities["left"] for step in standing] == pytest.approx([left[0]] * 20)


def test_surer_look_from_the_same_place_counts_up_to_what_it_says() -> None:
    """A car stops, and a lorry drives out of the view: the street behind it is seen better."""
    seen = [2.1, 3.0, 4.0, 2.5, 4.0, 3.9, 4.0]
    steps = shape_of(dict(enumerate(seen)), len(seen), 0.0)
    believed = [log_odds(step.probabilities["left"]) for step in steps]
    assert believed == pytest.approx([2.1, 3.0, 4.0, 4.0, 4.0, 4.0, 4.0])


def test_what_establishes_the_intersection_comes_first_within_a_frame() -> None:
    """A camera of one picture a second sees the road ahead and the side street once, together."""
    fusion = Vehicle(version=1).fusion
    counts = {"road_left": 1, "road_straight": 1}
    sure = {"road_left": 1.5, "road_straight": 1.5}
    both, ahead_only, unsure = (
        fusion_steps([replace(FrameEvidence(0, None, 0.0, (), counts), weights=weights)], fusion)
        for counts, weights in (
            (counts, sure),
            ({"road_straight": 1}, sure),
            (counts, sure | {"road_left": 0.9}),
        )
    )
    message = log_odds(fusion.cues["road_straight"].precision)
    assert log_odds(both[0].probabilities["straight"]) == pytest.approx(1.5 * message)
    assert not both[0].not_believed
    assert ahead_only[0].approach is None
    assert unsure[0].probabilities["straight"] == 0.5
    assert unsure[0].not_believed == {"road_straight": "no intersection established"}
