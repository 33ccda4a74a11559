"""Cues against truth: hand-counted precision, recall and coverage; intervals against scipy."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import binomtest

from crosscue.eval.scoring.intervals import fraction, wilson
from crosscue.eval.scoring.run_tables import run_tables
from crosscue.eval.scoring.scene.cues import match_cues, score_cues
from support.scoring import (
    ENTER,
    approach,
    at,
    cue_table,
    good_tables,
    good_truth,
    span,
    tables,
    truth,
)


@given(st.integers(0, 400), st.integers(1, 400), st.sampled_from([0.8, 0.95, 0.99]))
@settings(max_examples=50)
def test_wilson_interval_equals_scipy(right: int, more: int, confidence: float) -> None:
    theirs = binomtest(right, right + more).proportion_ci(confidence, "wilson")
    ours = wilson(right, right + more, confidence)

    assert ours.low == pytest.approx(theirs.low, abs=1e-12)
    assert ours.high == pytest.approx(theirs.high, abs=1e-12)


def test_wilson_interval_is_nan_without_data_and_refuses_impossible_counts() -> None:
    assert np.isnan(wilson(0, 0)).all()
    with pytest.raises(ValueError, match="expected 0 to 3, got 4"):
        wilson(4, 3)


def test_repeated_frames_narrow_wilson_interval_but_not_interval_over_drives() -> None:
    right = np.array([True, True, False, True, False, True])
    drives = np.arange(6)
    few = fraction(right, drives)
    many = fraction(np.repeat(right, 100), np.repeat(drives, 100))

    assert many.high - many.low < 0.2 * (few.high - few.low)
    assert many.clusters_high - many.clusters_low == few.clusters_high - few.clusters_low > 0.3


def test_cue_scores_equal_those_counted_by_hand() -> None:
    score = score_cues(match_cues(good_tables(), good_truth()))["stop_sign"]
    objects = score.readings["object"]

    # The sign is present in frames 5 to 39, found in 10 to 39; frames 40 to 49 are past it.
    assert (objects.frames, objects.scored, objects.with_truth) == (50, 40, 40)
    assert objects.left_out == {"in the intersection": 10}
    assert (score.precision.right, score.precision.of) == (30, 30)
    assert score.recall is not None
    assert (score.recall.right, score.recall.of) == (30, 35)
    assert (score.things.reported, score.things.true, score.things.matched) == (30, 35, 30)
    assert objects.by_distance["0-10"].precision.of == 9
    assert objects.by_distance["30-40"].precision.of == 1
    assert objects.by_condition["rain"].frames == 40
    assert score.reading == "object"
    assert score.is_sources_reading


def test_object_and_feature_readings_differ_for_closed_road() -> None:
    one = approach(features={"left": False, "right": True, "straight": False}, one_way="right")
    drive = truth([span("road_left", 0, 40), span("one_way_right", 0, 40, present=False)], [one])
    scores = score_cues(
        match_cues(tables({"road_left": {5: 1, 6: 1}, "one_way_right": {7: 1}}), drive)
    )

    road, sign = scores["road_left"].readings, scores["one_way_right"].readings
    assert road["object"].precision.value == 1.0
    assert road["feature"].precision.value == 0.0
    # There is no such sign, but its feature is true.
    assert sign["object"].precision.value == 0.0
    assert sign["feature"].precision.value == 1.0


def test_hidden_objects_do_not_count_in_visible_recall() -> None:
    drive = truth(
        [
            span("parked_left", 0, 10, visible=0.2, count=2),
            span("parked_left", 10, 20, visible=0.8, count=2),
        ]
    )
    found = {"parked_left": {frame: int(frame >= 10) for frame in range(20)}}
    score = score_cues(match_cues(tables(found), drive))["parked_left"].readings["object"]

    assert score.recall is not None
    assert score.recall_seen is not None
    assert (score.recall.value, score.recall_seen.value) == (0.5, 1.0)


@settings(max_examples=30)
@given(st.dictionaries(st.integers(0, 55), st.integers(0, 3), min_size=1))
def test_order_of_rows_does_not_matter(frames: dict[int, int]) -> None:
    table = cue_table({"stop_sign": frames, "road_left": frames})
    order = np.random.default_rng(len(frames)).permutation(table.num_rows)
    shuffled = run_tables("made up", {"cues": table.take(order)})

    first = score_cues(match_cues(run_tables("made up", {"cues": table}), good_truth()))
    second = score_cues(match_cues(shuffled, good_truth()))
    assert repr(first) == repr(second)


SPANS = st.lists(
    st.tuples(st.integers(0, 39), st.integers(1, 15), st.booleans()), min_size=1, max_size=4
)


@given(SPANS, st.dictionaries(st.integers(0, 59), st.integers(0, 2), min_size=1))
@settings(max_examples=60)
def test_cue_scores_equal_count_frame_by_frame(
    spans: list[tuple[int, int, bool]], found: dict[int, int]
) -> None:
    stated = [span("stop_sign", first, first + length, there) for first, length, there in spans]
    score = score_cues(match_cues(tables({"stop_sign": found}), truth(stated)))["stop_sign"]

    positives = rights = theres = hits = 0
    for frame, count in found.items():
        truths = [there for first, length, there in spans if first <= frame < first + length]
        if truths:
            positives += count > 0
            rights += count > 0 and any(truths)
            theres += any(truths)
            hits += any(truths) and count > 0
    objects = score.readings["object"]
    assert objects.recall is not None
    assert (objects.positives, objects.precision.right) == (positives, rights)
    assert (objects.recall.of, objects.recall.right) == (theres, hits)
    features = score.readings["feature"]
    assert features.precision.right == sum(n > 0 for frame, n in found.items() if frame < ENTER)
    assert features.precision.of == features.precision.right


def test_scores_by_distance_sum_up_and_conditions_follow_approach() -> None:
    wet = approach(id=1, conditions=("rain", "dusk"), start_ns=at(0), enter_ns=at(20))
    dry = approach(id=2, conditions=(), start_ns=at(130), enter_ns=at(150))
    drive = truth(
        [span("stop_sign", 0, 20), span("stop_sign", 130, 150, False)], [wet, dry], end=160
    )
    found = {"stop_sign": dict.fromkeys(range(160), 1)}
    score = score_cues(match_cues(tables(found), drive))["stop_sign"].readings["object"]

    assert sum(part.frames for part in score.by_distance.values()) == score.scored == 40
    assert {
        tag: (part.frames, part.precision.value) for tag, part in score.by_condition.items()
    } == {"rain": (20, 1.0), "dusk": (20, 1.0), "no tag": (20, 0.0)}
    assert set(score.by_distance) == {"0-10", "10-20", "20-30"}
