"""Tests of approaches: opening and closing, the gate, dissent, and rejected evidence."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import replace

import numpy as np
import pytest

from crosscue.fusion.approaches import Approaches, Step, no_past_cues
from crosscue.fusion.evidence import FrameEvidence, PastCues
from crosscue.fusion.factor_graph import graph_of
from crosscue.fusion.intersection_range import RangeBelief, Reference
from crosscue.replay.vehicle.fusion import Fusion, RangeFilter
from support.fusion import NONE_SEEN, SECOND_NS, drive, light, sign

FRAME_NS = SECOND_NS // 10
DISSERTATION_FILTER = RangeFilter(sd_fraction=0.0, fade_m=0.0, begin_after=1)
"""Range filter of the dissertation, whose results can be computed by hand."""


def approaches(
    fusion: Fusion | None = None, range_filter: RangeFilter = DISSERTATION_FILTER
) -> Approaches:
    fusion = fusion or Fusion()
    return Approaches(graph_of(fusion), fusion, range_filter)


def run_steps(
    evidence: Iterable[FrameEvidence], loop: Approaches | None = None, past: PastCues = no_past_cues
) -> list[Step]:
    loop = loop or approaches()
    return [loop(one, past) for one in evidence]


def standing_frames(many: int, from_ns: int, **counts: int) -> list[FrameEvidence]:
    seen = {**NONE_SEEN, **counts}
    return [FrameEvidence(from_ns + i * FRAME_NS, 0.0, 0.0, (), seen) for i in range(many)]


def frame(i: int, travelled_m: float | None = 1.0, **counts: int) -> FrameEvidence:
    return FrameEvidence(i * FRAME_NS, travelled_m, 1e-4, (), {**NONE_SEEN, **counts})


def test_drive_past_one_intersection_is_one_approach() -> None:
    loop = approaches()

    taken = run_steps(drive(90.0, -40.0, {"stop_sign": (60.0, 1), "road_left": (25.0, 1)}), loop)

    open_for = [one for one in taken if one.approach is not None]
    assert {one.approach for one in open_for} == {1}
    assert len(open_for) == 60 + 17 + 1
    assert open_for[-1].probabilities["left"] > 0.9
    assert loop.counts == {
        "approaches opened": 1,
        "approaches established": 1,
        "approaches closed: passed": 1,
    }


def test_sign_seen_once_opens_approach_without_range() -> None:
    loop = approaches(range_filter=RangeFilter())
    once = replace(frame(1, stop_sign=1), signs=(sign(60.0),))
    taken = run_steps([frame(0), once, *(frame(i) for i in range(2, 40))], loop)

    assert taken[1].approach == 1
    assert not any(step.ranges for step in taken)
    assert loop.counts["ranges waiting for a second observation"] == 1


def test_approaches_are_numbered_and_start_from_fresh_belief() -> None:
    loop, taken = approaches(), list[Step]()
    for i, side in enumerate(("road_left", "road_right", "road_left")):
        seen = {"stop_sign": (60.0, 1), side: (25.0, 1)}
        taken += run_steps(drive(70.0, -30.0, seen, begin_ns=i * 1000 * SECOND_NS), loop)

    last = {one.approach: one.probabilities for one in taken if one.approach is not None}
    assert list(last) == [1, 2, 3]
    assert [last[i]["left"] > 0.9 for i in (1, 2, 3)] == [True, False, True]
    assert [last[i]["right"] > 0.9 for i in (1, 2, 3)] == [False, True, False]


def test_stationary_car_keeps_approach_and_belief() -> None:
    loop = approaches()
    before = run_steps(drive(60.0, 2.0, {"stop_sign": (60.0, 1), "road_left": (25.0, 1)}), loop)[-1]

    after = run_steps(standing_frames(3000, 100 * SECOND_NS), loop)[-1]

    assert after.approach == before.approach == 1
    assert after.ranges == tuple(replace(row, measured_m=None) for row in before.ranges)
    assert after.probabilities["left"] == pytest.approx(before.probabilities["left"], rel=0.02)


def test_crawling_car_keeps_one_approach_until_passed() -> None:
    slow = run_steps(drive(40.0, -20.0, {"stop_sign": (40.0, 1)}, step_m=0.02))

    numbers = {one.approach for one in slow if one.approach is not None}
    assert numbers == {1}
    assert slow[-1].approach is None
    assert max(p for one in slow for p in one.probabilities.values()) < 1.0


def test_reversing_and_returning_car_stays_on_same_approach() -> None:
    loop = approaches()
    there = list(drive(40.0, 10.0, {"stop_sign": (40.0, 1)}))
    back = [frame(100 + i, -1.0) for i in range(10)]
    again = [frame(200 + i, 1.0) for i in range(10)]

    run_steps(there, loop)
    furthest = run_steps(back, loop)[-1]
    nearest = run_steps(again, loop)[-1]

    assert furthest.ranges[0].range_m == pytest.approx(20.0)
    assert nearest.ranges[0].range_m == pytest.approx(10.0)
    assert nearest.approach == 1


def test_reversing_out_of_reach_closes_approach() -> None:
    loop = approaches()
    run_steps(drive(40.0, 10.0, {"stop_sign": (40.0, 1)}), loop)

    run_steps([frame(100 + i, -5.0, stop_sign=1) for i in range(40)], loop)

    assert loop.counts["approaches closed: out of reach"] == 1


def test_turn_closes_approach_without_range() -> None:
    loop = approaches()
    run_steps([frame(i, 1.0, road_right=1) for i in range(10)], loop)

    turning = [replace(frame(20 + i, 1.0), turned_rad=-math.pi / 2 / 12) for i in range(12)]
    last = run_steps(turning, loop)[-1]

    assert last.approach is None
    assert loop.counts["approaches closed: turned"] == 1


def test_bend_far_before_ranged_intersection_keeps_approach_open() -> None:
    loop = approaches()
    bend = [replace(one, turned_rad=0.1) for one in drive(60.0, 30.0, {"stop_sign": (60.0, 1)})]

    assert run_steps(bend, loop)[-1].approach == 1


def test_turn_at_ranged_intersection_closes_approach_and_opens_no_other() -> None:
    loop = approaches()
    run_steps(drive(40.0, 0.0, {"stop_sign": (40.0, 1)}), loop)

    turning = [
        replace(frame(100 + i, 1.0, road_right=1), turned_rad=math.pi / 2 / 12) for i in range(10)
    ]
    taken = run_steps(turning, loop)

    assert taken[-1].approach is None
    assert loop.counts["approaches closed: turned"] == loop.counts["approaches opened"] == 1


def test_approach_without_range_closes_when_stale() -> None:
    loop = approaches()
    seen = [frame(i, 1.0, road_left=1, road_right=1) for i in range(25)]
    past = [frame(25 + i, 1.0, road_straight=1) for i in range(31)]

    taken = run_steps(seen + past, loop)

    assert taken[24].established
    assert taken[24].ranges == ()
    assert taken[-1].approach is None
    assert loop.counts["approaches closed: stale"] == 1


def test_continuous_road_cue_is_split_into_approaches_of_max_length() -> None:
    loop = approaches()

    run_steps([frame(i, 1.0, road_left=1) for i in range(1000)], loop)

    assert loop.counts["approaches closed: too long"] == 9


def test_distant_sign_opens_new_approach_with_fresh_belief() -> None:
    loop = approaches()
    run_steps([frame(i, 1.0, road_left=1) for i in range(60)], loop)

    step = loop(replace(frame(60, 1.0, stop_sign=1), signs=(sign(60.0),)))

    assert step.approach == 2
    assert step.probabilities["left"] == 0.5
    assert loop.counts["approaches closed: another ahead"] == 1


def test_nearby_sign_joins_open_approach_and_keeps_belief() -> None:
    loop = approaches()
    run_steps([frame(i, 1.0, road_left=1) for i in range(10)], loop)

    step = loop(replace(frame(10, 1.0, stop_sign=1), signs=(sign(40.0),)))

    assert step.approach == 1
    assert step.probabilities["left"] > 0.9


def test_isolated_false_detections_never_establish_presence() -> None:
    loop = approaches()
    noise = [frame(i, 1.0, road_left=int(i % 50 == 0)) for i in range(500)]

    taken = run_steps(noise, loop)

    assert not any(one.established for one in taken)
    assert loop.counts["approaches closed: neutral"] == loop.counts["approaches opened"] == 10


def test_only_sign_opens_approach_right_after_passed_intersection() -> None:
    loop = approaches()
    run_steps(drive(40.0, -17.0, {"stop_sign": (40.0, 1)}), loop)
    at_once = frame(200, 1.0, road_left=1)

    assert run_steps([at_once], loop)[-1].approach is None
    assert run_steps([replace(frame(201), signs=(sign(50.0),))], loop)[-1].approach == 2


def test_gate_stays_closed_until_presence_is_established() -> None:
    quiet = [frame(i, 1.0, road_left=int(i == 0), parked_left=2, road_straight=1) for i in range(5)]
    shut = run_steps(quiet)[-1]

    assert not shut.established
    assert shut.probabilities == pytest.approx(
        {"intersection": 0.5, "left": 0.77, "right": 0.5, "straight": 0.5}
    )


def test_open_gate_stays_open_for_rest_of_approach() -> None:
    one_sign = [
        frame(0, 1.0, stop_sign=1),
        frame(1, 1.0, parked_left=2),
        frame(2, 1.0, parked_left=1),
    ]

    first, second, third = run_steps(one_sign)

    assert first.established
    assert first.probabilities["left"] == 0.5
    assert second.probabilities["left"] == pytest.approx(0.83**2 / (0.83**2 + 0.17**2))
    assert third.probabilities["left"] > second.probabilities["left"]


def test_dissent_begins_within_20_m_of_intersection() -> None:
    taken = run_steps(drive(40.0, 10.0, {"stop_sign": (40.0, 1)}))
    by_range = {round(one.ranges[0].range_m): one.probabilities["left"] for one in taken}

    assert by_range[21] == 0.5
    assert by_range[20] == pytest.approx(0.49**3 / (0.49**3 + 0.51**3))
    assert by_range[10] < by_range[15] < by_range[20]


def test_absent_cues_do_not_dissent_without_range() -> None:
    taken = run_steps([frame(i, 1.0, road_left=1) for i in range(20)])

    assert taken[-1].probabilities["right"] == 0.5


def test_past_cues_receive_start_range_and_are_counted() -> None:
    asked: list[tuple[RangeBelief | None, Reference | None]] = []

    def past(best: RangeBelief | None, reference: Reference | None) -> Mapping[str, int]:
        asked.append((best, reference))
        return {"lanes_past": 1, "vehicles_past": 2}

    both = replace(frame(0, stop_sign=1, traffic_light=1), signs=(light(50.0), sign(35.0)))
    taken = run_steps([both, frame(1, 1.0)], past=past)

    assert asked[0] == (RangeBelief(35.0, 1.7**2), Reference.START)
    assert taken[1].counts["vehicles_past"] == 2
    assert taken[1].probabilities["straight"] == pytest.approx(0.96**3 / (0.96**3 + 0.04**3))


def test_other_reference_is_used_when_preferred_one_is_unknown() -> None:
    asked: list[Reference | None] = []

    def past(best: RangeBelief | None, reference: Reference | None) -> Mapping[str, int]:
        asked.append(reference)
        return {}

    seen = [replace(frame(0), signs=(light(50.0),)), replace(frame(1), signs=(sign(30.0),))]
    run_steps(seen, past=past)
    run_steps(seen, approaches(Fusion(reference="end")), past=past)

    assert asked == ["end", "start", "end", "end"]


def test_start_and_end_references_are_filtered_independently() -> None:
    seen = [replace(frame(i), signs=(sign(40.0 - i), light(55.0 - i))) for i in range(1, 20)]
    last = run_steps(seen)[-1]

    alone = {
        row.reference: (row.range_m, row.var_m2)
        for one in (
            run_steps([replace(f, signs=f.signs[:1]) for f in seen])[-1],
            run_steps([replace(f, signs=f.signs[1:]) for f in seen])[-1],
        )
        for row in one.ranges
    }
    assert {row.reference: (row.range_m, row.var_m2) for row in last.ranges} == alone


def test_several_signs_with_same_reference_are_averaged() -> None:
    (step,) = run_steps([replace(frame(0), signs=(sign(30.0, 2.0), sign(34.0, 2.0)))])

    (row,) = step.ranges
    assert (row.range_m, row.var_m2, row.measured_m) == (32.0, 4.0, 32.0)


def test_sign_sd_grows_with_range() -> None:
    loop = approaches(range_filter=RangeFilter(sd_fraction=0.1, fade_m=0.0, begin_after=1))

    (step,) = run_steps([replace(frame(0), signs=(sign(30.0, 4.0),))], loop)

    assert step.ranges[0].var_m2 == pytest.approx(4.0**2 + 3.0**2)


@pytest.mark.parametrize("range_m", [0.0, -3.0, 151.0, math.nan, math.inf])
def test_implausible_range_is_refused_and_counted(range_m: float) -> None:
    loop = approaches()

    (step,) = run_steps([replace(frame(0), signs=(sign(range_m),))], loop)

    assert step.approach is None
    assert loop.counts == {"ranges refused: beyond reason": 1}


def test_range_outside_gate_is_refused_and_counted() -> None:
    loop = approaches()
    run_steps(drive(60.0, 41.0, {"stop_sign": (60.0, 1)}), loop)

    step = loop(replace(frame(100, 1.0), signs=(sign(90.0),)))

    assert loop.counts["ranges refused: outside the gate"] == 1
    assert step.ranges[0].measured_m is None
    assert step.ranges[0].range_m == pytest.approx(40.0)


def test_repeated_or_late_evidence_is_refused_and_counted() -> None:
    clean, dirty = approaches(), approaches()
    good = list(drive(50.0, 10.0, {"stop_sign": (50.0, 1), "road_right": (20.0, 1)}))
    wrong = frame(0, 30.0, road_left=1)

    expected = run_steps(good, clean)
    taken = []
    for one in good:
        taken.append(dirty(one))
        assert dirty(replace(wrong, t_ns=one.t_ns)).probabilities == {}
        assert dirty(replace(wrong, t_ns=one.t_ns - 1)).approach is None

    assert taken == expected
    assert dirty.counts["evidence refused: repeated"] == len(good)
    assert dirty.counts["evidence refused: out of order"] == len(good)


def test_missing_odometry_increases_range_variance_only() -> None:
    loop = approaches()
    before = run_steps(drive(50.0, 30.0, {"stop_sign": (50.0, 1)}), loop)[-1].ranges[0]

    gap = loop(FrameEvidence(21 * FRAME_NS, None, 0.0, (), NONE_SEEN)).ranges[0]

    assert gap.range_m == before.range_m
    assert gap.var_m2 == pytest.approx((math.sqrt(before.var_m2) + 1.5) ** 2)
    assert loop.counts["odometry missing"] == 1


@pytest.mark.parametrize(
    ("travelled_m", "var_m2"), [(math.nan, 0.0), (math.inf, 0.0), (1.0, math.nan), (1.0, -1.0)]
)
def test_invalid_odometry_counts_as_missing(travelled_m: float, var_m2: float) -> None:
    loop = approaches()
    run_steps(drive(50.0, 30.0, {"stop_sign": (50.0, 1)}), loop)

    step = loop(FrameEvidence(100 * FRAME_NS, travelled_m, var_m2, (), NONE_SEEN))

    assert loop.counts["odometry missing"] == 1
    assert all(math.isfinite(row.range_m + row.var_m2) for row in step.ranges)


def test_long_odometry_gap_drops_range_and_then_closes_approach() -> None:
    loop = approaches()
    run_steps(drive(50.0, 30.0, {"stop_sign": (50.0, 1)}), loop)
    gap = [FrameEvidence((21 + i) * FRAME_NS, None, 0.0, (), NONE_SEEN) for i in range(200)]

    taken = run_steps(gap, loop)

    assert taken[0].ranges
    assert not any(one.ranges for one in taken[14:])
    assert taken[14].approach == 1
    assert loop.counts["ranges dropped: too uncertain"] == 1
    assert taken[-1].approach is None


@pytest.mark.parametrize(("assumed_m", "is_kept"), [(0.0, False), (65.0, True)])
def test_unobserved_distance_does_not_make_approach_stale(assumed_m: float, is_kept: bool) -> None:
    loop = approaches(Fusion(longest_m=1e3))
    run_steps(standing_frames(30, 0, stop_sign=1), loop)

    step = loop(replace(frame(40, 65.0), assumed_m=assumed_m))

    assert (step.approach is not None) is is_kept


def test_signs_alone_update_range_without_odometry() -> None:
    seen = [replace(one, travelled_m=None) for one in drive(60.0, 10.0, {"stop_sign": (60.0, 1)})]

    last = run_steps(seen)[-1]

    assert last.ranges[0].range_m == pytest.approx(10.0, abs=1.0)


def test_approach_open_at_end_of_drive_is_counted() -> None:
    loop = approaches()
    run_steps(drive(50.0, 10.0, {"stop_sign": (50.0, 1)}), loop)

    loop.finish()

    assert loop.counts["approaches closed: the drive ended"] == 1


def test_range_errors_over_drives_match_reported_variance() -> None:
    rng = np.random.default_rng(5)
    nees = []
    for _ in range(300):
        loop, truth_m = approaches(), 70.0
        for i in range(60):
            truth_m -= 1.0
            seen = (sign(truth_m + rng.normal(0.0, 1.7)),) if rng.random() < 0.6 else ()
            way_m = 1.0 + rng.normal(0.0, 0.05)
            step = loop(FrameEvidence(i * FRAME_NS, way_m, 0.05**2, seen, {}))
        (row,) = step.ranges
        nees.append((row.range_m - truth_m) ** 2 / row.var_m2)

    # The gate at 16 rejects one good measurement in 16,000.
    assert np.mean(nees) == pytest.approx(1.0, abs=4 * math.sqrt(2 / 300))
