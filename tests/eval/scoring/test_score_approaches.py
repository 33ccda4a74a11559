"""Approaches, belief and range against truth, on drives small enough to check by hand."""

import math
from dataclasses import replace
from typing import Literal

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crosscue.eval.scoring.columns import RunTables
from crosscue.eval.scoring.drives import score_drive
from crosscue.eval.scoring.run_tables import run_tables
from crosscue.eval.scoring.scene.approaches import (
    ApproachesJudged,
    associate,
    judge_approaches,
    score_approaches,
)
from crosscue.eval.scoring.scene.belief import (
    CLIP,
    brier,
    compare_belief,
    judge_belief,
    log_score,
    reliability_bins,
    score_belief,
)
from crosscue.eval.scoring.scene.detection import Definition
from crosscue.eval.scoring.scene.ranges import judge_range, score_range
from crosscue.eval.scoring.truth import DriveTruth
from support.scoring import (
    BELIEF,
    approach,
    at,
    belief_table,
    good_tables,
    good_truth,
    range_table,
    tables,
    true_ranges,
    truth,
)


def judged_of(
    run: RunTables, reported: DriveTruth, definition: Definition = "confirmed"
) -> ApproachesJudged:
    judged = judge_approaches(run, reported, definition=definition)
    assert judged is not None
    return judged


def test_detection_distance_is_at_first_step_above_threshold() -> None:
    judged = judged_of(good_tables(), good_truth())
    (one,) = judged.results

    # p(intersection) is 0.95 from frame 10 on (30 m), ranges are from frame 8 on; right is at 15 m.
    assert one.detected_m == pytest.approx(30.0)
    assert one.full_m == pytest.approx(15.0)
    assert one.features_m["left"] == pytest.approx(20.0)
    assert one.false_features == ()
    assert one.at_entering["straight"] == 0.2
    assert one.run_approach == 7
    assert len(judged.curves[0].t_ns) == 40


def test_feature_without_evidence_is_not_seen_rather_than_improbable() -> None:
    steps = {**BELIEF, "left": dict.fromkeys(range(45), 0.5)}
    steps["right"] = {frame: 0.5 + 0.001 * frame for frame in range(45)}
    judged = judged_of(tables(belief=belief_table(steps)), truth())
    assert judged.results[0].why_not_full == "never probable enough: right; not seen: left"


@pytest.mark.parametrize(
    ("cues", "detected", "full"),
    [
        ({"road_left": {0: 0}}, "not looked for", "not looked for: intersection, right"),
        ({"stop_sign": {0: 0}}, "never probable enough", "not seen: intersection"),
        ({"own": {0: 0}}, "never probable enough", "not seen: intersection, right"),
        ({}, "not looked for", "not looked for: intersection, right"),
        (None, "never probable enough", "not seen: intersection, right"),
    ],
)
def test_feature_without_evaluated_cue_is_reported_as_not_looked_for(
    cues: dict[str, dict[int, int]] | None, detected: str, full: str
) -> None:
    steps = {**BELIEF, "intersection": {}, "right": {}}
    judged = score_drive(tables(cues, belief_table(steps)), truth()).approaches

    assert judged is not None
    assert judged.results[0].why_not_detected == detected
    assert judged.results[0].why_not_full.startswith(full)


def test_intersection_is_not_detected_before_it_has_range() -> None:
    late = tables(belief=belief_table(BELIEF), ranges=range_table(22, 45))
    never = tables(belief=belief_table(BELIEF))

    for run, distance_m, why in ((late, 18.0, ""), (never, None, "no range")):
        judged = judged_of(run, truth())
        assert judged.results[0].detected_m == distance_m
        assert judged.results[0].why_not_detected == why
        # Full detection needs no range, as for the dissertation's intersection H.
        assert judged.results[0].full_m == 15.0


CHANGES = st.dictionaries(st.integers(0, 44), st.sampled_from([0.05, 0.6, 0.95]), max_size=6)


@given(st.fixed_dictionaries(dict.fromkeys(BELIEF, CHANGES)), st.integers(0, 44))
@settings(max_examples=60)
def test_full_detection_never_precedes_detection(
    changes: dict[str, dict[int, float]], ranged_from: int
) -> None:
    run = tables(belief=belief_table(changes), ranges=range_table(ranged_from, 45))
    judged = judged_of(run, truth())

    for one in judged.results:
        if one.detected_m is not None and one.full_m is not None:
            assert one.full_m <= one.detected_m


def test_full_detection_waits_for_range_unless_scored_as_published() -> None:
    run = tables(belief=belief_table(BELIEF), ranges=range_table(30, 45))

    cases: list[tuple[Definition, float]] = [("confirmed", 10.0), ("published", 15.0)]
    for definition, full_m in cases:
        judged = judged_of(run, truth(), definition=definition)
        assert (judged.results[0].detected_m, judged.results[0].full_m) == (10.0, full_m)


@pytest.mark.parametrize(("control", "full_m"), [("none", 15.0), ("stop_sign", None)])
def test_full_detection_requires_intersection_feature_only_with_sign_or_light(
    control: Literal["none", "stop_sign"], full_m: float | None
) -> None:
    roads_only = {name: changes for name, changes in BELIEF.items() if name != "intersection"}
    without_intersection = belief_table({"intersection": {}, **roads_only})
    reported = truth()
    (one,) = reported.truth.approaches
    approaches = (one.model_copy(update={"control": control}),)
    reported = replace(reported, truth=reported.truth.model_copy(update={"approaches": approaches}))

    judged = judged_of(tables(belief=without_intersection, ranges=range_table(8, 45)), reported)
    (result,) = judged.results
    assert result.detected_m is None
    assert result.full_m == full_m


def test_spike_of_one_frame_is_spurious_unless_scored_as_published() -> None:
    spike = {**BELIEF, "intersection": {4: 0.95, 5: 0.5, 20: 0.95}}
    run = tables(belief=belief_table(spike), ranges=range_table(0, 45))

    cases: list[tuple[Definition, float, float | None]] = [
        ("confirmed", 20.0, 36.0),
        ("published", 36.0, None),
    ]
    for definition, detected_m, spurious_m in cases:
        judged = judged_of(run, truth(), definition=definition)
        (one,) = judged.results
        assert (one.detected_m, one.spurious_m) == (detected_m, spurious_m)
        assert one.why_spurious == ("for fewer than 3 frames" if spurious_m else "")


def test_range_outside_its_interval_is_not_a_detection() -> None:
    for error_m, var_m2, detected_m in (
        (100.0, 1.0, None),
        (1.9, 1.0, 30.0),
        (2.0, 1.0, None),
        (100.0, 60.0**2, 30.0),
    ):
        ranges = range_table(8, 45, error_m, var_m2)
        judged = judged_of(tables(belief=belief_table(BELIEF), ranges=ranges), truth())
        (one,) = judged.results
        assert one.detected_m == detected_m
        assert one.spurious_m == (30.0 if detected_m is None else None)
        assert one.why_not_detected == ("" if detected_m else "range outside its 95 % interval")


def test_failures_are_excluded_from_means_and_named() -> None:
    good = judged_of(good_tables(), good_truth())
    bad = judged_of(tables(belief=belief_table({"intersection": {5: 0.95}})), truth())
    score = score_approaches([good, bad])

    assert score is not None
    assert score.full_m.value == 15.0
    assert (score.full_m.of, score.full.right, score.full.of) == (1, 1, 2)
    assert score.failures == {
        "detected": {"no range": 1},
        "full": {"never probable enough: left, right": 1},
    }
    assert score.by_intersection["A"].approaches == 2
    assert score.by_condition["rain"].full == 1


def test_approaches_are_associated_one_to_one_by_overlap() -> None:
    first = approach(id=1, start_ns=at(0), enter_ns=at(10))
    second = approach(id=2, start_ns=at(10), enter_ns=at(30))
    spans = {5: (at(2), at(25)), 6: (at(8), at(12)), 9: (at(40), at(50))}

    # 5 shares 8 frames with the first and 15 with the second; 6 shares 2 and 2.
    assert associate([first, second], spans) == {2: 5, 1: 6}
    assert associate([first, second], {}) == {}


def test_extra_and_split_approaches_are_counted() -> None:
    far = approach(start_ns=at(20), enter_ns=at(40))
    pieces = [
        belief_table({"intersection": {2: 0.95}}, 1, range(10)),
        belief_table(BELIEF, 2, range(20, 30)),
        belief_table(BELIEF, 3, range(30, 45)),
        belief_table({**BELIEF, "intersection": {70: 0.95}}, 4, range(70, 75)),
    ]
    joined = pa.concat_tables([p.select(["t_ns", "approach", "intersection"]) for p in pieces])
    judged = judged_of(run_tables("made up", {"belief": joined}), truth([], [far]))
    assert (judged.extra, judged.extra_detected, judged.not_judged) == (1, 1, 1)
    assert judged.results[0].splits == 1


def test_brier_and_log_score_computed_by_hand() -> None:
    p, is_present = np.array([0.5, 0.9, 1.0, 0.0]), np.array([True, True, True, True])

    assert brier(p, is_present) == pytest.approx([0.25, 0.01, 0.0, 1.0])
    assert log_score(p, is_present) == pytest.approx(
        [math.log(2), -math.log(0.9), 1e-6, -math.log(CLIP)]
    )
    assert log_score(1.0 - p, ~is_present) == pytest.approx(log_score(p, is_present), rel=1e-6)


def test_reliability_of_calibrated_belief_is_on_diagonal() -> None:
    rng = np.random.default_rng(5)
    p = rng.uniform(0.0, 1.0, 20000)
    bins = reliability_bins(p, rng.uniform(0.0, 1.0, 20000) < p, np.arange(20000) % 20)

    assert len(bins) == 10
    assert sum(one.steps for one in bins) == 20000
    inside = [one.there.low <= one.mean_probability <= one.there.high for one in bins]
    assert sum(inside) >= 8


def test_belief_comparison_is_decided_only_over_enough_drives() -> None:
    good, poor = {"intersection": {5: 0.95}}, {"intersection": {5: 0.6}}
    drives = [truth(drive=f"drive {i}") for i in range(8)]
    first = [
        one for drive in drives for one in judge_belief(tables(belief=belief_table(poor)), drive)
    ]
    second = [
        one for drive in drives for one in judge_belief(tables(belief=belief_table(good)), drive)
    ]

    found = compare_belief(first, second)["intersection"]
    assert (found.verdict, found.steps, found.only_first) == ("second", 8 * 40, 0)
    assert found.brier.value == pytest.approx(35 * (0.05**2 - 0.4**2) / 40)
    assert compare_belief(second, first)["intersection"].verdict == "first"
    assert compare_belief(first[:1], second[:1])["intersection"].verdict == "undecided"


def test_range_errors_and_nees_are_scored_by_reference() -> None:
    both = pa.concat_tables(
        [range_table(0, 40, 0.5, 0.25), range_table(20, 45, -2.0, 1.0, reference="end")]
    )
    scores = score_range(judge_range(tables(ranges=both), truth()))

    assert scores["start"].rmse_m == pytest.approx(0.5)
    assert scores["start"].nees.mean == pytest.approx(1.0)
    assert scores["end"].bias_m.value == pytest.approx(-2.0)
    assert scores["end"].left_out == {"in the intersection": 5}
    assert scores["end"].nees.fraction_inside_95 == 0.0
    assert scores["start"].by_distance["0-10"].rows == 9


def test_true_ranges_are_interpolated_only_near_rows() -> None:
    ranges = true_ranges([approach()])
    times = np.array([at(10) + 50_000_000, at(39) + 50_000_000, at(39) + 600_000_000], np.int64)
    start, end = ranges.at(times, np.zeros(3, np.int64))

    assert start[:2] == pytest.approx([29.5, 0.5])
    assert end[0] == pytest.approx(39.5)
    assert math.isnan(start[2])


def test_nan_values_are_excluded_and_counted() -> None:
    broken = tables(
        belief=belief_table({"intersection": {10: 0.95, 12: math.nan, 13: 0.95}, "left": {}}),
        ranges=range_table(8, 45, math.nan),
    )
    judged = judged_of(broken, truth())

    assert judged.rows_not_numbers == 1
    assert score_belief(judge_belief(broken, truth()))["intersection"].left_out["not a number"] == 1
    assert score_range(judge_range(broken, truth()))["start"].left_out == {"not a number": 37}
    # A range that is not a number is not a range.
    assert judged.results[0].why_not_detected == "no range"
