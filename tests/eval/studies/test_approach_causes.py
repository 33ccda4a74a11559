"""Causes of failed approaches, and effects of conditions at the same intersection."""

from dataclasses import replace

import numpy as np
import pytest

from crosscue.eval.failures.causes import Finding, approach_findings
from crosscue.eval.scoring.scene.approaches import ApproachResult
from crosscue.eval.scoring.scene.cues import CueFrames
from crosscue.eval.studies.intersections.report import condition_costs

FRAMES = 40
DISTANCE_M = np.linspace(90.0, 0.0, FRAMES)
FAR = int((DISTANCE_M >= 8.0).sum())


def _result(**changes: object) -> ApproachResult:
    usual = ApproachResult(
        drive="runs/X-01",
        approach=0,
        intersection="X",
        control="stop_sign",
        conditions=("dusk",),
        present=("intersection", "left"),
        run_approach=1,
        overlap_s=4.0,
        splits=0,
        steps=FRAMES,
        detected_m=40.0,
        full_m=30.0,
        why_not_detected="",
        why_not_full="",
        spurious_m=None,
        why_spurious="",
        features_m={"intersection": 40.0, "left": 30.0},
        false_features=(),
        at_entering={},
    )
    return replace(usual, **changes)  # type: ignore[arg-type]


def _cue(
    cue: str, *, positives: int = 0, objects: int = 0, visible: float = 1.0, approach: int = 0
) -> CueFrames:
    """Build frames of a cue with objects and positives in the first frames."""
    first = np.arange(FRAMES)
    return CueFrames(
        drive="runs/X-01",
        cue=cue,
        t_ns=first.astype(np.int64),
        count=(first < positives).astype(np.int64),
        approach=np.full(FRAMES, approach, np.int64),
        distance_m=DISTANCE_M,
        is_object=(first < objects).astype(np.int8),
        is_feature=np.ones(FRAMES, np.int8),
        true_count=np.ones(FRAMES, np.int64),
        visible=np.full(FRAMES, visible),
        frames=FRAMES,
        moments_unmatched=0,
        left_out={"object": {}, "feature": {}},
        conditions={0: ("dusk",)},
    )


def _found(result: ApproachResult, *cues: CueFrames) -> list[Finding]:
    return approach_findings(result, cues)


NO_LEFT = _result(features_m={"intersection": 40.0, "left": None}, full_m=None)


def test_feature_established_only_at_intersection_is_late() -> None:
    (one,) = _found(_result(features_m={"intersection": 40.0, "left": 5.0}), _cue("road_left"))

    assert (one.failing, one.at_m, one.feature) == ("late", 5.0, "left")
    assert one.conditions == ("dusk",)


SEEN = {"objects": 30, "positives": 4}


@pytest.mark.parametrize(
    ("cues", "cause", "reported"),
    [
        ((_cue("road_left", **SEEN), _cue("parked_left", objects=10)), "not found", "4 of 40"),
        ((_cue("road_left", **SEEN),), "not found", "road left 4/30"),
        ((_cue("road_left"), _cue("parked_left", objects=10)), "not found", "parked left 0/10"),
        (
            (_cue("road_left", **SEEN), _cue("one_way_right", positives=9)),
            "denied",
            "one way right",
        ),
        ((_cue("road_left", objects=30, visible=0.4),), "hidden", "30 frames"),
        ((_cue("road_left", objects=30, positives=25),), "too little", ""),
    ],
)
def test_missing_feature_has_a_cause(
    cues: tuple[CueFrames, ...], cause: str, reported: str
) -> None:
    (one,) = approach_findings(NO_LEFT, cues)

    assert one.cause == cause
    assert reported in one.reported


def test_road_found_before_presence_is_established_waits_for_presence() -> None:
    result = _result(features_m={"intersection": None, "left": None}, detected_m=None)
    cues = _cue("road_left", objects=30, positives=25), _cue("stop_sign", objects=30, positives=2)
    one, other = _found(result, *cues)

    assert (one.feature, one.cause) == ("intersection", "not found")
    assert (other.feature, other.cause) == ("left", "waited for presence")


def test_invented_feature_names_cues_that_support_it() -> None:
    result = _result(false_features=("straight",))
    (one,) = _found(result, _cue("road_straight", positives=12), _cue("lanes_past", positives=1))

    assert (one.failing, one.cause) == ("invented", "claimed wrongly")
    assert one.reported == f"road straight in 12 of {FAR}, lanes past in 1 of {FAR}"
    assert one.at_m == pytest.approx(90.0)


def test_permanent_condition_of_intersection_does_not_exclude_good_runs() -> None:
    runs = [
        _result(conditions=("clear", "occluded"), detected_m=30.0),
        _result(conditions=("dusk", "occluded"), detected_m=20.0),
    ]
    (cost,) = condition_costs(runs)

    assert cost["condition"] == "dusk"
    assert cost["detected_m"]["value"] == pytest.approx(-10.0)
