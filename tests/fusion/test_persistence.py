"""Tests of persistence: single and repeated frames do not count, lasting cues count a few times."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crosscue.fusion.approaches import Approaches, Step, message_models_of
from crosscue.fusion.evidence import FrameEvidence, RangePosterior
from crosscue.fusion.factor_graph import graph_of, log_odds
from crosscue.fusion.intersection_range import Reference
from crosscue.fusion.persistence import Persistence, PersistentMessageModel
from crosscue.replay.vehicle.fusion import Fusion, RangeFilter
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


@given(copies=st.integers(0, 50), seconds=st.floats(0.01, 10.0), cue=st.sampled_from(CUES))
def test_copies_of_frame_send_zero_messages(copies: int, seconds: float, cue: str) -> None:
    once, again = (PersistentMessageModel(GRAPH, FUSION.dissent) for _ in range(2))
    first = situation({cue: 3}, passed_s=seconds)
    copy = situation({cue: 3}, new_picture=False, passed_s=seconds)

    messages = once(first)

    assert again(first) == messages
    for _ in range(copies):
        assert again(copy) == [0.0] * len(messages)


@given(copies=st.integers(1, 20))
def test_copies_of_frame_do_not_confirm_cue(copies: int) -> None:
    persistence = Persistence(GRAPH)

    persistence({"stop_sign": 1})
    for _ in range(copies):
        observed = persistence({"stop_sign": 1}, is_new_picture=False)

    assert observed.silent == {"stop_sign": "seen in 1 of 3 frames needed"}
    assert observed.counts == {}


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


@given(many=st.integers(1, 20), cue=st.sampled_from(CUES))
def test_several_detections_in_frame_count_as_one(many: int, cue: str) -> None:
    one, all_of_them = (PersistentMessageModel(GRAPH, FUSION.dissent) for _ in range(2))

    assert one(situation({cue: 1})) == all_of_them(situation({cue: many}))


@given(over_m=st.floats(0.1, 300.0), cue=st.sampled_from(CUES))
def test_cue_sends_no_message_beyond_validated_range(over_m: float, cue: str) -> None:
    model = PersistentMessageModel(GRAPH, FUSION.dissent)
    limit_m = FUSION.cues[cue].within_m

    far = replace(situation({cue: 1}), range_m=limit_m + over_m)
    assert model(far) == [0.0] * len(GRAPH.features)
    assert model.silent == {cue: f"intersection further than {limit_m:g} m"}
    assert any(model(replace(far, range_m=limit_m)))


def test_continuous_cue_beyond_validated_range_reports_reason() -> None:
    far = RangePosterior(Reference.END, 130.0, 4.0, 130.0)
    frames = [
        replace(frame, posteriors=(far,)) for frame in frames_of("stop_sign", [1] * 8, step_m=0.0)
    ]

    steps = fusion_steps(frames)

    assert max_deviation(steps) == 0.0
    assert steps[-1].not_believed == {"stop_sign": "intersection further than 100 m"}


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
