"""Cars in two frames (eq. 15, 16) and the nose of a car, with numbers worked out by hand."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from crosscue.detectors import rle
from crosscue.detectors.base import Detections
from crosscue.detectors.cues.candidates import BELOW_SCORE, ELSEWHERE, Count
from crosscue.detectors.cues.cars import (
    CarCandidates,
    CarShapes,
    Pairs,
    car_shapes,
    count_crossing,
    count_in_leg,
    count_oncoming,
    count_outgoing,
    count_parked,
    cross_traffic,
    no_pairs,
    pair_cars,
    parked_cars,
)
from crosscue.detectors.cues.observed import NONE, CarCounts, Sides, Ways, nose_of, of_side
from crosscue.replay.vehicle.cue_table import CUES
from crosscue.replay.vehicle.vehicle import Cars, Vehicle

SIZE = (400, 200)
S = 1_000_000_000
RULES = Cars(
    labels=("car", "van"),
    score=0.9,
    length_per_height=2.0,
    area_change=0.03,
    position_change=0.05,
    still_change=0.0025,
    slope=0.25,
    max_gap_s=0.5,
)
VEHICLE = Vehicle(version=1, cars=RULES)
Car = tuple[float, float, float]


def shapes(
    *cars: Car, t_ns: int = 0, noses: Sequence[int] | None = None, size: tuple[int, int] = SIZE
) -> CarShapes:
    """Build cars from x and y of the centre, and the area."""
    rows = np.array(cars, np.float64).reshape(-1, 3)
    nose = np.array([0] * len(cars) if noses is None else noses, np.int64)
    return CarShapes(t_ns, size, rows[:, :2], rows[:, 2], nose)


def steps(before: CarShapes, now: CarShapes) -> list[list[float]]:
    return sorted(pair_cars(before, now, RULES).step_px.tolist())


def pairs(*steps_px: tuple[float, float], noses: Sequence[int] = ()) -> Pairs:
    step = np.array(steps_px, np.float64).reshape(-1, 2)
    nose = np.array(noses or [0] * len(step), np.int64)
    return Pairs(step, np.zeros_like(step), nose, 400)


@pytest.mark.parametrize(
    ("heights", "nose"),
    [
        ([1, 1, 9, 9, 2, 2, 2, 2], -1),  # quarters 2 < 4; halves would be 20 > 8
        ([2, 2, 2, 2, 9, 9, 1, 1], 1),  # quarters 4 > 2
        ([0, 0, 1, 1, 9, 9, 2, 2, 2, 2, 0], -1),  # the same within a wider picture
        ([1, 5, 5, 5, 5, 5, 2], -1),  # 7 // 4 = 1 column: 1 < 2
        ([5, 5, 1, 1, 1, 1, 4, 3], 1),  # 10 > 7
        ([3, 4, 1, 1, 1, 1, 5, 5], -1),  # 7 < 10
        ([1, 2, 2, 2], -1),  # 4 columns suffice
        ([1, 2, 3], 0),  # 3 columns do not
        ([1, 0, 0, 0, 0, 2, 0, 3], 0),  # nor do 3 filled ones among 8
        ([4, 1, 9, 9, 9, 9, 2, 3], 0),  # equal: 5 and 5
        ([0, 0, 0, 0], 0),
    ],
)
def test_nose_is_at_the_end_whose_outer_quarter_is_lower(heights: list[int], nose: int) -> None:
    """An end is a quarter, rounded down, of the columns from the first to the last filled one."""
    assert nose_of(np.array(heights, np.float64)) == nose


def test_shapes_of_cars_are_centre_area_and_nose() -> None:
    """Box (10, 20) to (110, 60): centre (60, 40), area 100 * 40 = 4,000 without a mask.

    Its mask: 25 columns of 10 pixels, then 75 of 20: area 250 + 1,500 = 1,750, nose left.
    """
    box = np.array([[10.0, 20.0, 110.0, 60.0]] * 2)
    drawn = np.zeros((40, 100), np.bool_)
    drawn[30:, :25] = True
    drawn[20:, 25:] = True
    masks = (rle.encode_mask(drawn, (10, 20), SIZE), b"")
    two = Detections(7, SIZE, box, np.array([0.95, 0.95]), ("car", "van"), masks)

    found = car_shapes([two], RULES)

    assert (found.t_ns, found.size_px) == (7, SIZE)
    assert found.center_px.tolist() == [[60.0, 40.0], [60.0, 40.0]]
    assert found.area_px.tolist() == [1750.0, 4000.0]
    assert found.nose.tolist() == [-1, 0]
    assert found.nose.dtype == np.int64
    assert len(found) == 2


@pytest.mark.parametrize(
    ("width", "score", "label", "counts"),
    [
        (81.0, 0.91, "car", True),
        (80.0, 0.91, "car", False),  # 80 = 2 * 40: not longer
        (81.0, 0.9, "car", False),  # not above 0.9
        (81.0, 0.91, "bus", False),
    ],
)
def test_car_is_longer_than_twice_its_height_and_sure(
    width: float, score: float, label: str, counts: bool
) -> None:
    """A box of 40 px height needs more than 80 px width; the cars of all detectors count."""
    one = Detections(
        3, SIZE, np.array([[15.0, 5.0, 15.0 + width, 45.0]]), np.array([score]), (label,), (b"",)
    )

    found = car_shapes([one, one], RULES)

    assert len(found) == 2 * counts
    assert found.center_px.shape == (2 * counts, 2)
    assert found.nose.dtype == np.int64


def test_cars_need_a_detector() -> None:
    with pytest.raises(ValueError, match=r"^found: expected at least one detector's result$"):
        car_shapes([], RULES)


def is_pair_of(before: CarShapes, now: CarShapes) -> bool:
    return len(pair_cars(before, now, RULES).nose) == 1


@pytest.mark.parametrize(
    ("before", "now", "is_pair"),
    [
        (100.0, 102.0, True),
        (100.0, 103.0, False),  # 3 / 100 = 0.03, not below; 3 / 103 = 0.0291 would be
        (103.0, 100.0, True),  # 3 / 103 = 0.0291
        (100.0, 97.0, False),
        (100.0, 98.0, True),
    ],
)
def test_area_changes_by_less_than_three_percent_of_the_earlier_area(
    before: float, now: float, is_pair: bool
) -> None:
    """|A2 - A1| / A1 < 0.03 (eq. 15)."""
    later = shapes((50, 50, now), t_ns=S // 10)
    assert is_pair_of(shapes((50, 50, before)), later) == is_pair


@pytest.mark.parametrize(
    ("dx", "dy", "is_pair"),
    [(19.9, 0.0, True), (20.0, 0.0, False), (-12.0, 15.9, True), (12.0, -16.0, False)],
)
def test_position_changes_by_less_than_five_percent_of_the_width(
    dx: float, dy: float, is_pair: bool
) -> None:
    """0.05 * 400 px = 20 px; sqrt(12**2 + 16**2) = 20 (eq. 15)."""
    later = shapes((50 + dx, 50 + dy, 100), t_ns=S // 10)
    assert is_pair_of(shapes((50, 50, 100)), later) == is_pair


@pytest.mark.parametrize(
    ("t_ns", "is_pair"), [(1, True), (S // 2, True), (S // 2 + 1, False), (0, False), (-1, False)]
)
def test_pair_is_at_most_half_a_second_apart(t_ns: int, is_pair: bool) -> None:
    """0 < 5 s + t - 5 s <= 0.5 s."""
    later = shapes((50, 50, 100), t_ns=5 * S + t_ns)
    assert is_pair_of(shapes((50, 50, 100), t_ns=5 * S), later) == is_pair


def test_pair_has_step_centre_and_nose_of_the_later_frame() -> None:
    """(53, 48) - (50, 50) = (3, -2)."""
    found = pair_cars(
        shapes((50, 50, 100), noses=[-1]), shapes((53, 48, 101), t_ns=S // 10, noses=[1]), RULES
    )

    assert found.step_px.tolist() == [[3.0, -2.0]]
    assert found.center_px.tolist() == [[53.0, 48.0]]
    assert found.nose.tolist() == [1]
    assert found.width_px == 400
    assert found.judged is None


def test_nearest_cars_are_paired_first() -> None:
    """Cars at 0 and 10, then at 8 and 9: 10 -> 9 is 1 px, which leaves 0 -> 8.

    Farthest first would be 0 -> 9 and 10 -> 8.
    """
    before = shapes((0, 50, 100), (10, 50, 100))

    assert steps(before, shapes((8, 50, 100), (9, 50, 100), t_ns=1)) == [[-1.0, 0.0], [8.0, 0.0]]
    assert steps(before, shapes((9, 50, 100), t_ns=1)) == [[-1.0, 0.0]]
    assert steps(shapes((9, 50, 100)), shapes((10, 50, 100), (0, 50, 100), t_ns=1)) == [[1.0, 0.0]]
    # Of two that are equally near, the first car of the earlier frame is paired.
    assert steps(shapes((0, 50, 100), (10, 50, 100)), shapes((5, 50, 100), t_ns=1)) == [[5.0, 0.0]]
    three = shapes((0, 50, 100), (1, 50, 100), (100, 50, 100))
    later = shapes((1, 50, 100), (104, 50, 100), (200, 50, 100), t_ns=1)
    assert steps(three, later) == [[0.0, 0.0], [4.0, 0.0]]


def test_only_a_fitting_car_is_paired() -> None:
    """The nearer car is 3 % larger, so the one 5 px away is the same car."""
    found = steps(shapes((0, 50, 100)), shapes((1, 50, 103), (5, 50, 100), t_ns=1))

    assert found == [[5.0, 0.0]]


@pytest.mark.parametrize(
    ("before", "now"),
    [
        (shapes(), shapes((50, 50, 100), t_ns=1)),
        (shapes((50, 50, 100)), shapes(t_ns=1)),
        (shapes((50, 50, 100), size=(400, 100)), shapes((50, 50, 100), t_ns=1)),
        (shapes((50, 50, 100)), shapes((350, 50, 100), t_ns=1)),
    ],
    ids=["none before", "none now", "other size", "too far"],
)
def test_frames_without_a_common_car_have_empty_pairs(before: CarShapes, now: CarShapes) -> None:
    found = pair_cars(before, now, RULES)

    assert found.step_px.shape == found.center_px.shape == (0, 2)
    assert found.nose.shape == (0,)
    assert found.nose.dtype == np.int64
    assert found.width_px == 400
    assert no_pairs(7).width_px == 7


def test_crossing_car_moves_horizontally_and_by_enough() -> None:
    """More than 0.0025 * 400 = 1 px, with a slope of at most 0.25 (eq. 15)."""
    moved = [
        (-1.0, 0.0),  # not more than 1 px
        (-4.0, 1.0),  # left: 1 = 0.25 * 4
        (-4.0, -1.1),  # too steep
        (1.1, 0.2),  # right: 0.2 <= 0.275
        (4.0, -1.0),  # right
        (8.0, 1.9),  # right
        (1.0, 0.0),
        (0.0, 5.0),
    ]

    assert cross_traffic(pairs(*moved), RULES) == Sides(1, 3)
    assert cross_traffic(pairs(), RULES) == Sides(0, 0)
    # With 0.0005 * 400 = 0.2 px, half a pixel is enough.
    finer = RULES.model_copy(update={"still_change": 0.0005})
    assert cross_traffic(pairs((0.5, 0.0), (0.2, 0.0), (-0.5, 0.0), (-0.6, 0.0)), finer) == Sides(
        2, 1
    )


def test_parked_car_stands_on_both_axes_and_shows_its_nose() -> None:
    """At most 0.0025 * 400 = 1 px on either axis (eq. 16)."""
    moved = [(1.0, -1.0), (-1.0, 1.0), (0.0, 0.0), (1.1, 0.0), (0.0, -1.1), (0.0, 0.0), (0.5, 0.5)]
    noses = [-1, 1, 0, -1, 1, 1, 1]

    assert parked_cars(pairs(*moved, noses=noses), RULES) == Sides(1, 3)
    assert parked_cars(pairs(), RULES) == Sides(0, 0)


def numbers(found: Pairs) -> list[int | None]:
    """Numbers of cars that cross, are parked, come towards the ego vehicle and drive away."""
    rules = (count_crossing, count_crossing, count_parked, count_parked)
    cues = ("cross_traffic_left", "cross_traffic_right", "parked_left", "parked_right")
    counts = [
        *(rule(found, VEHICLE, CUES[cue]) for rule, cue in zip(rules, cues, strict=True)),
        count_oncoming(found, VEHICLE, CUES["oncoming_cars"]),
        count_outgoing(found, VEHICLE, CUES["outgoing_cars"]),
    ]
    return [None if count is None else count.number for count in counts]


def test_cues_of_a_pair_count_their_side() -> None:
    """Two cars cross to the left and one to the right; one is parked left and two right."""
    found = pairs((-4, 0), (-4, 0), (4, 0), (0, 0), (0, 0), (0, 0), noses=[0, 0, 0, -1, 1, 1])

    assert numbers(found) == [2, 1, 1, 2, None, None]


def test_cues_of_tracked_cars_are_those_judged_over_frames() -> None:
    judged = CarCounts(Sides(1, 2), Sides(3, 4), Sides(5, 6), Sides(7, 8), 9, 9, Ways(10, 11))
    found = Pairs(np.array([[-4.0, 0.0]]), np.zeros((1, 2)), np.zeros(1, np.int64), 400, judged)

    assert numbers(found) == [1, 2, 3, 4, 10, 11]
    unknown = Pairs(found.step_px, found.center_px, found.nose, 400, judged._replace(past=None))
    assert numbers(unknown) == [1, 2, 3, 4, None, None]


def test_side_is_that_which_the_cue_supports() -> None:
    assert of_side(Sides(1, 2), CUES["road_left"]) == 1
    assert of_side(Sides(1, 2), CUES["road_right"]) == 2


def test_traffic_in_legs_is_looked_for_on_request_only() -> None:
    """Of four cars one has a low score; of the others, two are in the left leg."""
    judged = CarCounts(NONE, NONE, NONE, NONE, 1, 1, in_leg=Sides(2, 0))
    cars = CarCandidates((0.9, 0.9, 0.9, 0.4), 1, (0.5,))
    pairs = replace(no_pairs(640), judged=judged, cars=cars)
    wanted = Vehicle(version=1, cars=Cars(leg_traffic=True))

    for side, number in (("left", 2), ("right", 0)):
        cue = CUES[f"leg_traffic_{side}"]
        skipped = {BELOW_SCORE: 1, ELSEWHERE: 3 - number}
        expected = Count(number, cars.scores, skipped, cars.thresholds, "[cars] score")
        assert count_in_leg(pairs, wanted, cue) == expected
        assert count_in_leg(pairs, Vehicle(version=1), cue) is None
        assert count_in_leg(no_pairs(640), wanted, cue) is None


STRICT = Cars(score=0.95)


def _car(x: int, nose: int, t_ns: int, y: int = 60, score: float = 0.99) -> Detections:
    """Build a car with a lower end (its nose) at the left (-1) or right (1)."""
    height = 30
    profile = np.full(90, height)
    quarter = 90 // 3
    profile[:quarter] = 18 if nose < 0 else height
    profile[-quarter:] = 18 if nose > 0 else height
    mask = np.arange(height)[:, None] >= height - profile[None, :]
    box = np.array([[x, y, x + 90, y + height]], np.float64)
    text = rle.encode_mask(mask, (x, y), SIZE)
    return Detections(t_ns, SIZE, box, np.array([score]), ("car",), (text,))


def _shapes(*cars: Detections) -> CarShapes:
    return car_shapes(cars, STRICT)


def _mirrored(found: Detections) -> Detections:
    width = SIZE[0]
    x0, y0, x1, y1 = found.boxes_px[0]
    mask = rle.decode_mask(found.masks[0], SIZE)[:, ::-1]
    box = np.array([[width - x1, y0, width - x0, y1]])
    return replace(found, boxes_px=box, masks=(rle.encode_mask(mask, (0, 0), SIZE),))


def _sides(before: CarShapes, now: CarShapes) -> tuple[Sides, Sides]:
    pairs = pair_cars(before, now, STRICT)
    return cross_traffic(pairs, STRICT), parked_cars(pairs, STRICT)


@given(
    x=st.integers(60, 220),
    dx=st.integers(-25, 25),
    dy=st.integers(-8, 8),
    nose=st.sampled_from([-1, 1]),
)
def test_mirrored_pair_counts_on_the_other_side(x: int, dx: int, dy: int, nose: int) -> None:
    before, now = _car(x, nose, 0), _car(x + dx, nose, 10**8, y=60 + dy)

    seen = _sides(_shapes(before), _shapes(now))
    mirrored = _sides(_shapes(_mirrored(before)), _shapes(_mirrored(now)))

    assert [Sides(s.right, s.left) for s in seen] == list(mirrored)


@given(
    h=st.integers(1, 12),
    w=st.integers(1, 12),
    x=st.integers(0, 6),
    y=st.integers(0, 6),
    seed=st.integers(0, 999),
)
def test_run_length_encoding_survives_a_round_trip(
    h: int, w: int, x: int, y: int, seed: int
) -> None:
    mask = np.random.default_rng(seed).random((h, w)) < 0.6
    size = (w + x + seed % 3, h + y + seed % 2)
    whole = np.zeros((size[1], size[0]), np.bool_)
    whole[y : y + h, x : x + w] = mask

    text = rle.encode_mask(mask, (x, y), size)

    assert (rle.decode_mask(text, size) == whole).all()
    assert rle.area_px(text) == whole.sum()
    np.testing.assert_allclose(rle.column_heights_px(text, size), whole.sum(axis=0))


def test_run_length_encoding_matches_coco() -> None:
    corner = np.array([[True]])

    assert rle.encode_mask(corner, (0, 0), (2, 2)) == b"013"  # none, one, three
    # 40 = 8 + 32: five bits "8" with the continuation bit (8 + 32 + 48 = 'X'), then 1 ('1').
    assert rle.encode_mask(corner, (0, 40), (1, 41)) == b"X11"


@given(st.lists(st.integers(0, 2**30), min_size=1, max_size=40))
def test_runs_are_joined_from_their_groups_of_five_bits(lengths: list[int]) -> None:
    text = rle._to_text(np.array(lengths, np.int64))
    values, value, bits = list[int](), 0, 0
    for code in (byte - 48 for byte in text):
        value, bits = value | (code & 31) << bits, bits + 5
        if not code & 32:
            signed = value - (1 << bits if code & 16 else 0)
            values.append(signed + (values[-2] if len(values) > 2 else 0))
            value, bits = 0, 0

    assert rle.runs(text).tolist() == values == lengths


def test_a_run_of_more_than_seven_groups_is_refused() -> None:
    assert rle.runs(b"o" * 6 + b"0").tolist() == [2**30 - 1]
    with pytest.raises(ValueError, match="a run is too long"):
        rle.runs(b"o" * 7 + b"0")


def test_mask_outside_its_picture_is_refused() -> None:
    with pytest.raises(ValueError, match="not inside 4 x 4"):
        rle.encode_mask(np.ones((2, 2), np.bool_), (3, 0), (4, 4))


@pytest.mark.parametrize("size", [(8, 9), (8, 7), (9, 8)])
def test_mask_of_another_picture_size_is_refused(size: tuple[int, int]) -> None:
    full = rle.encode_mask(np.ones((8, 8), np.bool_), (0, 0), (8, 8))

    for read in (rle.decode_mask, rle.column_heights_px):
        with pytest.raises(ValueError, match="mask of 64 pixels"):
            read(full, size)


@pytest.mark.parametrize("text", [b"", b"\x00", b"o", b"zzzz", b"0" * 3 + b"\xff"])
def test_invalid_mask_bytes_are_refused(text: bytes) -> None:
    with pytest.raises(ValueError, match="mask"):
        rle.decode_mask(text, (8, 8))
