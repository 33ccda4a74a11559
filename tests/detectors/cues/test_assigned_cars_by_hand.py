"""Assignment of boxes to tracked cars: every limit, with numbers worked out by hand.

The focal length is 800 px, so a car of 1.55 m that is 62 px high is 800 * 1.55 / 62 = 20 m ahead.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from crosscue.detectors import rle
from crosscue.detectors.base import Detections
from crosscue.detectors.cues.tracked.motion import CarMotion, Observation, motions_of
from crosscue.detectors.cues.tracked.tracks import CarTracks, are_hidden, past_within_m
from crosscue.detectors.ranging.ground_plane import GroundPlane
from crosscue.detectors.ranging.object_tracks import CarStep
from crosscue.replay.vehicle.vehicle import Camera, Cars

SIZE = (1280, 720)
CAMERA = Camera(x_m=1.5, z_m=1.5, focal_px=800.0, center_px=(640.0, 360.0), pitch_rad=0.0)
RULES = Cars(kind="tracks", score=0.5, within_m=100.0, max_gap_s=0.5, max_frames=10)
STILL = CarStep(0.0, 0.0, 0.0, 0.1)
Box = tuple[float, float, float, float]
# 20 m ahead; its ends are 40 / 800 to the left and 84 / 800 to the right.
CAR: Box = (600.0, 300.0, 724.0, 362.0)


def found(*boxes: Box, scores: Sequence[float] | None = None, **changes: Any) -> Detections:
    n = len(boxes)
    made: dict[str, Any] = {"labels": ("car",) * n, "masks": (b"",) * n, **changes}
    return Detections(
        0, SIZE, np.array(boxes).reshape(-1, 4), np.array(scores or [0.9] * n, float), **made
    )


def moved(dx: float = 0.0, dy: float = 0.0, box: Box = CAR) -> Box:
    return box[0] + dx, box[1] + dy, box[2] + dx, box[3] + dy


def sized(height: float) -> Box:
    """A car of this height with the same centre and width."""
    return 600.0, 331.0 - height / 2.0, 724.0, 331.0 + height / 2.0


def followed(*frames: Detections, ego: CarStep = STILL, rules: Cars = RULES) -> list[CarMotion]:
    """Cars of the last frame."""
    tracks = CarTracks(CAMERA, rules)
    for frame in frames:
        cars = tracks([frame], ego)
    return cars


def observation(k: int, box: Box, **changes: Any) -> Observation:
    """Observe a box in frame k, with a camera that stands."""
    x0, y0, x1, y1 = box
    height = y1 - y0
    edges = math.atan((x0 - 640.0) / 800.0), math.atan((x1 - 640.0) / 800.0)
    error = math.hypot(1.0 / height, 0.03)
    one = Observation(
        0.1 * k, (1.5, 0.0, 0.0), edges, 1240.0 / height, error, (x1 - x0) / height, 0
    )
    return one._replace(**changes)


def same_motion(made: CarMotion, expected: CarMotion) -> bool:
    """Compare the numbers of two cars, within rounding."""
    return all(
        a == pytest.approx(b, rel=1e-6, abs=1e-9) for a, b in zip(made, expected, strict=True)
    )


def test_car_seen_twice_has_place_box_and_step() -> None:
    """(590, 300, 724, 362) after the box above: its centre moved by -5 px."""
    wider = (590.0, 304.0, 724.0, 366.0)

    (made,) = followed(found(CAR), found(wider))

    assert made.step_px == (-5.0, 4.0)
    assert (made.number, made.frames, made.box_px) == (1, 2, wider)
    assert made.distance_m == 20.0
    assert made.bearing == pytest.approx((-50.0 + 84.0) / 1600.0)
    (expected,) = motions_of([[observation(1, CAR), observation(2, wider)]])
    assert same_motion(made, expected._replace(number=1, box_px=wider, step_px=(-5.0, 4.0)))


def test_car_is_placed_with_the_cameras_pose() -> None:
    """Each step is 2 m in a bend of 0.2 rad: (2 cos 0.1, 2 sin 0.1), then 2 m along 0.3 rad.

    The camera is 1.5 m ahead of the axle, along 0.2 and 0.4 rad.
    """
    ego = CarStep(2.0, 0.0, 0.2, 0.1)
    first = 2.0 * math.cos(0.1), 2.0 * math.sin(0.1)
    second = first[0] + 2.0 * math.cos(0.3), first[1] + 2.0 * math.sin(0.3)
    poses = [
        (first[0] + 1.5 * math.cos(0.2), first[1] + 1.5 * math.sin(0.2), 0.2),
        (second[0] + 1.5 * math.cos(0.4), second[1] + 1.5 * math.sin(0.4), 0.4),
    ]

    (made,) = followed(found(CAR), found(CAR), ego=ego)

    (expected,) = motions_of([[observation(k + 1, CAR, pose=pose) for k, pose in enumerate(poses)]])
    assert same_motion(made, expected._replace(number=1, box_px=CAR))


def test_distance_is_along_the_ego_vehicle_for_a_turned_camera() -> None:
    """At a yaw of 0.5 rad the depth of 20 m is 20 * cos(0.5) m ahead for a car on the axis."""
    turned = CAMERA.model_copy(update={"yaw_rad": 0.5})
    middle = (609.0, 329.0, 671.0, 391.0)
    tracks = CarTracks(turned, RULES)
    tracks([found(middle, moved(300.0))], STILL)

    made, _ = tracks([found(middle, moved(300.0))], STILL)

    assert made.distance_m == pytest.approx(20.0 * math.cos(0.5), rel=1e-3)
    assert made.bearing == pytest.approx(math.tan(-0.5), rel=1e-2)
    behind = CarTracks(CAMERA.model_copy(update={"yaw_rad": math.pi}), RULES)
    behind([found(middle)], STILL)
    assert behind.seen == 0
    # At 60 degrees to the left, a car at the left edge is behind, and one in the middle is not.
    aside = CarTracks(CAMERA.model_copy(update={"yaw_rad": math.pi / 3}), RULES)
    aside([found(middle, moved(-590.0, box=middle))], STILL)
    assert aside.seen == 1


@pytest.mark.parametrize("center_px", [(600.0, 400.0), None])
def test_ends_of_a_car_are_seen_at_half_its_height(center_px: tuple[float, float] | None) -> None:
    """The camera is pitched and rolled; ``GroundPlane`` converts pixels to directions."""
    tilted = CAMERA.model_copy(update={"pitch_rad": 0.3, "roll_rad": 0.4, "center_px": center_px})
    box = (700.0, 500.0, 824.0, 562.0)
    tracks = CarTracks(tilted, RULES)
    tracks([found(box)], STILL)

    (made,) = tracks([found(box)], STILL)

    (left, right) = GroundPlane.of(tilted, SIZE).rays(np.array([[700.0, 531.0], [824.0, 531.0]]))
    assert made.distance_m == pytest.approx(20.0 * (left[0] + right[0]) / 2.0)
    assert made.bearing == pytest.approx(-(left[1] / left[0] + right[1] / right[0]) / 2.0)


@pytest.mark.parametrize(
    ("box", "is_seen"),
    [
        ((2.0, 300.0, 126.0, 362.0), True),
        ((1.9, 300.0, 126.0, 362.0), False),
        ((600.0, 2.0, 724.0, 64.0), True),
        ((600.0, 1.9, 724.0, 64.0), False),
        ((1154.0, 300.0, 1278.0, 362.0), True),
        ((1154.0, 300.0, 1278.1, 362.0), False),
        ((600.0, 656.0, 724.0, 718.0), True),
        ((600.0, 656.0, 724.0, 718.1), False),
        ((600.0, 300.0, 600.0, 362.0), False),
        ((600.0, 300.0, 724.0, 300.0), False),
        ((600.0, 362.0, 724.0, 300.0), False),
        ((600.0, 300.0, 600.5, 362.0), True),
        (sized(12.41), True),  # 99.9 m
        (sized(12.39), False),  # 100.1 m
    ],
)
def test_car_is_seen_completely_within_100_metres(box: Box, is_seen: bool) -> None:
    """At least 2 px from each edge of 1280 x 720 px; 1,240 / 12.4 = 100 m."""
    tracks = CarTracks(CAMERA, RULES)

    assert tracks([found(box)], STILL) == []

    assert tracks.seen == is_seen


def test_cars_without_a_focal_length_are_not_seen() -> None:
    tracks = CarTracks(CAMERA.model_copy(update={"focal_px": None}), RULES)
    tracks([found(CAR)], STILL)

    assert tracks.seen == 0
    short = CarTracks(CAMERA.model_copy(update={"focal_px": 1.0}), RULES)
    short([found((600.0, 300.0, 602.0, 301.0))], STILL)
    assert short.seen == 1


def test_distance_of_cars_past_is_120_metres_or_15_pixels() -> None:
    """15 px are 1.55 * f / 15: 82.7 m with 800 px and 155 m with 1,500 px."""
    assert past_within_m(CAMERA, RULES) == 120.0
    assert past_within_m(CAMERA.model_copy(update={"focal_px": 1500.0}), RULES) == 155.0
    assert past_within_m(Camera(), RULES) == 120.0
    assert past_within_m(CAMERA, Cars(past_within_m=50.0)) == 50.0


def test_cars_of_all_detectors_with_the_label_count() -> None:
    tracks = CarTracks(CAMERA, RULES)
    dog = found(moved(300.0), labels=("dog",))
    unsure = found(moved(-300.0), scores=[0.5])

    tracks([found(CAR), dog, found(moved(0.0, 150.0)), unsure], STILL)

    assert tracks.seen == 2


def test_unsure_box_continues_a_track_and_begins_none() -> None:
    """0.5 is not above 0.5. The car is reported again when it is sure, with all three boxes."""
    tracks = CarTracks(CAMERA, RULES)
    assert tracks([found(CAR, scores=[0.5])], STILL) == []
    assert tracks([found(CAR)], STILL) == []
    assert tracks([found(CAR, scores=[0.5])], STILL) == []
    assert tracks.longer() == tracks.standing() == []
    (made,) = tracks([found(CAR)], STILL)
    assert len(tracks.longer(lambda seen: len(seen) == 3)) == 1
    assert tracks.standing(lambda seen: len(seen) != 3) == []

    assert (made.number, made.frames) == (1, 3)
    assert [one.frames for one in tracks.longer()] == [3]


NARROW: Box = (600.0, 300.0, 670.0, 362.0)


@pytest.mark.parametrize(
    ("first", "second", "is_continued"),
    [
        # Shifted by s, (124 - s) / (124 + s) > 0.4 if s < 53.14; of 70 px by 30, 40 / 100 = 0.4.
        (CAR, moved(53.0), True),
        (CAR, moved(53.2), False),
        (NARROW, moved(30.0, box=NARROW), False),
        # Heights are within 62 / 1.4 = 44.29 and 62 * 1.4 = 86.8; 70 / 50 = 1.4.
        (CAR, sized(44.4), True),
        (CAR, sized(44.2), False),
        (CAR, sized(86.7), True),
        (CAR, sized(86.9), False),
        (sized(70.0), sized(50.0), False),
        (sized(50.0), sized(70.0), False),
    ],
)
def test_unsure_box_overlaps_the_prediction_and_hardly_grows(
    first: Box, second: Box, is_continued: bool
) -> None:
    (made,) = followed(found(first), found(second, scores=[0.4]), found(first))

    assert made.frames == 2 + is_continued


@pytest.mark.parametrize("longest", ["max_frames", "parked_frames", "past_frames"])
def test_as_many_frames_are_stored_as_the_longest_fit_needs(longest: str) -> None:
    """Of 8 frames, the longest fit uses 6 and the others 3."""
    lengths = dict.fromkeys(("max_frames", "parked_frames", "past_frames"), 3) | {longest: 6}
    tracks = CarTracks(CAMERA, RULES.model_copy(update=lengths))
    for _ in range(8):
        cars = tracks([found(CAR)], STILL)

    frames = cars[0].frames, tracks.standing()[0].frames, tracks.longer()[0].frames
    assert frames == tuple(lengths.values())


def test_score_of_the_vehicle_file_decides_which_cars_are_sure() -> None:
    """0.7 is above the default of 0.5, but not above 0.8. At exactly 20 m a car is near enough."""
    tracks = CarTracks(CAMERA, RULES.model_copy(update={"score": 0.8, "within_m": 20.0}))
    assert tracks.seen == 0
    assert tracks.longer() == tracks.standing() == []

    tracks([found(CAR, moved(0.0, 150.0), scores=[0.7, 0.9])], STILL)

    assert tracks.seen == 1


@pytest.mark.parametrize(
    ("last", "is_continued"), [(97.9, True), (98.3, False), (-7.9, True), (-8.3, False)]
)
def test_prediction_follows_the_smoothed_steps(last: float, is_continued: bool) -> None:
    """Steps of 10 and 20 px: the speed is 10, then 10 + 0.5 * (20 - 10) = 15 px a frame.

    30 + 15 = 45 is predicted, so boxes from 45 - 53.14 = -8.14 to 98.14 continue the track.
    """
    boxes = [found(CAR), found(moved(10.0)), found(moved(30.0))]
    (made,) = followed(*boxes, found(moved(last), scores=[0.4]), found(moved(45.0)))

    assert made.frames == 4 + is_continued


@pytest.mark.parametrize(("gap", "is_same_car"), [(4, True), (5, False)])
def test_car_is_forgotten_after_half_a_second(gap: int, is_same_car: bool) -> None:
    """The fourth empty frame is 4 * 0.125 = 0.5 s later; the fifth ends the track."""
    tracks = CarTracks(CAMERA, RULES)
    for frame in (found(CAR), *[found()] * gap):
        tracks([frame], STILL._replace(seconds=0.125))

    made = tracks([found(CAR)], STILL._replace(seconds=0.125))

    assert (len(made) == 1) == is_same_car


NEARER: Box = (560.0, 240.0, 808.0, 364.0)
ASIDE: Box = (1000.0, 300.0, 1124.0, 362.0)


@pytest.mark.parametrize(
    ("first", "second", "way_m", "is_same_car"),
    [
        # A car is followed to the distance of cars past, 1,240 / 10.33 = 120 m.
        (sized(10.34), sized(10.34), 0.0, True),
        (sized(10.32), sized(10.32), 0.0, False),
        # At 25 m/s it moves sideways by 25 * 0.1 + 0.5 = 3 m, at 20 m 3 * 800 / 20 = 120 px.
        (CAR, moved(119.0), 0.0, True),
        (CAR, moved(121.0), 0.0, False),
        (CAR, moved(-121.0), 0.0, False),
        # At 85 px it is 14.588 m ahead: |ln(14.588 / 20)| = 0.3155, below
        # 4 * sqrt((1 / 85)**2 + 0.03**2) + ln(1 + 3 / 14.588) = 0.1289 + 0.1870 = 0.3159.
        (CAR, (750.0, 300.0, 900.0, 385.0), 0.0, True),
        # At 85.2 px 0.3178 is above 0.1289 + 0.1874 = 0.3163.
        (CAR, (750.0, 300.0, 900.0, 385.2), 0.0, False),
        # A standing car that is 10 m nearer is twice as high, and its ends are twice as far from
        # the centre. The boxes overlap by 0.25 only. After 20 m it would be beside the camera.
        (CAR, NEARER, 10.0, True),
        (CAR, NEARER, 0.0, False),
        (CAR, NEARER, 20.0, False),
        (CAR, NEARER, 25.0, False),
        # After 19.2 m it is 0.8 m ahead, and a box of 700 px looks 1.771 m away:
        # ln(1.771 / 0.8) = 0.795 < 4 * 0.03 + ln(1 + 3 / 1.771) = 1.11.
        (CAR, (200.0, 10.0, 1000.0, 710.0), 19.2, True),
        # A car at 20 m is from 9.0 to 12.1 m to the right, and one of 85 px, at 14.588 m, from
        # 3.67 m. Scaled by 14.588 / 20, it stood from 6.56 to 8.83 m, so it moved by 2.9 m.
        (ASIDE, (841.0, 300.0, 965.0, 385.0), 0.0, True),
        (ASIDE, (831.0, 300.0, 955.0, 385.0), 0.0, False),
    ],
)
def test_box_is_of_a_car_that_may_have_moved_there(
    first: Box, second: Box, way_m: float, is_same_car: bool
) -> None:
    made = followed(found(first), found(second), ego=CarStep(way_m, 0.0, 0.0, 0.1))

    assert (len(made) == 1) == is_same_car


def test_distance_of_a_standing_car_is_the_mean_of_its_ends() -> None:
    """The camera turns by 0.3 rad: the ends are 19.34 and 18.42 m ahead, 18.88 m on average.

    At 51.2 px, 24.22 m, it is |ln(24.22 / 18.88)| = 0.249, below 0.143 + ln(1 + 3 / 24.22) = 0.260.
    """
    second = (850.0, 300.0, 974.0, 351.2)

    assert followed(found(CAR), found(second), ego=CarStep(0.0, 0.0, 0.3, 0.1))


def test_cars_are_followed_to_exactly_the_larger_distance() -> None:
    rules = RULES.model_copy(update={"within_m": 10.0, "past_within_m": 20.0})

    assert followed(found(CAR), found(CAR), rules=rules)


def test_each_box_continues_the_track_it_fits_best() -> None:
    """Two cars 30 px apart move by 5 px each, although one is then 25 px from the other."""
    second = moved(30.0)
    made = followed(found(CAR, second), found(moved(35.0), moved(5.0)))

    assert sorted((car.number, car.step_px) for car in made) == [(1, (5.0, 0.0)), (2, (5.0, 0.0))]
    (one,) = followed(found(CAR, second), found(moved(28.0)))
    assert (one.number, one.step_px) == (2, (-2.0, 0.0))
    (one,) = followed(found(CAR), found(moved(20.0), moved(2.0)))
    assert (one.number, one.step_px) == (1, (2.0, 0.0))
    both = followed(*[found(CAR), found(CAR, moved(400.0))] * 2)
    assert sorted(one.number for one in both) == [1, 2]


@pytest.mark.parametrize("moves", [2, 6])
def test_motion_uses_the_newest_frames_and_fewer_if_it_is_unsteady(moves: int) -> None:
    """A car stands, then moves by 60 px a frame: longer fits halve the frames, to at least 3.

    With 2 moves, 13, 6, 8 and 4 frames are unsteady. With 6, the newest 4 are steady, but not for a
    car on the ego vehicle's road, which hardly moves sideways.
    """
    rules = RULES.model_copy(update={"max_frames": 3, "parked_frames": 8, "past_frames": 13})
    boxes = [CAR] * 12 + [moved(60.0 * (k + 1)) for k in range(moves)]
    seen = [observation(k + 1, box) for k, box in enumerate(boxes)]
    tracks = CarTracks(CAMERA, rules)
    for box in boxes:
        cars = tracks([found(box)], STILL)

    def fitted(counts: Sequence[int], aside_mps: float) -> CarMotion:
        for count in counts:
            (made,) = motions_of([seen[-count:]], aside_mps)
            if made.is_steady:
                break
        return made._replace(number=1, box_px=boxes[-1], step_px=(60.0, 0.0))

    assert [one.frames for one in cars] == [3]
    assert same_motion(cars[0], fitted([3], 10.0))
    assert tracks.longer()[0].frames == 3
    assert tracks.standing()[0].frames == (3 if moves == 2 else 4)
    assert same_motion(tracks.longer()[0], fitted([13, 6, 3], 0.3))
    assert same_motion(tracks.standing()[0], fitted([8, 4, 3], 10.0))
    assert not motions_of([seen[-13:]], 0.3)[0].is_steady
    assert not motions_of([seen[-8:]], 10.0)[0].is_steady


def test_nose_and_cover_of_a_car_are_observed() -> None:
    """A mask whose left quarter is lower; a lower box, 3 px below, covers the lower end."""
    drawn = np.ones((62, 124), np.bool_)
    drawn[:40, :31] = False
    masks = (rle.encode_mask(drawn, (600, 300), SIZE), b"")
    front = (640.0, 303.0, 764.0, 365.0)
    frame = found(CAR, front, masks=masks)

    behind, ahead = sorted(followed(frame, frame), key=lambda one: one.number)

    assert (behind.nose, behind.is_hidden) == (-1.0, True)
    assert (ahead.nose, ahead.is_hidden) == (0.0, False)
    error = math.hypot(1.0 / 62.0, 0.15)
    (expected,) = motions_of(
        [[observation(k, CAR, nose=-1, is_hidden=True, error=error) for k in (1, 2)]]
    )
    assert same_motion(behind, expected._replace(number=1, box_px=CAR))


@pytest.mark.parametrize(
    ("front", "is_sure", "is_hidden"),
    [
        ((50.0, 40.0, 200.0, 84.0), True, True),
        ((50.0, 40.0, 200.0, 83.0), True, False),  # 80 + 0.03 * 100 is not lower
        ((50.0, 40.0, 200.0, 84.0), False, False),
        ((70.0, 40.0, 200.0, 84.0), True, False),  # 30 px = 0.3 * 100
        ((69.9, 40.0, 200.0, 84.0), True, True),
        ((-100.0, 40.0, 30.0, 84.0), True, False),
        ((-100.0, 40.0, 30.1, 84.0), True, True),
        ((50.0, 80.0, 200.0, 184.0), True, False),  # begins below it
        ((50.0, 79.9, 200.0, 184.0), True, True),
    ],
)
def test_lower_end_is_hidden_by_a_box_that_is_lower(
    front: Box, is_sure: bool, is_hidden: bool
) -> None:
    """The box from (0, -20) to (100, 80) is 100 px wide and high."""
    boxes = np.array([(0.0, -20.0, 100.0, 80.0), front])

    assert are_hidden(boxes, np.array([True, is_sure])) == [is_hidden, False]
