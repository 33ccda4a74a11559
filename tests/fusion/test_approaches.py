"""Tests of approaches: opening and closing, the gate, dissent, and rejected evidence."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import replace

import numpy as np
import pytest

from crosscue.fusion.approaches import Approaches, Step, no_past_cues
from crosscue.fusion.evidence import FrameEvidence, PastCues, RangePosterior, SignRange
from crosscue.fusion.factor_graph import graph_of, log_odds, probability
from crosscue.fusion.intersection_range import RangeBelief, Reference
from crosscue.fusion.situation import Situation
from crosscue.replay.vehicle.fusion import Fusion, RangeFilter
from crosscue.replay.vehicle.vehicle import Vehicle
from support.fusion import NONE_SEEN, SECOND_NS, drive, light, sign

FRAME_NS = SECOND_NS // 10
# Range filter of the dissertation, whose results can be computed by hand.
DISSERTATION_FILTER = RangeFilter(sd_fraction=0.0, fade_m=0.0, begin_after=1)


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


def test_stationary_car_keeps_approach_and_belief() -> None:
    loop = approaches()
    before = run_steps(drive(60.0, 2.0, {"stop_sign": (60.0, 1), "road_left": (25.0, 1)}), loop)[-1]

    after = run_steps(standing_frames(3000, 100 * SECOND_NS), loop)[-1]

    assert after.approach == before.approach == 1
    assert after.ranges == tuple(replace(row, measured_m=None) for row in before.ranges)
    assert after.probabilities["left"] == pytest.approx(before.probabilities["left"], rel=0.02)


def established(*signs: SignRange) -> FrameEvidence:
    """Return a first frame that opens an approach and establishes presence: 0.97 > 0.9."""
    return replace(frame(0, stop_sign=1), signs=signs)


@pytest.mark.parametrize(
    ("signs", "moved_m", "turned_rad", "why"),
    [
        # The end is 15 m behind the start, and passed once it is more than 2 m behind the axle.
        ((sign(10.0),), 27.0, 0.0, None),
        ((sign(10.0),), 27.001, 0.0, "passed"),
        ((light(10.0),), 12.0, 0.0, None),
        ((light(10.0),), 12.001, 0.0, "passed"),
        ((sign(40.0), light(10.0)), 12.001, 0.0, "passed"),
        # An end is out of reach beyond 150 + 15 m.
        ((sign(150.0),), 0.0, 0.0, None),
        ((sign(150.0),), -0.001, 0.0, "out of reach"),
        ((light(150.0),), -15.0, 0.0, None),
        ((light(150.0),), -15.001, 0.0, "out of reach"),
        # A turn of 0.8 ends it where the end is within 15 m, or unknown.
        ((sign(10.0),), 10.0, 0.8, "turned"),
        ((sign(10.0),), 10.0, -0.8, "turned"),
        ((sign(10.0),), 10.0, 0.799, None),
        ((sign(10.0),), 9.99, 0.8, None),
        ((), 0.0, 0.8, "turned"),
        # It is stale after 30 m without a range, after 60 m with one, and too long after 100 m.
        ((), 30.0, 0.0, None),
        ((), 30.001, 0.0, "stale"),
        ((), -30.001, 0.0, "stale"),
        ((sign(90.0),), 60.0, 0.0, None),
        ((sign(90.0),), 60.001, 0.0, "stale"),
        ((), 100.0, 0.0, "stale"),
        ((), 100.001, 0.0, "too long"),
        ((sign(130.0),), 100.001, 0.0, "stale"),
    ],
)
def test_approach_closes_at_published_or_configured_limits(
    signs: tuple[SignRange, ...], moved_m: float, turned_rad: float, why: str | None
) -> None:
    loop = approaches()
    after = FrameEvidence(FRAME_NS, moved_m, 0.0, (), NONE_SEEN, turned_rad=turned_rad)

    _, step = run_steps([established(*signs), after], loop)

    closed = {} if why is None else {f"approaches closed: {why}": 1}
    assert loop.counts == {"approaches opened": 1, "approaches established": 1, **closed}
    assert step.approach == (1 if why is None else None)


@pytest.mark.parametrize(("turned_rad", "is_kept"), [(0.449, True), (0.451, False)])
def test_turn_fades_over_25_metres_and_is_kept_where_unknown(
    turned_rad: float, is_kept: bool
) -> None:
    """0.7 halves over 25 ln 2 m: 0.35 + 0.45 = 0.8."""
    turns = [(0.0, 0.7), (5.0, None), (5.0, math.nan), (25.0 * math.log(2.0), turned_rad)]
    frames = [replace(frame(i, m), turned_rad=r) for i, (m, r) in enumerate(turns, 1)]

    assert (run_steps([established(), *frames])[-1].approach == 1) is is_kept


@pytest.mark.parametrize(
    ("assumed_m", "is_kept"), [(0.0, False), (34.999, False), (35.0, True), (70.0, True)]
)
def test_assumed_distance_does_not_make_approach_stale(assumed_m: float, is_kept: bool) -> None:
    """65 m of which 35 m are assumed are 30 m, and more assumed metres are no credit for 31 m."""
    loop = approaches()
    frames = [established(), replace(frame(1, 65.0), assumed_m=assumed_m)]
    if assumed_m == 70.0:
        frames.append(frame(2, 30.001))

    is_open = run_steps(frames, loop)[1].approach == 1

    assert is_open is is_kept
    assert (loop.counts["approaches closed: stale"] == 0) is (assumed_m == 35.0)


@pytest.mark.parametrize(("range_m", "number"), [(40.0, 1), (40.001, 2)])
def test_first_range_beyond_100_metres_from_opening_is_another_intersection(
    range_m: float, number: int
) -> None:
    """60 + 40 m are within the length of one approach; the nearest of several ranges decides."""
    loop = approaches()
    near = [established(), *(frame(i, 20.0, stop_sign=1) for i in (1, 2, 3))]
    ranged = replace(frame(4, 0.0), signs=(light(90.0), sign(range_m)))

    step = run_steps([*near, ranged], loop)[-1]

    assert step.approach == number
    assert loop.counts["approaches closed: another ahead"] == number - 1
    assert (step.probabilities["intersection"] == 0.5) is (number == 2)


def test_range_at_standstill_or_after_first_one_never_opens_another() -> None:
    """120 m at the place of the opening is plausible; the second range is left to the gate."""
    far = replace(frame(1, 0.0), signs=(sign(120.0),))
    next_one = replace(frame(2, 10.0), signs=(light(140.0),))

    assert [one.approach for one in run_steps([established(), far, next_one])] == [1, 1, 1]


def test_only_sign_opens_approach_within_ten_metres_after_intersection() -> None:
    """Of the rest of 10 m, the frame that closes takes 1.5 m; then 8 + 0.5 m complete it."""
    road = {"road_left": 1}
    start = [established(light(10.0)), frame(1, 11.0), frame(2, 1.5, **road), frame(3, 8.0, **road)]
    steps = run_steps([*start, frame(4, 0.5, **road)])

    assert [one.approach for one in steps] == [1, 1, None, None, 2]
    ranged = replace(frame(4, 0.0), signs=(sign(50.0),))
    assert run_steps([*start, ranged])[-1].approach == 2
    turned = [established(), replace(frame(1, 0.0), turned_rad=0.8)]
    after = [frame(2, 9.5, **road), frame(3, 0.5, **road)]
    assert [one.approach for one in run_steps([*turned, *after])] == [1, None, None, 2]


def test_approach_opens_at_once_after_one_that_did_not_pass() -> None:
    """Neither an approach out of reach nor a stale one is followed by a rest."""
    for first, moved_m in ((established(sign(150.0)), -0.001), (established(), 30.001)):
        steps = run_steps([first, frame(1, moved_m), frame(2, 0.0, road_left=1)])
        assert [one.approach for one in steps] == [1, None, 2]


@pytest.mark.parametrize(
    ("range_m", "sd_m", "is_sane"),
    [
        (1e-9, 1e-9, True),
        (150.0, 150.0, True),
        (0.0, 1.0, False),
        (-3.0, 1.0, False),
        (150.001, 1.0, False),
        (30.0, 150.001, False),
        (30.0, 0.0, False),
        (math.nan, 1.0, False),
        (math.inf, 1.0, False),
        (30.0, math.nan, False),
        (30.0, 1e150, False),
    ],
)
def test_range_outside_150_metres_or_without_sd_is_refused_and_counted(
    range_m: float, sd_m: float, is_sane: bool
) -> None:
    loop = approaches()

    signs = (sign(range_m, sd_m), sign(-1.0))
    (step,) = run_steps([replace(frame(0), signs=signs)], loop)

    assert (step.approach == 1) is is_sane
    assert loop.counts["approaches opened"] == is_sane
    assert loop.counts["ranges refused: beyond reason"] == 2 - is_sane


def test_signs_of_one_reference_are_averaged_with_error_of_curve() -> None:
    """Mean 31 m; the variance is that of one sign, (2^2 + 4^2) / 2 = 10, plus (31 / 10)^2."""
    loop = approaches(range_filter=RangeFilter(sd_fraction=0.1, fade_m=0.0, begin_after=1))

    (step,) = run_steps([established(sign(28.0, 2.0), sign(34.0, 4.0), light(50.0, 3.0))], loop)

    start, end = step.ranges
    assert (start.reference, start.range_m, start.measured_m) == (Reference.START, 31.0, 31.0)
    assert (end.reference, end.range_m, end.measured_m) == (Reference.END, 50.0, 50.0)
    assert (start.var_m2, end.var_m2) == pytest.approx((10.0 + 9.61, 9.0 + 25.0))


def situations_of(monkeypatch: pytest.MonkeyPatch, message: float) -> list[Situation]:
    """Return the situations of later frames, each of which sends a message to the intersection."""
    seen: list[Situation] = []

    def model(situation: Situation) -> list[float]:
        seen.append(situation)
        return [message, 0.0, 0.0, 0.0]

    monkeypatch.setattr(
        "crosscue.fusion.approaches.message_models_of", lambda _graph, _fusion: lambda: model
    )
    return seen


def test_message_model_receives_situation_of_each_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    """Near is within 20 m; dissent comes every 1/8 m.

    Without odometry for 0.2 s, 3 m may have passed: the mean is 1.5 m, with that half as s.d.
    """
    seen = situations_of(monkeypatch, 0.0)
    loop = approaches(Fusion(dissent_every_m=0.125))
    counts, objects = {"stop_sign": 1}, {"stop_sign": (7,)}
    first = FrameEvidence(0, 3.0, 0.25, (), counts, objects, is_new_picture=False)
    ranged = FrameEvidence(2 * FRAME_NS, -2.0, 0.25, (sign(21.5),), counts)
    moves = [1.5, 0.0625, 0.0625]
    later = [FrameEvidence((3 + i) * FRAME_NS, m, 0.0, (), {}) for i, m in enumerate(moves)]

    run_steps([first, ranged, *later, FrameEvidence(7 * FRAME_NS, None, 0.0, (), {})], loop)

    near = Situation({}, False, True, True)
    expected = [
        Situation(counts, False, objects=objects, is_new_picture=False),
        Situation(counts, False, False, False, {}, True, 2.0, 0.2, 21.5, -2.0, 0.25),
        replace(near, moved_m=1.5, passed_s=0.1, range_m=20.0, advanced_m=1.5),
        Situation({}, False, True, False, {}, True, 0.0625, 0.1, 19.9375, 0.0625),
        replace(near, moved_m=0.0625, passed_s=0.1, range_m=19.875, advanced_m=0.0625),
        Situation({}, False, True, True, {}, True, 3.0, 0.2, 19.875, 1.5, 2.25),
    ]
    assert [replace(one, passed_s=round(one.passed_s, 9)) for one in seen] == expected
    assert loop.counts == {"approaches opened": 1, "odometry missing": 1}


def test_presence_reaches_message_model_one_frame_later(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each frame sends log 3: 0.75, 0.9, and then 27/28 > 0.9, which the fourth frame knows."""
    seen = situations_of(monkeypatch, math.log(3.0))
    loop = approaches()
    steps = run_steps([frame(i, stop_sign=1) for i in range(4)], loop)

    assert [one.is_established for one in seen] == [False, False, False, True]
    assert [one.probabilities["intersection"] for one in steps] == pytest.approx(
        [3 / 4, 9 / 10, 27 / 28, 81 / 82]
    )
    assert [one.established for one in steps] == [False, False, True, True]
    assert loop.counts["approaches established"] == 1


def test_posterior_of_tracker_is_followed_for_either_reference() -> None:
    """Gain 1 - exp(-10 ln 2 / 10) = 1/2 of the corrections by -6 and +4 m; 9/4 + 4/4 + 4/2."""
    way_m = 10.0 * math.log(2.0)
    first = [
        RangePosterior(ref, m, 9.0, 1.0) for ref, m in zip(Reference, (60.0, 80.0), strict=True)
    ]
    then = [
        RangePosterior(ref, m - way_m, 4.0, measured)
        for ref, m, measured in zip(Reference, (54.0, 84.0), (2.0, 3.0), strict=True)
    ]
    loop = approaches()

    begun, followed = run_steps(
        [
            replace(frame(i, m), travelled_var_m2=0.0, posteriors=tuple(posteriors))
            for i, m, posteriors in ((0, 0.0, first), (1, way_m, then))
        ],
        loop,
    )

    assert [(r.reference, r.range_m, r.var_m2, r.measured_m) for r in begun.ranges] == [
        ("start", 60.0, 9.0, 1.0),
        ("end", 80.0, 9.0, 1.0),
    ]
    start, end = followed.ranges
    assert (start.range_m + way_m, start.var_m2, start.measured_m) == pytest.approx((57, 5.25, 2))
    assert (end.range_m + way_m, end.var_m2, end.measured_m) == pytest.approx((82, 5.25, 3))
    for i, range_m in ((2, 120.0), (3, 40.0)):
        jumped = replace(first[0], range_m=range_m)
        (row, _) = loop(replace(frame(i, 0.0), posteriors=(jumped,))).ranges
        assert row.range_m == range_m
    assert loop.counts["ranges restarted"] == 2


def test_step_holds_evidence_and_beliefs_of_its_frame() -> None:
    """Nothing opens an approach before the stop sign; evidence out of order has no belief."""
    loop = approaches()
    unseen = FrameEvidence(0, 0.0, 0.0, (), {})
    seen = frame(1, stop_sign=1)

    steps = run_steps([unseen, seen, seen, seen, replace(seen, t_ns=FRAME_NS - 1)], loop)

    belief = {"left": 0.5, "right": 0.5, "straight": 0.5}
    belief["intersection"] = probability(log_odds(0.97))
    assert steps == [
        Step(0, None, {}),
        Step(FRAME_NS, 1, seen.counts, (), belief, True),
        Step(FRAME_NS, None, {}),
        Step(FRAME_NS, None, {}),
        Step(FRAME_NS - 1, None, {}),
    ]
    refused = {"evidence refused: repeated": 2, "evidence refused: out of order": 1}
    assert loop.counts == {"approaches opened": 1, "approaches established": 1, **refused}


def test_restart_after_gap_forgets_approach_time_and_rest_distance() -> None:
    """The road opens an approach at once, at an earlier time and less than 10 m after the end."""
    loop = approaches()
    run_steps([established(light(10.0)), frame(1, 11.0), frame(2, 1.5)], loop)
    loop.restart()
    first, last = run_steps([frame(0, road_left=1), frame(1, stop_sign=1)], loop)
    loop.restart()

    assert (first.approach, last.approach) == (2, 2)
    assert loop.counts["approaches closed: passed"] == 1
    assert loop.counts["approaches closed: a gap in time"] == 1
    assert loop.counts["approaches established"] == 2


@pytest.mark.parametrize(
    ("travelled_m", "var_m2"),
    [(None, 0.0), (math.nan, 0.0), (math.inf, 0.0), (1.0, math.nan), (1.0, -1.0), (1.0, math.inf)],
)
def test_missing_or_invalid_odometry_widens_ranges_until_they_are_dropped(
    travelled_m: float | None, var_m2: float
) -> None:
    """15 m/s add 1.5 m to each s.d. per frame: 2.1 + 12 * 1.5 and 1 + 13 * 1.5 exceed 20 m."""
    loop = approaches()
    run_steps([established(sign(50.0, 2.1), light(60.0, 1.0))], loop)
    gap = [FrameEvidence(i * FRAME_NS, travelled_m, var_m2, (), NONE_SEEN) for i in range(1, 14)]

    steps = run_steps(gap, loop)

    start, end = steps[0].ranges
    assert (start.range_m, start.var_m2) == pytest.approx((50.0, 3.6**2))
    assert (end.range_m, end.var_m2) == pytest.approx((60.0, 2.5**2))
    assert [len(one.ranges) for one in steps] == [2] * 11 + [1, 0]
    assert steps[-1].approach == 1
    assert loop.counts["odometry missing"] == 13
    assert loop.counts["ranges dropped: too uncertain"] == 2


def test_waiting_refused_and_restarted_ranges_are_counted() -> None:
    """A range begins with two measurements, and three that are refused replace it.

    Those of the start, 60 m ahead, belong to the next intersection within 65 m. Of 3 + 3 of the
    end, the third and the sixth replace it.
    """
    settings = RangeFilter(sd_fraction=0.0, fade_m=0.0, restart_after=3)
    loop = approaches(Fusion(dissent_within_m=65.0), settings)
    pairs = [(60.0, 70.0)] * 2 + [(100.0, 110.0)] * 3 + [(100.0, 150.0)] * 3
    frames = [
        replace(frame(i, 0.0), signs=(sign(start_m), light(end_m)))
        for i, (start_m, end_m) in enumerate(pairs)
    ]

    start, end = run_steps(frames, loop)[-1].ranges

    assert (start.range_m, start.measured_m) == (60.0, None)
    assert (end.range_m, end.measured_m) == (150.0, 150.0)
    assert loop.counts == {
        "approaches opened": 1,
        "ranges waiting for a second observation": 2,
        "ranges refused: outside the gate": 6 + 4,
        "ranges restarted": 2,
    }


def test_published_presence_is_not_withdrawn_by_dissent() -> None:
    """Two roads of 0.77 establish it: 0.59 / 0.65 = 0.92. Then three cues dissent in two frames."""
    loop = approaches(Fusion(dissent=0.1))
    seen = [frame(0, road_left=1), frame(1, road_left=1), frame(2), frame(3)]

    steps = run_steps([replace(seen[0], signs=(sign(10.0),)), *seen[1:]], loop)

    for_it, against = 0.77**2 * 0.1**6, 0.23**2 * 0.9**6
    assert [one.established for one in steps] == [False, True, True, True]
    assert steps[-1].probabilities["left"] == pytest.approx(for_it / (for_it + against))


def test_isolated_false_detections_never_establish_presence() -> None:
    loop = approaches()
    noise = [frame(i, 1.0, road_left=int(i % 50 == 0)) for i in range(500)]

    taken = run_steps(noise, loop)

    assert not any(one.established for one in taken)
    assert loop.counts["approaches closed: neutral"] == loop.counts["approaches opened"] == 10


def test_gate_stays_closed_until_presence_is_established() -> None:
    quiet = [frame(i, 1.0, road_left=int(i == 0), parked_left=2, road_straight=1) for i in range(5)]
    shut = run_steps(quiet)[-1]

    assert not shut.established
    assert shut.probabilities == pytest.approx(
        {"intersection": 0.5, "left": 0.77, "right": 0.5, "straight": 0.5}
    )


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
    run_steps(seen[1:], approaches(Fusion(reference="end")), past=past)

    assert asked == ["end", "start", "end", "end", "start"]


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


def test_wait_of_unknown_length_at_a_light_in_view_is_one_approach() -> None:
    """A minute without odometry: nothing says that the car has driven on."""
    fusion = Fusion(kind="persistent")
    end = RangePosterior(Reference.END, 80.0, 100.0, 80.0)
    without = [
        FrameEvidence(i * FRAME_NS, None, 0.0, (), {**NONE_SEEN, "traffic_light": 1})
        for i in range(600)
    ]
    ranged = [replace(one, posteriors=(end,)) for one in without]
    at_times = [ranged[i] if i % 40 == 0 else one for i, one in enumerate(without)]

    for evidence in (without, ranged, at_times):
        loop = Approaches(graph_of(fusion), fusion, RangeFilter())
        numbers = {loop(one).approach for one in evidence}
        assert numbers - {None} == {1}


def by_shape(
    i: int, travelled_m: float | None = None, light: int = 0, **odds: float
) -> FrameEvidence:
    """A frame of a camera without calibration: log odds that a road to a side begins ahead."""
    counts = {f"road_{side}": 1 for side, one in odds.items() if one > 2.0}
    return replace(
        FrameEvidence(i * FRAME_NS, travelled_m, 0.0, (), {**counts, "traffic_light": light}),
        roads_ahead={
            f"road_{side}": one > 0.0 for side, one in odds.items() if not 0.0 < one < 2.0
        },
    )


STREET = [by_shape(i, left=3.0, right=-1.0) for i in range(5)]


def test_road_that_is_no_longer_ahead_is_passed_and_evidence_then_is_of_the_next() -> None:
    """Without motion, too: the time in which the evidence gets stale may be that to the next."""
    loop = approaches(Vehicle(version=1).fusion)
    gone = [by_shape(5, left=1.0), *(by_shape(i, left=-1.0, right=-1.0) for i in range(6, 15))]
    following = [by_shape(i, left=-1.0, right=3.0) for i in range(15, 20)]

    steps = run_steps([*STREET, *gone, *following], loop)

    assert [one.approach for one in steps] == [1] * 6 + [None] * 9 + [2] * 5
    assert steps[5].probabilities["left"] > 0.9
    assert steps[-1].probabilities["left"] == 0.5
    assert steps[-1].probabilities["right"] > 0.9
    assert loop.counts["approaches closed: passed"] == 1


@pytest.mark.parametrize(("left", "numbers"), [(3.0, {1}), (1.0, {1}), (-1.0, {1, 2})])
def test_road_that_comes_up_belongs_to_the_next_once_another_one_is_passed(
    left: float, numbers: set[int]
) -> None:
    """The second street begins within the network's reach behind the first, so none is free."""
    following = [by_shape(i, left=left, right=3.0) for i in range(5, 10)]
    loop = approaches(Vehicle(version=1).fusion)
    steps = run_steps([*STREET, *following], loop)
    assert {one.approach for one in steps} == numbers
    assert loop.counts.get("approaches closed: another ahead", 0) == len(numbers) - 1
    assert steps[-1].probabilities["right"] > 0.9
    assert (steps[-1].probabilities["left"] > 0.9) is (len(numbers) == 1)


def test_roads_seen_together_are_one_intersection_whichever_is_passed_first() -> None:
    both = [by_shape(i, left=3.0, right=3.0) for i in range(5, 10)]
    one_only = [by_shape(i, left=-1.0, right=3.0) for i in range(10, 15)]
    steps = run_steps([*STREET, *both, *one_only], approaches(Vehicle(version=1).fusion))
    assert {one.approach for one in steps} == {1}


GONE = range(5, 12)


@pytest.mark.parametrize(
    "gone",
    [
        pytest.param([by_shape(i, left=1.0) for i in GONE], id="undecided"),
        pytest.param([by_shape(i, light=1, left=-1.0) for i in GONE], id="light in view"),
        pytest.param(
            [replace(by_shape(i, left=-1.0), signs=(sign(30.0),)) for i in GONE], id="sign in view"
        ),
        pytest.param([by_shape(i, 0.0, left=-1.0) for i in GONE], id="standing"),
    ],
)
def test_approach_goes_on_while_its_end_is_not_seen(gone: list[FrameEvidence]) -> None:
    steps = run_steps([*STREET, *gone], approaches(Vehicle(version=1).fusion))
    assert {one.approach for one in steps} == {1}


def test_street_that_is_passed_before_a_light_is_no_leg_of_the_lights_intersection() -> None:
    light = [by_shape(i, light=1, left=-1.0, right=-1.0) for i in range(5, 12)]
    following = [by_shape(i, light=1, left=3.0, right=-1.0) for i in range(12, 17)]

    steps = run_steps([*STREET, *light, *following], approaches(Vehicle(version=1).fusion))

    assert {one.approach for one in steps} == {1}
    assert steps[4].probabilities["left"] > 0.9
    assert [one.probabilities["left"] for one in steps[5:12]] == pytest.approx([0.5] * 7)
    assert steps[5].probabilities["intersection"] == pytest.approx(0.5)
    assert steps[-1].probabilities["left"] == pytest.approx(steps[4].probabilities["left"])


def test_light_before_which_no_road_was_seen_is_not_passed_for_want_of_roads() -> None:
    frames = [by_shape(i, light=int(i < 5), left=-1.0, right=-1.0) for i in range(12)]
    steps = run_steps(frames, approaches(Vehicle(version=1).fusion))
    assert {one.approach for one in steps[2:]} == {1}
