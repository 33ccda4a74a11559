"""Cues of whole frames and their account of candidates: numbers by hand, and laws of any frame."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from crosscue.detectors import rle
from crosscue.detectors.base import Detections, RoadMask
from crosscue.detectors.boxes import box_ious
from crosscue.detectors.cues import frame
from crosscue.detectors.cues.candidates import (
    BELOW_SCORE,
    CUT_OR_FAR,
    ELSEWHERE,
    NOT_COUNTED,
    NOT_FOUND_BEFORE,
    NOT_FROM_THE_SIDE,
    NOT_PAST,
    OTHER_MOTION,
    REGION_NOT_SEEN,
    SAME_OBJECT,
    TOO_FEW_FRAMES,
    TOO_LITTLE_ROAD,
    Candidates,
    Count,
    count_by_label,
    label_scores,
    take,
    thresholds_met,
    unsure_of,
)
from crosscue.detectors.cues.cars import CarCandidates, Pairs, no_pairs
from crosscue.detectors.cues.frame import CuePass
from crosscue.detectors.cues.labelled import count, count_labels, count_own
from crosscue.detectors.cues.observed import (
    CarCounts,
    DetectorRole,
    FrameDetections,
    Place,
    RoadFractions,
    Sides,
    Ways,
    detector_role,
)
from crosscue.detectors.cues.rules import counts_of, rule_of
from crosscue.detectors.cues.same_object import KEPT, MIN_IOU, label_meanings, same_objects
from crosscue.detectors.cues.tracked.judge import count_cars
from crosscue.detectors.ranging.object_tracks import CarStep
from crosscue.replay.vehicle.cue_spec import CueSpec, Input
from crosscue.replay.vehicle.cue_table import CUES
from crosscue.replay.vehicle.vehicle import Camera, Cars, Cues, OwnCue, Regions, Vehicle

SIZE = (640, 480)
MS = 1_000_000
VEHICLE = Vehicle(
    version=1,
    cues=Cues(
        traffic_light_score=0.6,
        road_fraction=0.2,
        own={
            "crossing": OwnCue(labels=("zebra", "stripes"), score=0.3),
            "dogs": OwnCue(labels=("dog",), score=0.5),
        },
    ),
    cars=Cars(kind="pairs", labels=("car", "van"), score=0.5),
    regions=Regions(kind="picture"),
)
CAMERA = Camera(focal_px=500.0, center_px=(320.0, 240.0), x_m=1.0, z_m=1.5, pitch_sd_rad=0.0)
TRACKED = VEHICLE.model_copy(
    update={"cars": Cars(kind="tracks", score=0.5, max_gap_s=0.5), "camera": CAMERA}
)
EGO = CarStep(0.5, 0.0, 0.0, 0.1)
SIGN_CUES = ("one_way_left", "one_way_right", "do_not_enter")
PAIR_CUES = ("cross_traffic_left", "cross_traffic_right", "parked_left", "parked_right")
Thing = tuple[str, float]


def found(
    *things: Thing,
    boxes: Sequence[tuple[float, float, float, float]] = (),
    min_scores: Sequence[float] | None = None,
    t_ns: int = 0,
) -> Detections:
    """Build detections of 100 x 40 px, from labels and scores."""
    where = list(boxes) or [
        (5.0 + 150.0 * i, 5.0, 105.0 + 150.0 * i, 45.0) for i in range(len(things))
    ]
    return Detections(
        t_ns,
        SIZE,
        np.array(where, np.float64).reshape(-1, 4),
        np.array([score for _, score in things], np.float64),
        tuple(label for label, _ in things),
        (b"",) * len(things),
        min_scores=None if min_scores is None else np.array(min_scores),
    )


FEW = found(("car", 0.6), ("van", 0.5), ("dog", 0.9), ("car", 0.2))
MORE = found(("car", 0.7), ("dog", 0.4), min_scores=[0.8, 0.3])


def test_scores_and_thresholds_are_those_of_the_labels() -> None:
    """Cars: 0.6, 0.5 and 0.2 by a detector without thresholds, and 0.7 with a threshold of 0.8.

    Not above 0.5: 0.5 and 0.2. Without a setting, 0.7 is not above 0.8 either.
    """
    both, labels = (FEW, MORE), ("car", "van")

    assert label_scores(both, labels) == [0.6, 0.5, 0.2, 0.7]
    assert unsure_of(both, labels, 0.5) == {BELOW_SCORE: 2}
    assert unsure_of(both, labels, None) == {BELOW_SCORE: 3}
    decided = replace(FEW, decisions=("too far", "", "", ""))
    assert unsure_of([decided], labels, 0.4) == {"too far": 1, BELOW_SCORE: 1}
    assert count_labels(both, labels, 0.5) == 2
    assert count_labels(both, labels, None) == 1
    assert thresholds_met(both, labels, 0.4) == [0.4]
    assert thresholds_met(both, labels, 0.0) == [0.0]
    assert thresholds_met(both, labels, None) == [0.5, 0.5, 0.5, 0.8]
    assert thresholds_met(both, ("dog",), None) == [0.5, 0.3]


def test_lights_need_a_score_and_signs_only_their_label() -> None:
    """Lights of 0.6 and 0.7 with a threshold of 0.6: one. Signs of 0.01 and 0.9: both."""
    boxes = [
        found(("traffic light", 0.6), ("traffic light", 0.7)),
        found(("one way left", 0.01), ("one way left", 0.9), ("one way right", 0.9)),
    ]

    assert count(boxes, VEHICLE, CUES["traffic_light"]).number == 1
    assert count(boxes, VEHICLE, CUES["one_way_left"]).number == 2
    assert count(boxes, VEHICLE, CUES["one_way_right"]).number == 1


def test_candidates_are_seen_used_and_skipped() -> None:
    """3 seen, of which 2 skipped: 1 used. Then 2 seen and none skipped: in all 5 and 3."""
    one = Candidates("detections")
    one.take(Count(0, [], {"low": 0}))
    assert (one.seen, one.used, one.skipped, one.max_score) == (0, 0, {}, None)

    one.take(Count(1, [0.2, 0.4, 0.3], {"low": 1, "far": 1, "none": 0}))
    assert (one.seen, one.used, one.max_score) == (3, 1, 0.4)
    one.take(Count(2, [0.1, 0.3], {"low": 0}))
    assert one.max_score == 0.4
    one.take(Count(0, [0.9], {"low": 1}))

    assert (one.seen, one.used, one.max_score) == (6, 3, 0.9)
    assert one.skipped == {"low": 2, "far": 1}


def test_threshold_of_candidates_is_the_lowest() -> None:
    one = Candidates("detections")
    for thresholds, lowest in (((), None), ((0.5, 0.4), 0.4), ((0.6,), 0.4), ((0.3,), 0.3)):
        one.take(Count(0, thresholds=thresholds))
        assert one.threshold == lowest


def _numbers(observed_by: Input, observed: object) -> dict[str, int | None]:
    return {cue: one.number for cue, one in counts_of(observed_by, observed, VEHICLE).items()}


def _taken(observed_by: Input, observed: object) -> dict[str, Candidates]:
    """Return the candidates of every cue of one kind of input, in one frame."""
    found: dict[str, Candidates] = {}
    for cue, one in counts_of(observed_by, observed, VEHICLE).items():
        take(found, cue, one)
    return found


def test_number_of_a_rule_is_explained_by_the_labels_and_threshold_of_its_row(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A plug-in's rule returns a number: lights of 0.55 and 0.7, of which it counts one."""
    row = replace(CUES["traffic_light"], rule=f"{__name__}:one_of_them")
    monkeypatch.setitem(CUES, "traffic_light", row)

    lights = _taken("objects", [found(("traffic light", 0.55), ("traffic light", 0.7))])

    assert skipped(lights, "traffic_light") == (2, 1, {BELOW_SCORE: 1})
    monkeypatch.setitem(CUES, "do_not_enter", replace(CUES["do_not_enter"], rule=row.rule))
    signs = _taken("signs", [found(("no entry", 0.9))])
    assert skipped(signs, "do_not_enter") == (1, 1, {})
    left = replace(CUES["cross_traffic_left"], rule=row.rule)
    monkeypatch.setitem(CUES, "cross_traffic_left", left)
    assert "cross_traffic_left" not in _taken("car pairs", no_pairs(640))
    assert _numbers("car pairs", no_pairs(640))["cross_traffic_left"] == 1


def one_of_them(observed: object, vehicle: Vehicle, cue: CueSpec) -> int:
    """Return 1, as a plug-in's rule may."""
    return 1


def test_rules_are_found_by_module_and_function() -> None:
    assert rule_of("crosscue.detectors.cues.labelled:count") is count
    light = found(("traffic light", 0.7))
    assert _numbers("objects", [light]) == {"stop_sign": 0, "traffic_light": 1}
    assert list(counts_of("signs", [light], VEHICLE)) == [*SIGN_CUES]
    # The cars past the intersection are unknown.
    assert _numbers("car pairs", no_pairs(640)) == dict.fromkeys(PAIR_CUES, 0)


def road(fraction: float = 1.0) -> RoadMask:
    """Road in the left part of the picture."""
    size = (160, 120)
    is_road = np.zeros((120, 160), np.bool_)
    is_road[:, : round(160 * fraction)] = True
    return RoadMask(0, SIZE, rle.encode_mask(is_road, (0, 0), size), size)


def test_results_have_roles() -> None:
    cars, signs = found(("car", 0.9)), found(("stop sign", 0.9))
    first = road()
    frame = FrameDetections(7, (cars,), (signs,), first)

    assert frame.boxes == (cars, signs)
    assert frame.found == (cars, signs, first)
    assert FrameDetections(7, (cars,), road=RoadFractions(1, 1, 1)).found == (cars,)
    assert detector_role(first, True) == DetectorRole.ROAD
    assert detector_role(cars, True) == DetectorRole.SIGNS
    assert detector_role(cars, False) == DetectorRole.OBJECTS


def test_meaning_of_a_label_is_the_first_label_of_its_cue() -> None:
    meaning = label_meanings(VEHICLE)

    assert meaning["van"] == meaning["car"] == "car"
    assert meaning["stripes"] == "zebra"
    assert meaning["no entry"] == "do not enter"
    assert "cat" not in meaning


@pytest.mark.parametrize(
    ("width", "shift", "is_same"), [(100.0, 33.0, True), (100.0, 34.0, False), (90.0, 30.0, False)]
)
def test_same_object_overlaps_by_more_than_half(width: float, shift: float, is_same: bool) -> None:
    """67 / 133 = 0.504 and 66 / 134 = 0.493; 60 / 120 = 0.5 is another object."""
    one = found(("car", 0.9), boxes=[(0.0, 0.0, width, 40.0)])
    two = found(("van", 0.8), boxes=[(shift, 0.0, shift + width, 40.0)])
    same = same_objects((one, two), label_meanings(VEHICLE), (False, False))

    assert [a.tolist() for a in same] == [[KEPT], [0 if is_same else KEPT]]


def test_detection_is_the_same_as_the_one_that_overlaps_most() -> None:
    """Two kept cars 40 px apart; the other detector's is 10 px from the second one.

    90 / 110 = 0.82 with the second, 70 / 130 = 0.54 with the first. The next one, 30 px from the
    second, has 0.54 with it, which already stands for a car of its detector.
    """
    kept = [
        found(("car", 0.9), boxes=[(0.0, 0.0, 100.0, 40.0)]),
        found(("car", 0.8), boxes=[(40.0, 0.0, 140.0, 40.0)]),
    ]
    third = found(
        ("car", 0.7),
        ("car", 0.6),
        ("dog", 0.5),
        boxes=[(30.0, 0.0, 130.0, 40.0), (70.0, 0.0, 170.0, 40.0), (30.0, 0.0, 130.0, 40.0)],
    )

    again = same_objects((*kept, third), {}, (False,) * 3)

    assert [one.tolist() for one in again] == [[KEPT], [KEPT], [1, KEPT, KEPT]]
    assert {one.dtype for one in again} == {np.dtype(np.int64)}


def test_object_of_three_detectors_is_kept_once() -> None:
    """The best of three is kept; a calibrated score is the best; equal scores keep the first."""
    three = found(("car", 0.6)), found(("car", 0.9)), found(("car", 0.7))

    assert _again(three, (False, False, False)) == [[1], [KEPT], [1]]
    assert _again(three, (True, False, False)) == [[KEPT], [0], [0]]
    equal = found(("car", 0.6)), found(("car", 0.6))
    assert _again(equal, (False, False)) == [[KEPT], [0]]
    assert _again((found(("car", 0.6)), found()), (False, False)) == [[KEPT], []]


def _again(results: Sequence[Detections], calibrated: Sequence[bool]) -> list[list[int]]:
    return [one.tolist() for one in same_objects(results, {}, calibrated)]


def _cues(vehicle: Vehicle = VEHICLE) -> tuple[CuePass, dict[str, Candidates]]:
    cues = CuePass(vehicle)
    return cues, cues.candidates


def test_frame_counts_each_kind_of_cue() -> None:
    """1 sure light, 2 signs, 1 zebra and 1 dog; road fills the left and the straight region."""
    cues, tally = _cues()
    objects = found(("traffic light", 0.7), ("traffic light", 0.6), ("zebra", 0.4), ("dog", 0.5))
    signs = found(("one way left", 0.1), ("no entry", 0.2), ("dog", 0.6))

    made = cues(FrameDetections(0, (objects,), (signs,), road(0.65)))

    once = ("traffic_light", "one_way_left", "do_not_enter", "crossing", "dogs")
    counts = dict.fromkeys((*once, "road_left", "road_straight"), 1)
    assert made.counts == counts | dict.fromkeys(("stop_sign", "one_way_right", "road_right"), 0)
    assert made.road == RoadFractions(1.0, 1.0, 0.0)
    assert tally["crossing"].setting == "[cues.own.crossing] score"
    lights = tally["traffic_light"]
    assert (lights.used, lights.skipped) == (1, {BELOW_SCORE: 1})
    assert (lights.threshold, lights.setting) == (0.6, "[cues] traffic_light_score")
    assert cues(FrameDetections(1)).counts == {}
    assert cues(FrameDetections(1)).road is None


def test_only_cues_whose_labels_can_be_reported_are_counted() -> None:
    """Road has no label, so it always counts."""
    cues, _ = _cues()
    dog, road = (found(("dog", 0.9)),), RoadFractions(1, 0, 0)
    counts = cues(FrameDetections(0, dog, labels=frozenset({"dog", "van"}), road=road)).counts

    assert counts == {"dogs": 1, "road_left": 1, "road_straight": 0, "road_right": 0}


def test_an_unseen_road_is_no_count_and_one_picture_alone_shows_no_road_area() -> None:
    """The straight region is not seen; the accumulated road takes many frames together."""
    cues, tally = _cues()

    unknown = cues(FrameDetections(0, road=RoadFractions(1.0, math.nan, 0.0)))
    area, _ = _cues(VEHICLE.model_copy(update={"regions": Regions(kind="area")}))
    alone = area(FrameDetections(0, road=road()))

    assert unknown.counts == {"road_left": 1, "road_right": 0}
    assert tally["road_straight"].skipped == {REGION_NOT_SEEN: 1}
    straight = tally["road_straight"]
    assert (straight.seen, straight.used) == (1, 0)
    assert (straight.threshold, straight.setting, straight.unit) == (
        *(0.2, "[cues] road_fraction", "frames"),
    )
    assert alone.road is not None
    assert math.isnan(alone.road.left)
    assert alone.counts == {}


def test_cars_are_paired_with_the_previous_frame_until_restarted() -> None:
    """A car moves 4 px to the right, more than 0.002 * 640 = 1.28 px: it crosses to the right."""
    cues, _ = _cues()
    here = found(("car", 0.9), t_ns=0)

    def moved(t_ms: int) -> FrameDetections:
        x = 5.0 + t_ms / 25.0
        return FrameDetections(
            t_ms * MS, (found(("car", 0.9), boxes=[(x, 5.0, x + 100.0, 45.0)], t_ns=t_ms * MS),)
        )

    assert "cross_traffic_right" not in cues(FrameDetections(0, (here,))).counts
    assert cues(moved(100)).counts["cross_traffic_right"] == 1
    assert cues(moved(100)).counts["cross_traffic_right"] == 0  # not later
    assert cues(moved(200)).counts["cross_traffic_right"] == 1
    cues.restart()
    assert "cross_traffic_right" not in cues(moved(300)).counts


NO_ODOMETRY = "no odometry, so the camera's own motion is unknown"


@pytest.mark.parametrize(
    ("vehicle", "ego", "why"),
    [
        (TRACKED, None, NO_ODOMETRY),
        (TRACKED, CarStep(None, 0.0, 0.0, 0.1), NO_ODOMETRY),
        (TRACKED, CarStep(0.5, 0.0, 0.0, 0.51), "frames further than 0.5 s apart"),
        (TRACKED.model_copy(update={"camera": Camera()}), EGO, "camera.focal_px is not set"),
    ],
)
def test_frames_without_tracked_cars_are_counted_by_reason(
    vehicle: Vehicle, ego: CarStep | None, why: str
) -> None:
    cues, tally = _cues(vehicle)
    frame = FrameDetections(0, (found(("car", 0.9)),))
    cues(frame, EGO)
    for _ in range(2):
        assert "parked_left" not in cues(frame, ego).counts

    assert cues.followed() == []
    frames = 3 if "focal" in why else 2
    assert cues.not_followed == {why: frames}
    assert cues.notes() == {f"crossing and parked cars: {why}": frames}
    assert tally.get("cross_traffic_left", Candidates("detections")).seen == 3 - frames


def test_tracked_cars_are_those_of_the_newest_frame() -> None:
    """Half a second between frames is not too long; a gap forgets the cars."""
    cues, tally = _cues(TRACKED)
    assert cues.followed() == []
    frame = FrameDetections(0, (found(("car", 0.9)),))
    for _ in range(2):
        counts = cues(frame, EGO._replace(way_m=0.0, seconds=0.5)).counts

    (car,) = cues.followed()
    assert (car.frames, car.center_px, car.step_px) == (2, (55.0, 25.0), (0.0, 0.0))
    assert {name for name in counts if "cars" in name} == set()
    past = cues(frame, EGO._replace(way_m=0.0), Place(10.0, 20.0, 1.0)).counts
    assert (past["oncoming_cars"], past["outgoing_cars"]) == (0, 0)
    assert tally["oncoming_cars"].skipped == {NOT_PAST: 1}
    cues.restart()
    assert cues.followed() == []


def test_rules_get_the_tracked_cars_and_their_judgement(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of two cars, one stands and one moves by (6, 2) px; their noses are unknown.

    Centres are (55, 25) and (205 + 6, 25 + 2). They are judged with camera, settings and place.
    Both may be parked, and both are past the intersection in the third frame.
    """
    given: list[Pairs] = []
    judged_with: list[tuple[object, ...]] = []

    def rules(observed_by: str, observed: object, settings: object) -> dict[str, Count]:
        given.extend([observed] if isinstance(observed, Pairs) else [])
        return {}

    def judged_as(*arguments: object) -> CarCounts:
        judged_with.append(arguments)
        return count_cars(*arguments)  # type: ignore[arg-type]

    def past_as(*arguments: object) -> Ways:
        judged_with.append(arguments)
        return Ways(3, 4)

    def legs_as(*arguments: object) -> Sides:
        judged_with.append(arguments)
        return Sides(5, 6)

    monkeypatch.setattr(frame, "counts_of", rules)
    monkeypatch.setattr(frame, "count_cars", judged_as)
    monkeypatch.setattr(frame, "cars_past", past_as)
    monkeypatch.setattr(frame, "in_legs", legs_as)
    monkeypatch.setattr(frame, "may_be_parked", lambda seen, cars: True)
    monkeypatch.setattr(frame, "is_past", lambda one, *_: one.t_s == 1.5)
    cues, place = CuePass(TRACKED), Place(10.0, 26.0, 1.0)
    still = EGO._replace(way_m=0.0, seconds=0.5)
    boxes = [(5.0, 5.0, 105.0, 45.0), (161.0, 7.0, 261.0, 47.0), (400.0, 5.0, 500.0, 45.0)]
    for t in range(2):
        cues(FrameDetections(t, (found(("car", 0.9), ("car", 0.9)),)), still, place)
    cars = ("car", 0.9), ("car", 0.9), ("car", 0.4)
    last = found(*cars, boxes=boxes, min_scores=(0.3, 0.3, 0.3))
    cues(FrameDetections(2, (last,)), still, place)

    none, _, both = given
    assert none.step_px.shape == none.center_px.shape == (0, 2)
    assert none.nose.shape == (0,)
    assert sorted(both.step_px.tolist()) == [[0.0, 0.0], [6.0, 2.0]]
    assert sorted(both.center_px.tolist()) == [[55.0, 25.0], [211.0, 27.0]]
    assert both.nose.tolist() == [0, 0]
    assert both.nose.dtype == np.int64
    assert both.width_px == 640
    assert both.judged is not None
    assert (both.judged.seen, both.judged.past) == (2, Ways(3, 4))
    assert both.judged.in_leg == Sides(5, 6)
    assert (both.cars.low, both.cars.shapes) == (1, 0)
    for arguments in judged_with:
        assert arguments[-3:] in ((CAMERA, TRACKED.cars, place),)
    # Followed and standing cars, cars past the intersection, and followed cars, in each frame.
    numbers = [len(one) for args in judged_with for one in args if isinstance(one, list)]
    assert numbers == [0, 0, 0, 0, 2, 2, 0, 2, 2, 2, 2, 2]
    CuePass(VEHICLE)(FrameDetections(0, (found(("car", 0.9)),)))
    assert given[-1].width_px == 640


def test_controls_get_the_ego_motion_or_the_time_since_the_frame_before() -> None:
    """Without odometry only the time is known; it is 0 for the first frame and an earlier one."""
    given: list[CarStep] = []
    followed = (found(("stop sign", 0.7)),)

    def controls(objects: Sequence[Detections], motion: CarStep) -> tuple[Detections, ...]:
        given.append(motion)
        return followed

    cues, _ = _cues()
    cues.controls = controls  # type: ignore[assignment]
    for t_ms, ego in ((1000, None), (2500, None), (2000, None), (2100, EGO)):
        frame = FrameDetections(t_ms * MS, (found(("stop sign", 0.9)),))
        assert cues(frame, ego).objects is followed

    assert given == [*(CarStep(None, 0.0, 0.0, s) for s in (0.0, 1.5, 0.0)), EGO]


def skipped(tally: dict[str, Candidates], name: str) -> tuple[int, int, dict[str, int]]:
    one = tally[name]
    assert one.seen == one.used + sum(one.skipped.values())
    return one.seen, one.used, one.skipped


def test_labelled_candidates_are_below_the_score_or_not_counted() -> None:
    """Lights 0.5, 0.6, 0.7 and 0.8 with 0.6: 2 are low; a rule counts 1, or 9, of the other 2."""
    lights = found(*[("traffic light", score) for score in (0.5, 0.6, 0.7, 0.8)])
    setting = "[cues] traffic_light_score"

    few = count_by_label([lights], ["traffic light"], 1, setting, 0.6)
    many = count_by_label([lights], ["traffic light"], 9, setting, 0.6)

    assert (few.number, many.number) == (1, 9)
    assert few.skipped == {BELOW_SCORE: 2, NOT_COUNTED: 1}
    assert many.skipped == {BELOW_SCORE: 2, NOT_COUNTED: 0}
    assert (few.setting, few.thresholds, few.unit) == (setting, [0.6], "detections")
    free = count_by_label([lights], ["traffic light"], 1, None, None)
    assert (free.skipped, free.setting, free.thresholds) == ({NOT_COUNTED: 3}, None, ())


def test_signs_have_no_threshold() -> None:
    signs = _taken("signs", [found(("one way left", 0.1))])

    assert skipped(signs, "one_way_left") == (1, 1, {})
    assert (signs["one_way_left"].setting, signs["one_way_left"].threshold) == (None, None)


def test_own_cues_have_their_own_score() -> None:
    """Zebras of 0.3 and 0.4 with 0.3: one is low."""
    things = [found(("stripes", 0.3), ("zebra", 0.4), ("dog", 0.9))]

    made = count_own(things, "crossing", VEHICLE.cues.own["crossing"])

    assert (made.number, made.scores) == (1, [0.3, 0.4])
    assert made.skipped == {BELOW_SCORE: 1, NOT_COUNTED: 0}
    assert (made.setting, made.thresholds) == ("[cues.own.crossing] score", [0.3])


def _pairs(cars: CarCandidates, judged: CarCounts | None = None) -> Pairs:
    """Four cars, of which one moves to the left and the others away."""
    steps = np.array([[-9.0, 0.0], [0.0, 9.0], [0.0, 9.0], [0.0, 9.0]])
    return Pairs(steps, np.zeros((4, 2)), np.zeros(4, np.int64), 640, judged, cars)


# 11 cars, of which 2 are not above 0.5; 7 are seen from the side.
CARS = CarCandidates((*[0.9] * 9, 0.5, 0.4), 2, (0.5,), 7)


def test_pairs_are_skipped_by_the_first_rule_that_fails() -> None:
    """11 cars: 2 low; 7 of 9 from the side; 4 of 7 found before; 1 and 0 cross."""
    tally = _taken("car pairs", _pairs(CARS))

    assert set(tally) == {*PAIR_CUES}
    before = {BELOW_SCORE: 2, NOT_FROM_THE_SIDE: 2, NOT_FOUND_BEFORE: 3}
    assert skipped(tally, "cross_traffic_left") == (11, 1, before | {OTHER_MOTION: 3})
    assert skipped(tally, "cross_traffic_right") == (11, 0, before | {OTHER_MOTION: 4})
    assert skipped(tally, "parked_left") == (11, 0, before | {OTHER_MOTION: 4})
    made = tally["cross_traffic_left"]
    assert (made.unit, made.setting, made.threshold) == ("detections", "[cars] score", 0.5)
    assert made.max_score == 0.9


@pytest.mark.parametrize(
    ("cars", "low", "threshold"),
    [(Cars(kind="pairs"), 1, 0.7), (Cars(kind="pairs", score=0.8), 1, 0.8)],
)
def test_score_of_cars_that_is_set_replaces_the_detectors(
    cars: Cars, low: int, threshold: float
) -> None:
    """0.7 and 0.9: one is not above the detector's 0.7, nor above 0.8."""
    cues, tally = _cues(VEHICLE.model_copy(update={"cars": cars}))

    cues(FrameDetections(0, (found(("car", 0.7), ("car", 0.9), min_scores=[0.7, 0.7]),)))

    assert tally["parked_left"].skipped[BELOW_SCORE] == low
    assert tally["parked_left"].threshold == threshold


def test_followed_cars_are_skipped_by_the_first_rule_that_fails() -> None:
    """11 cars: 2 low; 8 of 9 complete; 6 of 8 followed.

    Crossing left: 1 here and 2 elsewhere of 6, so 3 move otherwise. Right: 2 and 1. Parked left: 0
    and 3; right: 4 and 0. Past: 2 of 9 outgoing and 3 oncoming, where a place is known.
    """
    judged = CarCounts(Sides(1, 2), Sides(0, 4), Sides(2, 1), Sides(3, 0), 8, 6)

    tally = _taken("car pairs", _pairs(CARS, judged._replace(past=Ways(3, 2))))

    before = {BELOW_SCORE: 2, CUT_OR_FAR: 1, TOO_FEW_FRAMES: 2, OTHER_MOTION: 3}
    assert skipped(tally, "cross_traffic_left") == (11, 1, before | {ELSEWHERE: 2})
    assert skipped(tally, "cross_traffic_right") == (11, 2, before | {ELSEWHERE: 1})
    assert skipped(tally, "parked_left") == (11, 0, before | {ELSEWHERE: 3})
    assert skipped(tally, "parked_right") == (11, 4, before | {OTHER_MOTION: 2})
    assert skipped(tally, "outgoing_cars") == (11, 2, {BELOW_SCORE: 2, NOT_PAST: 7})
    assert skipped(tally, "oncoming_cars") == (11, 3, {BELOW_SCORE: 2, NOT_PAST: 6})
    assert tally["outgoing_cars"].threshold == 0.5
    assert "oncoming_cars" not in _taken("car pairs", _pairs(CARS, judged))


def test_doubles_are_skipped_for_cues_that_were_counted() -> None:
    """Of a dog and two cars in the second frame, the dog's cue has a count, and so have cars."""
    cues, tally = _cues()
    cues(FrameDetections(0, (found(),)))
    doubles = (found(("dog", 0.9), ("car", 0.4), ("van", 0.95)),)

    cues(FrameDetections(100 * MS, (found(t_ns=100 * MS),), doubles=doubles))

    assert skipped(tally, "parked_left") == (2, 0, {SAME_OBJECT: 2})
    assert tally["parked_left"].max_score == 0.95
    assert skipped(tally, "dogs") == (1, 0, {SAME_OBJECT: 1})
    assert skipped(tally, "traffic_light") == (0, 0, {})


def test_road_is_a_candidate_of_its_side() -> None:
    """Fractions 0.2, not above 0.2; 0.21; and 0, where no road was found. Then none is seen."""
    tally = _taken("road", RoadFractions(0.2, 0.21, 0.0))

    assert set(tally) == {"road_left", "road_straight", "road_right"}
    assert skipped(tally, "road_left") == (1, 0, {TOO_LITTLE_ROAD: 1})
    assert skipped(tally, "road_straight") == (1, 1, {})
    assert skipped(tally, "road_right") == (0, 0, {})
    made = tally["road_left"]
    assert (made.unit, made.setting, made.threshold) == ("frames", "[cues] road_fraction", 0.2)
    assert made.max_score == 0.2

    unseen = _taken("road", RoadFractions(math.nan, 0.1, 1.0))
    assert skipped(unseen, "road_left") == (1, 0, {REGION_NOT_SEEN: 1})
    assert unseen["road_left"].max_score == 0.0
    assert skipped(unseen, "road_straight") == (1, 0, {TOO_LITTLE_ROAD: 1})
    numbers = _numbers("road", RoadFractions(math.nan, 0.1, 1.0))
    assert numbers == {"road_left": None, "road_straight": 0, "road_right": 1}


def test_frames_are_explained_by_the_detectors_that_ran() -> None:
    """A car of unknown nose, in two frames: first not found before, then moving otherwise.

    Its double is skipped where the cue has a count. Each frame has a dog, one below 0.5, and one
    more as a double.
    """
    cues, tally = _cues()
    car = found(("car", 0.9), ("dog", 0.9))
    signs = found(("one way left", 0.9), ("dog", 0.1))
    for t_ms in (0, 100):
        cues(FrameDetections(t_ms * MS, (replace(car, t_ns=t_ms * MS),), (signs,), doubles=(car,)))

    each = dict.fromkeys((NOT_FOUND_BEFORE, OTHER_MOTION, SAME_OBJECT), 1)
    assert skipped(tally, "parked_left") == (3, 0, each)
    assert skipped(tally, "dogs") == (6, 2, {BELOW_SCORE: 2, SAME_OBJECT: 2})
    assert skipped(tally, "one_way_left") == (2, 2, {})
    assert skipped(tally, "traffic_light") == (0, 0, {})


@pytest.mark.parametrize("vehicle", [VEHICLE, TRACKED])
@pytest.mark.parametrize(
    ("labels", "is_explained"), [({"car"}, True), ({"dog"}, False), (None, True)]
)
def test_cars_are_explained_if_a_detector_can_report_them(
    vehicle: Vehicle, labels: set[str] | None, is_explained: bool
) -> None:
    cues, tally = _cues(vehicle)
    reported = None if labels is None else frozenset(labels)

    cues(FrameDetections(0, (found(("car", 0.9)),), labels=reported), EGO)

    assert ("parked_left" in tally) == is_explained
    cues(FrameDetections(0, (), (found(("car", 0.9)),), labels=reported), EGO)
    if is_explained:
        assert tally["parked_left"].seen == 1


# A label, a score, the left edge and the width.
Shown = list[tuple[str, float, float, float]]


def shown(*labels: str, width: st.SearchStrategy[float]) -> st.SearchStrategy[Shown]:
    score, left = st.floats(0.0, 1.0), st.floats(0.0, 60.0)
    return st.lists(st.tuples(st.sampled_from(labels), score, left, width), max_size=5)


def objects_of(things: Shown, t_ns: int = 0) -> Detections:
    boxes = [(left, 5.0, left + width, 45.0) for _, _, left, width in things]
    return found(*[(label, score) for label, score, *_ in things], boxes=boxes, t_ns=t_ns)


CUE_LABELS = ("traffic light", "stop sign", "car", "zebra", "one way left", "dog", "cat")
FRAMES = st.lists(shown(*CUE_LABELS, width=st.floats(5.0, 300.0)), min_size=1, max_size=4)
# Groups of cues that need the place of an intersection.
UNPLACED = ("cars_past", "leg_traffic", "map")


@given(FRAMES, FRAMES, st.sampled_from([VEHICLE, TRACKED]))
def test_used_and_skipped_candidates_add_up_for_every_cue(
    objects: list[Shown], signs: list[Shown], vehicle: Vehicle
) -> None:
    cues, tally = _cues(vehicle)
    counted: dict[str, int] = {}
    for t, (some, others) in enumerate(zip(objects, signs, strict=False)):
        t_ns = 100 * t * MS
        seen = FrameDetections(t_ns, (objects_of(some, t_ns),), (objects_of(others, t_ns),))
        for cue, number in cues(seen, EGO).counts.items():
            counted[cue] = counted.get(cue, 0) + number

    for name, one in tally.items():
        skipped(tally, name)
        assert all(number > 0 for number in one.skipped.values())
        assert one.used == counted.get(name, 0)
    evaluated = {
        name
        for name, cue in CUES.items()
        if cue.observed_by not in ("road", "mobileye") and cue.group not in UNPLACED
    }
    assert set(tally) == evaluated | {"crossing", "dogs"}


OBJECTS = shown("car", "van", "stop sign", "no entry", "do not enter", "cat", width=st.just(20.0))


@given(st.lists(OBJECTS, min_size=1, max_size=3))
def test_dropped_detection_overlaps_a_kept_one_of_another_detector(results: list[Shown]) -> None:
    boxes = [objects_of(things) for things in results]
    same = same_objects(boxes, label_meanings(VEHICLE), (False,) * len(boxes))

    for k, (one, whose) in enumerate(zip(boxes, same, strict=True)):
        for i, other in enumerate(whose.tolist()):
            if other == KEPT:
                continue
            assert other != k
            assert any(
                same[other][j] == KEPT
                and box_ious(one.boxes_px[i], boxes[other].boxes_px[j]) > MIN_IOU
                and boxes[other].scores[j] >= one.scores[i]
                for j in range(len(boxes[other]))
            )
