"""Road area and openings from masks of known ground, projected by the pinhole formula."""

import math
from collections.abc import Callable
from typing import Final, NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from crosscue.detectors import rle
from crosscue.detectors.base import RoadMask
from crosscue.detectors.cues.road_area import (
    ASIDE_M,
    BESIDE_M,
    CELL_M,
    CELLS,
    HALF_M,
    HIDDEN,
    NEAREST_M,
    SHARP_M,
    SHOWS_BEHIND,
    SHOWS_GROUND,
    SHOWS_ROAD,
    WEIGHTS,
    RoadArea,
    RoadPlan,
    _shown,
    reach_of,
)
from crosscue.detectors.cues.road_openings import Legs, RoadOpenings, Seen
from crosscue.detectors.ranging.ground_plane import GroundPlane
from crosscue.replay.columns import Floats
from crosscue.replay.vehicle.camera import Camera

SIZE_PX: Final = (1240, 376)
MASK_PX: Final = (620, 188)
CAMERA: Final = Camera(focal_px=707.0, center_px=(620.0, 183.0), z_m=1.65, x_m=1.0)
NO_BOXES: Final = np.empty((0, 4))
STEP_M: Final = 1.0

# Whether ground points (metres ahead of the start, and to the left) are road.
Ground = Callable[[Floats, Floats], NDArray[np.bool_]]


class Pose(NamedTuple):
    """Place of the rear axle on the ground."""

    x_m: float
    y_m: float = 0.0
    heading_rad: float = 0.0


def mask(
    ground: Ground,
    pose: Pose,
    pitch_rad: float = 0.0,
    flipped: float = 0.0,
    wall_m: float = math.inf,
) -> RoadMask:
    """What a perfect network sees of the ground, with a share of pixels flipped.

    Houses stand ``wall_m`` to the left of the road, but not from 40 to 46 m.
    """
    width, height = MASK_PX
    u, v = np.meshgrid((np.arange(width) + 0.5) * 2.0, (np.arange(height) + 0.5) * 2.0)
    right, down = (u - 620.0) / 707.0, (v - 183.0) / 707.0
    # The ray (1, -right, -down), pitched down.
    ahead = math.cos(pitch_rad) - down * math.sin(pitch_rad)
    below = down * math.cos(pitch_rad) + math.sin(pitch_rad)
    with np.errstate(divide="ignore", invalid="ignore"):
        away_m = np.where(below > 1e-3, 1.65 / below, np.nan)
    x, y = away_m * ahead + 1.0, -away_m * right
    cos, sin = math.cos(pose.heading_rad), math.sin(pose.heading_rad)
    at_x, at_y = pose.x_m + x * cos - y * sin, pose.y_m + x * sin + y * cos
    is_road = np.isfinite(at_x) & ground(np.nan_to_num(at_x), np.nan_to_num(at_y))
    with np.errstate(divide="ignore", invalid="ignore"):
        meets_m = pose.x_m + 1.0 + (at_x - pose.x_m - 1.0) * (wall_m - pose.y_m) / (at_y - pose.y_m)
    is_road &= ~(at_y > wall_m) | ((meets_m > 40.0) & (meets_m < 46.0))
    is_road ^= np.random.default_rng(7).random(is_road.shape) < flipped
    return RoadMask(0, SIZE_PX, rle.encode_mask(is_road, (0, 0), MASK_PX), MASK_PX)


def driven(
    ground: Ground,
    n: int,
    *,
    pitch_rad: float = 0.0,
    flipped: float = 0.0,
    boxes_px: Floats = NO_BOXES,
    turn_rad: float = 0.0,
    wall_m: float = math.inf,
) -> list[Seen]:
    """Results of a drive in steps of one metre."""
    first = mask(ground, Pose(0.0))
    area, openings = RoadArea(CAMERA, reach_of(CAMERA, first)), RoadOpenings(CAMERA.z_m)
    found, pose = [], Pose(0.0)
    for i in range(n):
        if i:
            middle = pose.heading_rad + 0.5 * turn_rad
            pose = Pose(
                pose.x_m + STEP_M * math.cos(middle),
                pose.y_m + STEP_M * math.sin(middle),
                pose.heading_rad + turn_rad,
            )
            area.move(STEP_M, turn_rad)
        area.see(mask(ground, pose, pitch_rad, flipped, wall_m), boxes_px, pitch_rad)
        found.append(openings(area.plan(), STEP_M if i else 0.0, turn_rad if i else 0.0))
    return found


@pytest.mark.parametrize("turn_rad", [0.0, 0.3, 1.5, -2.4])
def test_plan_shows_the_cells_of_the_grid_below(turn_rad: float) -> None:
    area, rng = RoadArea(CAMERA, 60.0), np.random.default_rng(3)
    area.move(14.9, turn_rad)
    area._seen[:] = rng.random(area._seen.shape) * 0.1
    area._road[:] = area._seen * rng.random(area._seen.shape)

    plan = area.plan()

    cos, sin = math.cos(turn_rad), math.sin(turn_rad)
    x_m, y_m = 14.9 * math.cos(0.5 * turn_rad), 14.9 * math.sin(0.5 * turn_rad)
    ahead_m, left_m = plan.ahead_m[:, None], plan.left_m
    at_m = (x_m + ahead_m * cos - left_m * sin, y_m + ahead_m * sin + left_m * cos)
    cells = tuple(np.clip(np.floor((m + HALF_M) / CELL_M).astype(int), 0, CELLS - 1) for m in at_m)
    seen = area._seen[cells]
    expected = np.where(seen >= 0.05, area._road[cells] / seen, np.nan)
    # A place on the border of two cells may be either's.
    assert np.isclose(plan.road, expected, equal_nan=True).mean() > 0.9999


@pytest.mark.parametrize(
    ("yaw_rad", "roll_rad", "pitch_rad", "turn_rad"),
    [(0.0, 0.0, 0.0, 0.0), (0.3, 0.02, 0.01, 0.7), (-1.2, -0.03, -0.01, -2.4)],
)
def test_each_cell_of_the_ground_in_reach_takes_what_its_pixel_shows(
    yaw_rad: float, roll_rad: float, pitch_rad: float, turn_rad: float
) -> None:
    """Every cell is projected alone; by rounding, a cell at the border of pixels may differ."""
    at = {"yaw_rad": yaw_rad, "roll_rad": roll_rad, "y_m": 0.4}
    camera = CAMERA.model_copy(update=at)
    area, boxes_px = RoadArea(camera, 30.0), np.array([[300.0, 150.0, 420.0, 376.0]])
    area.move(7.3, turn_rad)
    road = mask(crossing, Pose(25.0), flipped=0.05)

    area.see(road, boxes_px, pitch_rad)

    x_m, y_m = 7.3 * math.cos(0.5 * turn_rad), 7.3 * math.sin(0.5 * turn_rad)
    middles_m = (np.arange(CELLS) + 0.5) * CELL_M - HALF_M
    east, north = np.meshgrid(middles_m - x_m, middles_m - y_m, indexing="ij")
    cos, sin = math.cos(turn_rad), math.sin(turn_rad)
    ground_m = np.column_stack(
        [(east * cos + north * sin).ravel(), (north * cos - east * sin).ravel()]
    )
    plane = GroundPlane.of(camera.model_copy(update={"pitch_rad": pitch_rad}), SIZE_PX)
    pixels = np.nan_to_num(np.floor(plane.project(ground_m) * 0.5), nan=-1.0).astype(int)
    ahead_m, left_m = (ground_m - [1.0, 0.4]).T
    is_in = (ahead_m > NEAREST_M) & (ahead_m < 30.0) & (np.abs(left_m + 0.4) < ASIDE_M)
    is_in &= ((pixels >= 0) & (pixels < MASK_PX)).all(axis=1)
    rows_px = (np.arange(MASK_PX[1]) + 0.5) * 2.0 - 183.0
    above_px = 707.0 * math.cos(pitch_rad) - rows_px * math.sin(pitch_rad)
    below = 707.0 * math.sin(pitch_rad) + rows_px * math.cos(pitch_rad)
    shown = _shown(road, 0.5 * boxes_px, 1.65 * above_px / np.maximum(below, 1e-3))
    kinds = np.where(is_in, shown[tuple(np.where(is_in[:, None], pixels + 1, 0).T)], HIDDEN)
    far_m2 = np.maximum(ahead_m**2 + left_m**2, SHARP_M**2)
    weight = WEIGHTS[kinds] * SHARP_M**2 / far_m2
    assert (weight > 0.0).sum() > 1000
    assert np.isclose(area._seen.ravel(), weight, rtol=1e-5).mean() > 0.9999
    assert np.isclose(area._road.ravel(), weight * (kinds == SHOWS_ROAD), rtol=1e-5).mean() > 0.9999


def straight(x: Floats, y: Floats) -> NDArray[np.bool_]:
    """A road 7 m wide, the car 2 m right of its middle."""
    return (y > -1.5) & (y < 5.5)


def side_street(x: Floats, y: Floats) -> NDArray[np.bool_]:
    """The same with a street 8 m wide to the right, from 40 m on."""
    return straight(x, y) | ((x > 40.0) & (x < 48.0) & (y < 0.0))


def crossing(x: Floats, y: Floats) -> NDArray[np.bool_]:
    """The same with streets to both sides."""
    return straight(x, y) | ((x > 40.0) & (x < 48.0))


def stem(x: Floats, y: Floats) -> NDArray[np.bool_]:
    """A road that ends at a road across."""
    return (straight(x, y) & (x < 44.0)) | ((x > 40.0) & (x < 48.0))


def bend(x: Floats, y: Floats) -> NDArray[np.bool_]:
    """A road that bends to the right with a radius of 60 m, from 20 m on."""
    radius_m = np.hypot(x - 20.0, y + 60.0)
    curve = (radius_m > 58.5) & (radius_m < 65.5) & (y > -60.0)
    return np.where(x < 20.0, straight(x, y), curve)


def mirrored(ground: Ground) -> Ground:
    """The same ground with left and right exchanged."""
    return lambda x, y: ground(x, -y)


@pytest.mark.parametrize("pitch_rad", [0.0, 0.03, -0.02])
def test_road_in_the_plan_view_is_where_it_is_on_the_ground(pitch_rad: float) -> None:
    first = mask(side_street, Pose(20.0), pitch_rad)
    area = RoadArea(CAMERA, reach_of(CAMERA, first))
    area.see(first, NO_BOXES, pitch_rad)
    plan = area.plan(0.0)
    near = (plan.ahead_m > 8.0) & (plan.ahead_m < 15.0)
    seen = np.isfinite(plan.road[near])
    x, y = np.meshgrid(plan.ahead_m[near] + 20.0, plan.left_m, indexing="ij")
    wrong = (plan.road[near] > 0.5) != side_street(x, y)
    at_edge = (np.abs(y + 1.5) < 2 * CELL_M) | (np.abs(y - 5.5) < 2 * CELL_M)
    assert seen.sum() > 500
    assert not (wrong & seen & ~at_edge).any()


def test_the_plan_view_stays_on_the_ground_while_the_car_moves_and_turns() -> None:
    area = RoadArea(CAMERA, 30.0)
    area.see(mask(side_street, Pose(20.0)), NO_BOXES, 0.0)
    for _ in range(40):
        area.move(0.5, math.radians(1.0))
    plan = area.plan(25.0)
    heading = math.radians(40.0)
    radius_m = 0.5 / math.radians(1.0)
    x, y = np.meshgrid(plan.ahead_m, plan.left_m, indexing="ij")
    at_x = 20.0 + radius_m * math.sin(heading) + x * math.cos(heading) - y * math.sin(heading)
    at_y = radius_m * (1.0 - math.cos(heading)) + x * math.sin(heading) + y * math.cos(heading)
    seen = np.isfinite(plan.road)
    wrong = ((plan.road > 0.5) != side_street(at_x, at_y)) & seen
    assert seen.sum() > 1000
    assert wrong.sum() < 0.06 * seen.sum()


def test_a_side_street_is_found_in_its_place_and_on_its_side_alone() -> None:
    found = driven(side_street, 36)
    first = next(i for i, one in enumerate(found) if one.openings)
    assert 40.0 - first * STEP_M > 12.0
    for i, one in enumerate(found[first:], first):
        assert abs(one.start_m + i * STEP_M - 40.0) < 2.0 * one.sd_m
        assert abs(one.end_m + i * STEP_M - 48.0) < 2.0 * one.sd_m
    assert found[30].legs == Legs(0.0, 1.0, 1.0)
    assert all(one.legs.left != 1.0 for one in found)


@pytest.mark.parametrize("ground", [straight, side_street, crossing, stem])
def test_mirrored_ground_gives_mirrored_legs(ground: Ground) -> None:
    for one, other in zip(driven(ground, 32), driven(mirrored(ground), 32), strict=True):
        np.testing.assert_equal(one.legs, Legs(*other.legs[::-1]))


def test_a_crossing_has_both_sides_and_a_way_ahead() -> None:
    assert driven(crossing, 32)[-1].legs == Legs(1.0, 1.0, 1.0)


def test_a_road_that_ends_at_another_has_sides_and_no_way_ahead() -> None:
    assert driven(stem, 32)[-1].legs == Legs(1.0, 0.0, 1.0)


def test_a_lay_by_beside_the_road_is_no_opening() -> None:
    def lay_by(x: Floats, y: Floats) -> NDArray[np.bool_]:
        return straight(x, y) | ((x > 25.0) & (x < 37.0) & (y < 0.0) & (y > -6.0))

    assert not any(one.openings for one in driven(lay_by, 25))


def test_a_road_without_streets_has_no_opening_also_if_it_bends_or_is_wide() -> None:
    def wide(x: Floats, y: Floats) -> NDArray[np.bool_]:
        return (y > -3.5) & (y < 14.0)

    for ground in (straight, wide):
        found = driven(ground, 30)
        assert not any(one.openings for one in found)
        assert found[-1].legs[2] == 0.0
    turns = [0.0] * 20
    assert not any(one.openings for one in driven(bend, len(turns)))


def test_flipped_pixels_of_a_mask_neither_hide_a_street_nor_make_one() -> None:
    assert driven(side_street, 32, flipped=0.03)[-1].legs == Legs(0.0, 1.0, 1.0)
    assert not any(one.openings for one in driven(straight, 30, flipped=0.03))


def test_ground_behind_a_vehicle_is_not_seen() -> None:
    parked = np.array([[630.0, 150.0, 1240.0, 376.0]])
    found = driven(side_street, 30, boxes_px=parked)
    assert not any(one.openings for one in found)
    assert all(math.isnan(one.legs.right) for one in found)
    assert found[-1].legs.left == 0.0


def test_after_a_turn_into_the_street_its_openings_are_forgotten() -> None:
    area, openings = RoadArea(CAMERA, 30.0), RoadOpenings(CAMERA.z_m)
    for i in range(34):
        area.see(mask(side_street, Pose(i * STEP_M)), NO_BOXES, 0.0)
        before = openings(area.plan(), STEP_M)
        area.move(STEP_M, 0.0)
    assert before.openings
    for _ in range(10):
        area.move(STEP_M, -math.radians(9.0))
        after = openings(area.plan(), STEP_M, -math.radians(9.0))
    assert not after.openings


def test_reach_grows_with_height_and_focal_length_and_is_none_without_one() -> None:
    seen = mask(straight, Pose(0.0))
    assert reach_of(CAMERA, seen) == pytest.approx(math.sqrt(1.5 * 1.65 * 353.5))
    assert reach_of(Camera(focal_px=5000.0, z_m=3.0), seen) == 50.0
    assert reach_of(Camera(), seen) == 0.0


def between_houses(x: Floats, y: Floats) -> NDArray[np.bool_]:
    """A street 6 m wide to the left, from 40 m on."""
    return straight(x, y) | ((x > 40.0) & (x < 46.0) & (y > 0.0))


@pytest.mark.parametrize(("wall_m", "least_m"), [(6.5, 7.0), (7.5, 13.0)])
def test_street_between_houses_is_seen_as_soon_as_its_ground_is(
    wall_m: float, least_m: float
) -> None:
    """From afar, a house hides the street behind it, which is no view of a missing street."""
    found = driven(between_houses, 36, wall_m=wall_m)

    first = next(i for i, one in enumerate(found) if one.legs.left == 1.0)
    assert 40.0 - first > least_m
    assert found[first].start_m == pytest.approx(40.0 - first, abs=2.5)
    assert not any(one.openings for one in driven(straight, 36, wall_m=wall_m))


@pytest.mark.parametrize(("start_m", "is_found"), [(-2.0, False), (-0.5, False), (2.0, True)])
def test_opening_begins_with_ground_in_view(start_m: float, is_found: bool) -> None:
    """What looks like one only beside the car, behind the ground in view, is an edge's estimate."""
    ahead_m, left_m = np.arange(-10.0, 36.0, CELL_M), np.arange(25.0, -25.0, -CELL_M)
    x, y = np.meshgrid(ahead_m, left_m, indexing="ij")
    is_open = (x > start_m) & (x < start_m + 7.5) & (y > 0.0) & (y < 12.0)
    plan = RoadPlan(ahead_m, left_m, ((np.abs(y) < 3.0) | is_open).astype(np.float64))
    openings = RoadOpenings(CAMERA.z_m, nearest_m=5.0)

    found = [openings(plan, 0.0) for _ in range(3)][-1]

    assert bool(found.openings) == is_found


@pytest.mark.parametrize("pitch_rad", [-0.05, 0.0, 0.05])
@pytest.mark.parametrize("share", [0.02, 0.5, 0.98])
def test_pixels_show_what_is_behind_the_edge_below_them(pitch_rad: float, share: float) -> None:
    rng = np.random.default_rng(7)
    is_road = rng.random((40, 12)) < share
    # Level ground 1.5 m below a camera of 50 px, horizon within the picture.
    rows_px = np.arange(40) - 15.0
    below = 50.0 * math.sin(pitch_rad) + rows_px * math.cos(pitch_rad)
    above_px = 50.0 * math.cos(pitch_rad) - rows_px * math.sin(pitch_rad)
    away_m = 1.5 * above_px / np.maximum(below, 1e-3)

    boxes_px = np.array([[2.0, 3.5, 5.0, 9.0]])

    road = RoadMask(0, (12, 40), rle.encode_mask(is_road, (0, 0), (12, 40)), (12, 40))
    found = _shown(road, boxes_px, away_m)

    for top in (1, 12, 39):
        # Rows above those in reach are left out.
        part = _shown(road, boxes_px, away_m, top)
        assert np.array_equal(part[:, 1:], found[:, top + 1 :])
    wanted = np.full((14, 42), HIDDEN)
    for row, column in np.ndindex(40, 12):
        edge = row
        while edge + 1 < 40 and not is_road[edge + 1, column]:
            edge += 1
        is_behind = away_m[row] - away_m[edge] > BESIDE_M
        no_road = SHOWS_BEHIND if is_behind else SHOWS_GROUND
        if not (2 <= column < 5 and 4 <= row < 9):
            wanted[column + 1, row + 1] = SHOWS_ROAD if is_road[row, column] else no_road
    assert np.array_equal(found, wanted)
    assert share == 0.98 or (wanted == SHOWS_BEHIND).any()
