"""Openings of the carriageway in drawn plan views, with numbers worked out by hand."""

import math
from typing import Final

import numpy as np
import pytest
from numpy.typing import NDArray

from crosscue.detectors.cues.road_area import CELL_M, RoadPlan
from crosscue.detectors.cues.road_openings import Opening, RoadOpenings, Seen
from crosscue.replay.columns import Floats

AHEAD_M: Final = np.arange(0.0, 40.0, CELL_M) + 0.5 * CELL_M
LEFT_M: Final = np.arange(20.0, -20.0, -CELL_M) - 0.5 * CELL_M
X, Y = np.meshgrid(AHEAD_M, LEFT_M, indexing="ij")
NOWHERE: Final = np.zeros(X.shape, np.bool_)


def plan(is_road: NDArray[np.bool_], is_hidden: NDArray[np.bool_] = NOWHERE) -> RoadPlan:
    return RoadPlan(AHEAD_M, LEFT_M, np.where(is_hidden, np.nan, is_road.astype(float)))


def seen(
    is_road: NDArray[np.bool_], is_hidden: NDArray[np.bool_] = NOWHERE, height_m: float = 1.5
) -> Seen:
    """Result of the third frame of a standing car."""
    openings = RoadOpenings(height_m)
    return [openings(plan(is_road, is_hidden), 0.0) for _ in range(3)][-1]


def road(middle_m: Floats, half_m: float = 4.0) -> NDArray[np.bool_]:
    return np.abs(middle_m - Y) < half_m


STRAIGHT: Final = road(0.0 * X)
STREET: Final = (X > 20.0) & (X < 28.0)
LEFT, RIGHT = STREET & (Y > 0.0), STREET & (Y < 0.0)


@pytest.mark.parametrize("slope", [0.0, 0.1, -0.1])
def test_street_is_measured_from_the_edges_of_a_road_at_any_angle(slope: float) -> None:
    found = seen(road(slope * X) | LEFT)

    (opening,) = found.openings
    assert opening.side == 1
    assert (opening.start_m, opening.end_m) == pytest.approx((20.0, 28.0), abs=0.3)
    assert (found.start_m, found.end_m) == (opening.start_m, opening.end_m)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_bend_whose_far_part_is_hidden_is_no_opening(side: float) -> None:
    """From 12 m on the road turns to one side, 6.8 m over 13 m, and ends in view."""
    bent = road(side * 0.04 * np.maximum(X - 12.0, 0.0) ** 2) & (X < 25.0)

    assert seen(bent).openings == ()


@pytest.mark.parametrize(("half_m", "legs"), [(8.0, (1.0, 1.0, math.nan)), (0.0, (1.0, 1.0, 0.0))])
def test_side_is_missing_only_where_its_edge_is_seen(
    half_m: float, legs: tuple[float, float, float]
) -> None:
    """Cars hide the right edge of the road, from 3 m on, up to a distance."""
    is_hidden = (Y < -3.0) & (X > 3.0) & (3.0 + 4.0 * half_m > X)
    found = seen(STRAIGHT | LEFT, is_hidden)

    assert found.legs == pytest.approx(legs, nan_ok=True)


@pytest.mark.parametrize(
    ("begins_m", "length_m", "is_known"),
    [(5.0, 2.75, False), (5.0, 3.0, True), (9.0, 3.0, True), (9.25, 20.0, False)],
)
def test_edge_is_known_from_three_metres_of_the_first_twelve(
    begins_m: float, length_m: float, is_known: bool
) -> None:
    """Cars hide the left edge of the road elsewhere, but not from 19 m on."""
    ends_m = min(begins_m + length_m, 12.0)
    is_hidden = (Y > 3.0) & (X < 19.0) & ~((begins_m < X) & (ends_m > X))

    assert bool(seen(STRAIGHT | LEFT, is_hidden).openings) == is_known


def test_without_an_opening_straight_is_not_seen() -> None:
    found = seen(STRAIGHT)

    assert found.openings == ()
    assert found.legs == pytest.approx((0.0, math.nan, 0.0), nan_ok=True)
    assert math.isnan(found.sd_m)


@pytest.mark.parametrize(
    ("share", "hidden", "straight"),
    [
        (1.0, 0.0, 1.0),
        (0.75, 0.0, 1.0),
        (0.5, 0.0, math.nan),
        (0.25, 0.0, math.nan),
        (0.0, 0.0, 0.0),
        (1.0, 0.25, 1.0),
        (1.0, 0.75, math.nan),
        (0.0, 0.75, math.nan),
    ],
)
def test_road_goes_on_if_most_of_its_middle_beyond_the_far_kerb_is_road(
    share: float, hidden: float, straight: float
) -> None:
    """Judged are 2 to 12 m beyond 25.875 m, 1.5 m to either side: of 4 rows, some are road."""
    part = np.round(X / CELL_M - 0.5) % 4
    is_road = (STRAIGHT & (X < 18.0)) | ((X > 18.0) & (X < 26.0) & (Y > -4.0))
    is_road |= (X > 26.0) & (np.abs(Y) < 1.5) & (part < 4 * share)
    found = seen(is_road, (X > 26.0) & (part >= 4 - 4 * hidden))

    assert found.end_m == pytest.approx(26.0, abs=0.3)
    assert found.legs.straight == pytest.approx(straight, nan_ok=True)


def test_road_beyond_is_judged_from_2_to_12_metres_behind_the_far_kerb() -> None:
    """Of 30 to 40 m, 45 % is road: undecided. Of 26 to 40 m it would be 61 %, enough."""
    found = seen(
        (STRAIGHT & (X < 20.0))
        | LEFT
        | (STRAIGHT & STREET)
        | (road(0.0 * X) & (X > 28.0) & (X < 34.5))
    )

    assert found.end_m == pytest.approx(28.0, abs=0.3)
    assert math.isnan(found.legs.straight)


def test_sd_grows_with_the_square_of_the_distance() -> None:
    """2.5 m and, for 0.004 rad of pitch at 1.5 m, 28^2 * 0.004 / 1.5 = 2.091 m: 3.259 m."""
    assert seen(STRAIGHT | LEFT).sd_m == pytest.approx(3.259, abs=0.05)


Frames = list[tuple[list[Opening], float, float]]


def followed(frames: Frames) -> list[tuple[Opening, ...]]:
    """Confirmed openings after each frame's openings, distance and turn."""
    openings = RoadOpenings(1.5)
    return [openings._followed(*one) for one in frames]


def again(opening: Opening, n: int = 3, moved_m: float = 0.0) -> Frames:
    """The same opening of the world in several frames."""
    return [([shifted(opening, k * moved_m)], moved_m if k else 0.0, 0.0) for k in range(n)]


def shifted(opening: Opening, by_m: float) -> Opening:
    return Opening(opening.side, opening.start_m - by_m, opening.end_m - by_m)


FAR: Final = Opening(1, 20.0, 28.0)


def test_opening_moves_with_the_car_and_needs_three_frames() -> None:
    found = followed([*again(FAR, 3, 2.0), ([], 5.0, 0.0), ([], 18.0, 0.0), ([], 1.5, 0.0)])

    assert found[:2] == [(), ()]
    assert found[2] == (Opening(1, 16.0, 24.0),)
    assert found[3] == (Opening(1, 11.0, 19.0),)
    # One metre of it is left, then none.
    assert found[4] == (Opening(1, -7.0, 1.0),)
    assert found[5] == ()


def test_place_is_the_mean_of_two_then_moves_by_a_fifth_at_least() -> None:
    """Starts of 20, 21, 23, 24, 25 and 25: 20.5, 21.333, 22, 22.6 and, by fifths, 23.08."""
    starts = (20.0, 21.0, 23.0, 24.0, 25.0, 25.0)
    found = followed([([Opening(1, one, one + 8.0)], 0.0, 0.0) for one in starts])

    assert [one.start_m for (one,) in found[2:]] == pytest.approx(
        [21.333, 22.0, 22.6, 23.08], abs=1e-3
    )
    assert [one.end_m - one.start_m for (one,) in found[2:]] == pytest.approx([8.0] * 4)


@pytest.mark.parametrize(("missed", "remains"), [(5, True), (6, False)])
def test_opening_is_forgotten_after_six_frames_without_it(missed: int, remains: bool) -> None:
    none: Frames = [([], 0.0, 0.0)] * missed
    assert bool(followed([*again(FAR), *none])[-1]) == remains
    # Every second frame is enough.
    with_gaps = [one for opening in again(FAR) for one in (opening, ([], 0.0, 0.0))]
    assert bool(followed([*with_gaps, *none[1:]])[-1]) == remains


@pytest.mark.parametrize(("hits", "remains"), [(5, False), (6, True)])
def test_opening_of_six_frames_remains_until_it_is_passed(hits: int, remains: bool) -> None:
    assert bool(followed([*again(FAR, hits), *[([], 0.0, 0.0)] * 9])[-1]) == remains


@pytest.mark.parametrize(
    ("other", "is_same"),
    [
        (Opening(1, 31.5, 40.0), True),
        (Opening(1, 32.5, 40.0), False),
        (Opening(1, 8.0, 16.5), True),
        (Opening(1, 8.0, 15.5), False),
        (Opening(-1, 20.0, 28.0), False),
    ],
)
def test_openings_within_four_metres_on_one_side_are_one(other: Opening, is_same: bool) -> None:
    found = followed([*again(FAR), ([other], 0.0, 0.0), ([other], 0.0, 0.0), ([other], 0.0, 0.0)])

    assert len(found[-1]) == (1 if is_same else 2)


def test_two_openings_of_one_frame_confirm_another_once() -> None:
    both = ([FAR, shifted(FAR, 0.5)], 0.0, 0.0)

    assert followed([both, both]) == [(), ()]


def test_of_two_openings_the_nearer_is_continued() -> None:
    near, far = Opening(1, 10.0, 14.0), Opening(1, 19.0, 23.0)
    between = Opening(1, 17.0, 19.0)
    found = followed([*[([near, far], 0.0, 0.0)] * 3, ([between], 0.0, 0.0)])

    assert found[-1] == (near, Opening(1, 18.5, 22.0))


def test_short_part_in_view_starts_no_opening() -> None:
    """Ground is in view from 4 m on, and three metres of an opening are needed."""
    assert followed(again(Opening(1, 0.0, 7.0)))[-1]
    assert not followed(again(Opening(1, 0.0, 6.9)))[-1]


@pytest.mark.parametrize(("turn_rad", "remains"), [(0.23, True), (-0.23, True), (0.24, False)])
def test_after_a_turn_of_40_degrees_openings_rest_for_25_metres(
    turn_rad: float, remains: bool
) -> None:
    turns: Frames = [([], 0.0, turn_rad)] * 3
    assert bool(followed([*again(FAR), *turns])[-1]) == remains
    if not remains:
        late = [followed([*again(FAR), *turns, ([], m, 0.0), *again(FAR)])[-1] for m in (24, 25)]
        assert [bool(one) for one in late] == [False, True]


def test_restart_forgets_openings_and_the_turn() -> None:
    openings = RoadOpenings(1.5)
    for found, moved_m, turned_rad in [*again(FAR), ([], 0.0, 0.8)]:
        openings._followed(found, moved_m, turned_rad)
    openings.restart()

    assert [openings._followed(*one) for one in again(FAR)] == [(), (), (FAR,)]


@pytest.mark.parametrize(("gap_m", "legs"), [(3.5, (1.0, 1.0)), (4.5, (1.0, 0.0))])
def test_roads_within_four_metres_are_one_intersection(
    gap_m: float, legs: tuple[float, float]
) -> None:
    start_m = 20.0 + gap_m
    further = (start_m < X) & (start_m + 6.0 > X) & (Y < 0.0)
    found = seen(STRAIGHT | ((X > 14.0) & (X < 20.0) & (Y > 0.0)) | further)

    assert len(found.openings) == 2
    assert (found.legs.left, found.legs.right) == legs
    assert found.start_m == pytest.approx(14.0, abs=0.3)
    assert found.end_m == pytest.approx(start_m + 6.0 if legs[1] else 20.0, abs=0.3)
