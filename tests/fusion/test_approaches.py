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
PLAIN = RangeFilter(sd_fraction=0.0, fade_m=0.0, begin_after=1)
"""Settings of the dissertation, with which ranges can be computed by hand."""


def approaches(fusion: Fusion | None = None, range_filter: RangeFilter = PLAIN) -> Approaches:
    fusion = fusion or Fusion()
    return Approaches(graph_of(fusion), fusion, range_filter)


def steps(
    evidence: Iterable[FrameEvidence], loop: Approaches | None = None, past: PastCues = no_past_cues
) -> list[Step]:
    loop = loop or approaches()
    return [loop(one, past) for one in evidence]


def standing(many: int, from_ns: int, **counts: int) -> list[FrameEvidence]:
    seen = {**NONE_SEEN, **counts}
    return [FrameEvidence(from_ns + i * FRAME_NS, 0.0, 0.0, (), seen) for i in range(many)]


def frame(i: int, travelled_m: float | None = 1.0, **counts: int) -> FrameEvidence:
    return FrameEvidence(i * FRAME_NS, travelled_m, 1e-4, (), {**NONE_SEEN, **counts})


def test_a_drive_past_one_intersection_is_one_approach() -> None:
    loop = approaches()

    taken = steps(drive(90.0, -40.0, {"stop_sign": (60.0, 1), "road_left": (25.0, 1)}), loop)

    open_for = [one for one in taken if one.approach is not None]
    assert {one.approach for one in open_for} == {1}
    assert len(open_for) == 60 + 17 + 1
    assert open_for[-1].probabilities["left"] > 0.9
    assert loop.counts == {
        "approaches opened": 1,
        "approaches established": 1,
        "approaches closed: passed": 1,
    }


def test_a_sign_seen_once_opens_an_approach_but_reports_no_range() -> None:
    loop = approaches(range_filter=RangeFilter())
    once = replace(frame(1, stop_sign=1), signs=(sign(60.0),))
    taken = steps([frame(0), once, *(frame(i) for i in range(2, 40))], loop)

    assert taken[1].approach == 1
    assert not any(step.ranges for step in taken)
    assert loop.counts["ranges waiting for a second observation"] == 1


def test_approaches_of_a_drive_are_numbered_and_begin_anew() -> None:
    loop, taken = approaches(), list[Step]()
    for i, side in enumerate(("road_left", "road_right", "road_left")):
        seen = {"stop_sign": (60.0, 1), side: (25.0, 1)}
        taken += steps(drive(70.0, -30.0, seen, begin_ns=i * 1000 * SECOND_NS), loop)

    last = {one.approach: one.probabilities for one in taken if one.approach is not None}
    assert list(last) == [1, 2, 3]
    assert [last[i]["left"] > 0.9 for i in (1, 2, 3)] == [True, False, True]
    assert [last[i]["right"] > 0.9 for i in (1, 2, 3)] == [False, True, False]


def test_a_car_that_waits_at_the_line_keeps_its_approach_and_its_belief() -> None:
    loop = approaches()
    before = steps(drive(60.0, 2.0, {"stop_sign": (60.0, 1), "road_left": (25.0, 1)}), loop)[-1]

    after = steps(standing(3000, 100 * SECOND_NS), loop)[-1]

    assert after.approach == before.approach == 1
    assert after.ranges == tuple(replace(row, measured_m=None) for row in before.ranges)
    assert after.probabilities["left"] == pytest.approx(before.probabilities["left"], rel=0.02)


def test_a_crawl_sends_more_messages_but_closes_no_earlier() -> None:
    slow = steps(drive(40.0, -20.0, {"stop_sign": (40.0, 1)}, step_m=0.02))

    numbers = {one.approach for one in slow if one.approach is not None}
    assert numbers == {1}
    assert slow[-1].approach is None
    assert max(p for one in slow for p in one.probabilities.values()) < 1.0


def test_a_car_that_reverses_and_comes_again_is_on_the_same_approach() -> None:
    loop = approaches()
    there = list(drive(40.0, 10.0, {"stop_sign": (40.0, 1)}))
    back = [frame(100 + i, -1.0) for i in range(10)]
    again = [frame(200 + i, 1.0) for i in range(10)]

    steps(there, loop)
    furthest = steps(back, loop)[-1]
    nearest = steps(again, loop)[-1]

    assert furthest.ranges[0].range_m == pytest.approx(20.0)
    assert nearest.ranges[0].range_m == pytest.approx(10.0)
    assert nearest.approach == 1


def test_a_car_that_reverses_out_of_reach_has_left() -> None:
    loop = approaches()
    steps(drive(40.0, 10.0, {"stop_sign": (40.0, 1)}), loop)

    steps([frame(100 + i, -5.0, stop_sign=1) for i in range(40)], loop)

    assert loop.counts["approaches closed: out of reach"] == 1


def test_a_turn_ends_an_approach_without_a_range() -> None:
    loop = approaches()
    steps([frame(i, 1.0, road_right=1) for i in range(10)], loop)

    turning = [replace(frame(20 + i, 1.0), turned_rad=-math.pi / 2 / 12) for i in range(12)]
    last = steps(turning, loop)[-1]

    assert last.approach is None
    assert loop.counts["approaches closed: turned"] == 1


def test_a_bend_well_before_a_ranged_intersection_does_not_end_the_approach() -> None:
    loop = approaches()
    bend = [replace(one, turned_rad=0.1) for one in drive(60.0, 30.0, {"stop_sign": (60.0, 1)})]

    assert steps(bend, loop)[-1].approach == 1


def test_a_turn_at_a_ranged_intersection_ends_the_approach_and_no_other_begins() -> None:
    loop = approaches()
    steps(drive(40.0, 0.0, {"stop_sign": (40.0, 1)}), loop)

    turning = [
        replace(frame(100 + i, 1.0, road_right=1), turned_rad=math.pi / 2 / 12) for i in range(10)
    ]
    taken = steps(turning, loop)

    assert taken[-1].approach is None
    assert loop.counts["approaches closed: turned"] == loop.counts["approaches opened"] == 1


def test_without_any_range_an_approach_still_closes() -> None:
    loop = approaches()
    seen = [frame(i, 1.0, road_left=1, road_right=1) for i in range(25)]
    past = [frame(25 + i, 1.0, road_straight=1) for i in range(31)]

    taken = steps(seen + past, loop)

    assert taken[24].established
    assert taken[24].ranges == ()
    assert taken[-1].approach is None
    assert loop.counts["approaches closed: stale"] == 1


def test_road_seen_everywhere_is_not_one_endless_approach() -> None:
    loop = approaches()

    steps([frame(i, 1.0, road_left=1) for i in range(1000)], loop)

    assert loop.counts["approaches closed: too long"] == 9


def test_a_sign_far_ahead_begins_an_approach_that_knows_nothing_of_the_way_before() -> None:
    loop = approaches()
    steps([frame(i, 1.0, road_left=1) for i in range(60)], loop)

    step = loop(replace(frame(60, 1.0, stop_sign=1), signs=(sign(60.0),)))

    assert step.approach == 2
    assert step.probabilities["left"] == 0.5
    assert loop.counts["approaches closed: another ahead"] == 1


def test_a_sign_near_by_takes_over_what_the_road_said() -> None:
    loop = approaches()
    steps([frame(i, 1.0, road_left=1) for i in range(10)], loop)

    step = loop(replace(frame(10, 1.0, stop_sign=1), signs=(sign(40.0),)))

    assert step.approach == 1
    assert step.probabilities["left"] > 0.9


def test_noise_that_never_established_anything_is_no_detection() -> None:
    loop = approaches()
    noise = [frame(i, 1.0, road_left=int(i % 50 == 0)) for i in range(500)]

    taken = steps(noise, loop)

    assert not any(one.established for one in taken)
    assert loop.counts["approaches closed: neutral"] == loop.counts["approaches opened"] == 10


def test_after_a_passed_intersection_only_a_sign_opens_the_next_one_at_once() -> None:
    loop = approaches()
    steps(drive(40.0, -17.0, {"stop_sign": (40.0, 1)}), loop)
    at_once = frame(200, 1.0, road_left=1)

    assert steps([at_once], loop)[-1].approach is None
    assert steps([replace(frame(201), signs=(sign(50.0),))], loop)[-1].approach == 2


def test_the_gate_stays_shut_until_presence_is_established() -> None:
    quiet = [frame(i, 1.0, road_left=int(i == 0), parked_left=2, road_straight=1) for i in range(5)]
    shut = steps(quiet)[-1]

    assert not shut.established
    assert shut.probabilities == pytest.approx(
        {"intersection": 0.5, "left": 0.77, "right": 0.5, "straight": 0.5}
    )


def test_the_gate_once_open_stays_open_for_the_approach() -> None:
    one_sign = [
        frame(0, 1.0, stop_sign=1),
        frame(1, 1.0, parked_left=2),
        frame(2, 1.0, parked_left=1),
    ]

    first, second, third = steps(one_sign)

    assert first.established
    assert first.probabilities["left"] == 0.5
    assert second.probabilities["left"] == pytest.approx(0.83**2 / (0.83**2 + 0.17**2))
    assert third.probabilities["left"] > second.probabilities["left"]


def test_dissent_begins_within_20_m_of_the_intersection() -> None:
    taken = steps(drive(40.0, 10.0, {"stop_sign": (40.0, 1)}))
    by_range = {round(one.ranges[0].range_m): one.probabilities["left"] for one in taken}

    assert by_range[21] == 0.5
    assert by_range[20] == pytest.approx(0.49**3 / (0.49**3 + 0.51**3))
    assert by_range[10] < by_range[15] < by_range[20]


def test_without_a_range_nothing_dissents() -> None:
    taken = steps([frame(i, 1.0, road_left=1) for i in range(20)])

    assert taken[-1].probabilities["right"] == 0.5


def test_cues_past_the_intersection_are_given_the_start_and_counted_with_the_rest() -> None:
    asked: list[tuple[RangeBelief | None, Reference | None]] = []

    def past(best: RangeBelief | None, reference: Reference | None) -> Mapping[str, int]:
        asked.append((best, reference))
        return {"lanes_past": 1, "vehicles_past": 2}

    both = replace(frame(0, stop_sign=1, traffic_light=1), signs=(light(50.0), sign(35.0)))
    taken = steps([both, frame(1, 1.0)], past=past)

    assert asked[0] == (RangeBelief(35.0, 1.7**2), Reference.START)
    assert taken[1].counts["vehicles_past"] == 2
    assert taken[1].probabilities["straight"] == pytest.approx(0.96**3 / (0.96**3 + 0.04**3))


def test_the_other_reference_serves_where_the_wanted_one_is_unknown() -> None:
    asked: list[Reference | None] = []

    def past(best: RangeBelief | None, reference: Reference | None) -> Mapping[str, int]:
        asked.append(reference)
        return {}

    seen = [replace(frame(0), signs=(light(50.0),)), replace(frame(1), signs=(sign(30.0),))]
    steps(seen, past=past)
    steps(seen, approaches(Fusion(reference="end")), past=past)

    assert asked == ["end", "start", "end", "end"]


def test_the_two_references_never_mix() -> None:
    seen = [replace(frame(i), signs=(sign(40.0 - i), light(55.0 - i))) for i in range(1, 20)]
    last = steps(seen)[-1]

    alone = {
        row.reference: (row.range_m, row.var_m2)
        for one in (
            steps([replace(f, signs=f.signs[:1]) for f in seen])[-1],
            steps([replace(f, signs=f.signs[1:]) for f in seen])[-1],
        )
        for row in one.ranges
    }
    assert {row.reference: (row.range_m, row.var_m2) for row in last.ranges} == alone


def test_several_signs_of_one_kind_count_as_their_mean() -> None:
    (step,) = steps([replace(frame(0), signs=(sign(30.0, 2.0), sign(34.0, 2.0)))])

    (row,) = step.ranges
    assert (row.range_m, row.var_m2, row.measured_m) == (32.0, 4.0, 32.0)


def test_a_signs_sd_may_grow_with_its_range() -> None:
    loop = approaches(range_filter=RangeFilter(sd_fraction=0.1, fade_m=0.0, begin_after=1))

    (step,) = steps([replace(frame(0), signs=(sign(30.0, 4.0),))], loop)

    assert step.ranges[0].var_m2 == pytest.approx(4.0**2 + 3.0**2)


@pytest.mark.parametrize("range_m", [0.0, -3.0, 151.0, math.nan, math.inf])
def test_a_range_beyond_reason_is_refused_and_counted(range_m: float) -> None:
    loop = approaches()

    (step,) = steps([replace(frame(0), signs=(sign(range_m),))], loop)

    assert step.approach is None
    assert loop.counts == {"ranges refused: beyond reason": 1}


def test_a_range_outside_the_gate_is_counted_and_not_shown_as_taken() -> None:
    loop = approaches()
    steps(drive(60.0, 41.0, {"stop_sign": (60.0, 1)}), loop)

    step = loop(replace(frame(100, 1.0), signs=(sign(90.0),)))

    assert loop.counts["ranges refused: outside the gate"] == 1
    assert step.ranges[0].measured_m is None
    assert step.ranges[0].range_m == pytest.approx(40.0)


def test_evidence_repeated_or_late_changes_nothing_and_is_counted() -> None:
    clean, dirty = approaches(), approaches()
    good = list(drive(50.0, 10.0, {"stop_sign": (50.0, 1), "road_right": (20.0, 1)}))
    wrong = frame(0, 30.0, road_left=1)

    expected = steps(good, clean)
    taken = []
    for one in good:
        taken.append(dirty(one))
        assert dirty(replace(wrong, t_ns=one.t_ns)).probabilities == {}
        assert dirty(replace(wrong, t_ns=one.t_ns - 1)).approach is None

    assert taken == expected
    assert dirty.counts["evidence refused: repeated"] == len(good)
    assert dirty.counts["evidence refused: out of order"] == len(good)


def test_missing_odometry_widens_the_range_and_leaves_its_mean() -> None:
    loop = approaches()
    before = steps(drive(50.0, 30.0, {"stop_sign": (50.0, 1)}), loop)[-1].ranges[0]

    gap = loop(FrameEvidence(21 * FRAME_NS, None, 0.0, (), NONE_SEEN)).ranges[0]

    assert gap.range_m == before.range_m
    assert gap.var_m2 == pytest.approx((math.sqrt(before.var_m2) + 1.5) ** 2)
    assert loop.counts["odometry missing"] == 1


@pytest.mark.parametrize(
    ("travelled_m", "var_m2"), [(math.nan, 0.0), (math.inf, 0.0), (1.0, math.nan), (1.0, -1.0)]
)
def test_odometry_that_is_no_number_counts_as_missing(travelled_m: float, var_m2: float) -> None:
    loop = approaches()
    steps(drive(50.0, 30.0, {"stop_sign": (50.0, 1)}), loop)

    step = loop(FrameEvidence(100 * FRAME_NS, travelled_m, var_m2, (), NONE_SEEN))

    assert loop.counts["odometry missing"] == 1
    assert all(math.isfinite(row.range_m + row.var_m2) for row in step.ranges)


def test_odometry_missing_for_long_drops_the_range_and_then_the_approach() -> None:
    loop = approaches()
    steps(drive(50.0, 30.0, {"stop_sign": (50.0, 1)}), loop)
    gap = [FrameEvidence((21 + i) * FRAME_NS, None, 0.0, (), NONE_SEEN) for i in range(200)]

    taken = steps(gap, loop)

    assert taken[0].ranges
    assert not any(one.ranges for one in taken[14:])
    assert taken[14].approach == 1
    assert loop.counts["ranges dropped: too uncertain"] == 1
    assert taken[-1].approach is None


@pytest.mark.parametrize(("assumed_m", "is_kept"), [(0.0, False), (65.0, True)])
def test_a_way_on_which_nobody_looked_makes_no_approach_stale(
    assumed_m: float, is_kept: bool
) -> None:
    loop = approaches(Fusion(longest_m=1e3))
    steps(standing(30, 0, stop_sign=1), loop)

    step = loop(replace(frame(40, 65.0), assumed_m=assumed_m))

    assert (step.approach is not None) is is_kept


def test_ranges_follow_a_drive_without_odometry_from_its_signs() -> None:
    seen = [replace(one, travelled_m=None) for one in drive(60.0, 10.0, {"stop_sign": (60.0, 1)})]

    last = steps(seen)[-1]

    assert last.ranges[0].range_m == pytest.approx(10.0, abs=1.0)


def test_an_approach_still_open_at_the_end_is_counted() -> None:
    loop = approaches()
    steps(drive(50.0, 10.0, {"stop_sign": (50.0, 1)}), loop)

    loop.finish()

    assert loop.counts["approaches closed: the drive ended"] == 1


def test_errors_of_whole_drives_are_as_large_as_the_ranges_say() -> None:
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
