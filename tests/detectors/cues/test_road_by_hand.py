"""Fractions of road (eq. 13, 14) in the picture and on the ground, with numbers by hand."""

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from crosscue.detectors import rle
from crosscue.detectors.base import RoadMask
from crosscue.detectors.cues.observed import Place, RoadFractions
from crosscue.detectors.cues.road import is_road, region_mask, road_fractions
from crosscue.detectors.cues.road_ground import ground_fractions, outlines, rectangles
from crosscue.replay.vehicle.cue_table import CUES
from crosscue.replay.vehicle.vehicle import Camera, Cues, Polygon, Regions, Vehicle

NAN = math.nan
SIZE = (400, 200)
CAMERA = Camera(
    x_m=1.0, z_m=2.0, focal_px=100.0, center_px=(200.0, 100.0), pitch_rad=0.0, pitch_sd_rad=0.0
)
REGIONS = Regions(
    kind="ground", aside_m=(12.0, 20.0), beyond_m=(6.0, 26.0), half_width_m=2.0, min_rows=5.0
)
PLACE = Place(start_m=10.0, end_m=26.0, sd_m=0.0)


def mask(road: NDArray[np.bool_], size_px: tuple[int, int] | None = None) -> RoadMask:
    size = (road.shape[1], road.shape[0])
    return RoadMask(0, size_px or size, rle.encode_mask(road, (0, 0), size), size)


def changed(camera: Camera = CAMERA, **changes: Any) -> Camera:
    return camera.model_copy(update=changes)


@pytest.mark.parametrize(
    ("polygon", "shape", "inside"),
    [
        (((0, 0), (1, 0), (0, 1)), (4, 4), ["xxx.", "xx..", "x...", "...."]),  # x + y < 1
        (((0, 0), (1, 0), (1, 1)), (2, 4), [".xxx", "...x"]),  # x >= y
        (((0, 0.25), (1, 0.25), (1, 0.75), (0, 0.75)), (2, 2), ["xx", ".."]),  # 0.25 <= y < 0.75
        (((0.25, 0), (0.75, 0), (0.75, 1), (0.25, 1)), (1, 2), ["x."]),  # 0.25 <= x < 0.75
        (((0, 0), (1, 0), (0, 1), (1, 1)), (4, 4), ["xxx.", ".x..", ".x..", "xxx."]),
    ],
)
def test_region_contains_pixels_whose_centres_are_inside(
    polygon: Polygon, shape: tuple[int, int], inside: list[str]
) -> None:
    """Centres are at (0.5, 1.5, ...) / width and height; the upper and left edge belong to it.

    Of the last one, whose sides intersect, x < 1 - y and x < y exclude each other.
    """
    found = region_mask(polygon, shape)

    assert found.dtype == np.bool_
    assert ["".join("x" if one else "." for one in row) for row in found.tolist()] == inside


def test_fractions_are_road_pixels_over_pixels_of_each_region() -> None:
    """Mask of 8 x 2 pixels, and regions of 4, 2 and 1 pixels with 1, 1 and 1 road pixels.

    Left: 1 / 4; straight: 1 / 2; right: 1 / 1. A region without a pixel has no road.
    """
    regions = Regions(
        kind="picture",
        left=((0, 0), (0.25, 0), (0.25, 1), (0, 1)),
        straight=((0.5, 0), (0.625, 0), (0.625, 1), (0.5, 1)),
        right=((0.875, 0), (1, 0), (1, 0.5), (0.875, 0.5)),
    )
    road = np.zeros((2, 8), np.bool_)
    road[1, [0, 2, 4, 7]] = True
    road[0, 7] = True

    assert road_fractions(mask(road), regions) == RoadFractions(0.25, 0.5, 1.0)
    empty = regions.model_copy(update={"left": ((0, 0), (0.01, 0), (0.01, 0.01))})
    assert road_fractions(mask(road), empty) == RoadFractions(0.0, 0.5, 1.0)


@pytest.mark.parametrize(
    ("left", "straight", "right", "counts"),
    [
        (0.2, 0.21, 0.0, (0, 1, 0)),  # 0.2 is not more than 0.2
        (0.21, 0.2, NAN, (1, 0, None)),
        (0.0, 1.0, 0.2, (0, 1, 0)),
        (NAN, NAN, 1.0, (None, None, 1)),
    ],
)
def test_road_is_a_cue_above_the_fraction(
    left: float, straight: float, right: float, counts: tuple[int | None, ...]
) -> None:
    """Each cue compares the fraction of its own side with 0.2 (eq. 14)."""
    vehicle = Vehicle(version=1, cues=Cues(road_fraction=0.2))
    fractions = RoadFractions(left, straight, right)

    found = [
        is_road(fractions, vehicle, CUES[f"road_{side}"]).number
        for side in ("left", "straight", "right")
    ]

    assert tuple(found) == counts


def test_rectangles_are_placed_by_the_intersection() -> None:
    """Depth 26 - 10 = 16 m, so the margin is 4 m: the sides are from 14 to 22 m.

    They are 12 to 20 m aside. Straight on it is from 26 + 6 = 32 to 26 + 26 = 52 m.
    """
    assert rectangles(REGIONS, PLACE) == (
        ((14.0, 22.0, 12.0, 20.0), 4.0),
        ((32.0, 52.0, -2.0, 2.0), 6.0),
        ((14.0, 22.0, -20.0, -12.0), 4.0),
    )


def corner(ahead_m: float, left_m: float) -> list[float]:
    return [200.0 - 100.0 * left_m / ahead_m, 100.0 + 200.0 / ahead_m]


@pytest.mark.parametrize("center_px", [(200.0, 100.0), None])
def test_outlines_are_corners_on_the_ground_seen_by_the_camera(
    center_px: tuple[float, float] | None,
) -> None:
    """The camera is 1 m ahead of the axle and 2 m high: x = 200 - 100 l / d, y = 100 + 200 / d.

    Left: d = 14 - 1 = 13 and 22 - 1 = 21 m, l = 12 and 20 m. Straight: 31 and 51 m, l = +-2 m.
    The default of the principal point is the picture's centre.
    """
    left, straight, right = outlines(changed(center_px=center_px), REGIONS, PLACE, SIZE)

    assert left is not None
    assert straight is not None
    assert right is not None
    expected = [corner(13, 12), corner(13, 20), corner(21, 20), corner(21, 12)]
    np.testing.assert_allclose(left, expected)
    expected = [corner(31, -2), corner(31, 2), corner(51, 2), corner(51, -2)]
    np.testing.assert_allclose(straight, expected)
    expected = [corner(13, -20), corner(13, -12), corner(21, -12), corner(21, -20)]
    np.testing.assert_allclose(right, expected)


@pytest.mark.parametrize(
    ("camera", "place"),
    [
        (CAMERA, None),
        (changed(focal_px=None), PLACE),
        (changed(z_m=0.0), PLACE),
        (changed(z_m=-1.0), PLACE),
    ],
    ids=["no place", "no focal length", "on the ground", "below it"],
)
def test_regions_are_unknown_without_place_or_camera(camera: Camera, place: Place | None) -> None:
    assert outlines(camera, REGIONS, place, SIZE) == (None, None, None)
    found = ground_fractions(mask(np.ones((200, 400), np.bool_)), camera, REGIONS, place)
    assert np.isnan([found.left, found.straight, found.right]).all()


def fractions(
    camera: Camera = CAMERA,
    sd_m: float = 0.0,
    road: NDArray[np.bool_] | None = None,
    **changes: Any,
) -> RoadFractions:
    shown = mask(np.ones((200, 400), np.bool_) if road is None else road, SIZE)
    regions = REGIONS.model_copy(update=changes)
    return ground_fractions(shown, camera, regions, PLACE._replace(sd_m=sd_m))


def test_regions_are_seen_by_a_camera_less_than_a_metre_high() -> None:
    low = changed(z_m=0.9)

    assert all(one is not None for one in outlines(low, REGIONS, PLACE, SIZE))
    assert fractions(low, min_rows=1.0) == RoadFractions(1.0, 1.0, 1.0)
    assert fractions(changed(center_px=None), min_rows=1.0) == RoadFractions(1.0, 1.0, 1.0)


@pytest.mark.parametrize(("start_m", "is_seen"), [(-2.0, True), (-2.01, False)])
def test_region_is_projected_from_one_metre_ahead_of_the_camera(
    start_m: float, is_seen: bool
) -> None:
    """Start -2 m + margin 4 m = 2 m ahead of the axle is 1 m ahead of the camera.

    The sides are not seen if they begin nearer; straight on is.
    """
    left, straight, right = outlines(CAMERA, REGIONS, Place(start_m, start_m + 16.0, 0.0), SIZE)

    assert (left is not None, straight is not None, right is not None) == (is_seen, True, is_seen)


def test_region_partly_behind_a_turned_camera_is_not_projected() -> None:
    """Turned by 1.2 rad to the left, the far right region is behind the camera."""
    left, _, right = outlines(changed(yaw_rad=1.2), REGIONS, PLACE, SIZE)

    assert left is not None
    assert right is None


@pytest.mark.parametrize(
    ("sd_m", "pitch_sd_rad", "is_side_seen", "is_ahead_seen"),
    [
        (4.0, 0.0, True, True),
        (4.01, 0.0, False, True),
        (6.0, 0.0, False, True),
        (6.01, 0.0, False, False),
        (2.4, 0.0378, True, False),
        (2.4, 0.0380, False, False),
        (0.0, 0.0124, True, True),
        (0.0, 0.0126, True, False),
    ],
)
def test_region_is_seen_if_its_place_is_surer_than_the_margin(
    sd_m: float, pitch_sd_rad: float, is_side_seen: bool, is_ahead_seen: bool
) -> None:
    """Margins are 4 m at the sides and 6 m ahead; pitch adds D**2 * sd / 2 m.

    At 13 m: 84.5 sd; with 2.4 m, sqrt(2.4**2 + 3.2**2) = 4, so sd = 3.2 / 84.5 = 0.0379.
    Ahead, at 31 m: 480.5 sd; sd = 6 / 480.5 = 0.01249.
    """
    found = fractions(changed(pitch_sd_rad=pitch_sd_rad), sd_m, min_rows=1.0)

    assert math.isnan(found.left) != is_side_seen
    assert math.isnan(found.right) != is_side_seen
    assert math.isnan(found.straight) != is_ahead_seen


@pytest.mark.parametrize(
    ("height", "min_rows", "is_seen"),
    [(200, 5.86, True), (200, 5.87, False), (100, 2.93, True), (100, 2.94, False)],
)
def test_region_spans_rows_of_the_segmentation(height: int, min_rows: float, is_seen: bool) -> None:
    """From 200 / 13 = 15.385 to 200 / 21 = 9.524 below the horizon are 5.861 rows, or half."""
    found = fractions(road=np.ones((height, 2 * height), np.bool_), min_rows=min_rows)

    assert math.isnan(found.left) != is_seen
    assert math.isnan(found.right) != is_seen


@pytest.mark.parametrize(("more", "is_seen"), [(-0.01, True), (0.01, False)])
def test_rows_of_a_tilted_region_are_between_the_middles_of_its_ends(
    more: float, is_seen: bool
) -> None:
    """With a roll of 0.2 rad, no two corners are in one row."""
    rolled = changed(roll_rad=0.2)
    outline = outlines(rolled, REGIONS, PLACE, SIZE)[0]
    assert outline is not None
    y = outline[:, 1]

    found = fractions(rolled, min_rows=(y[0] + y[1] - y[2] - y[3]) / 2.0 + more)

    assert math.isnan(found.left) != is_seen


def pixels_of(outline: NDArray[np.float64] | None, height: int, width: int) -> NDArray[np.bool_]:
    """Mark the pixels of an outline by the even-odd rule of regions in the picture."""
    assert outline is not None
    polygon = tuple((float(x) / SIZE[0], float(y) / SIZE[1]) for x, y in outline)
    return region_mask(polygon, (height, width))


def test_pixels_on_the_edge_of_a_ground_region_belong_to_it() -> None:
    """Depth 41 - 9 = 32 m, so the margin is 8 m and the left region from 17 to 33 m: d = 16 and 32.

    8 and 16 m aside, it is from x = 150 to 100 at y = 112.5, and from 175 to 150 at 106.25. At
    y = 112.5 - k, for k = 0 to 6, it is from 100 + 8 k to 150 + 4 k: 50, 46, 42, 38, 34, 30 and 26
    pixels, in all 266. The lowest row is on its edge. The region is exactly 6.25 rows high.
    """
    regions = REGIONS.model_copy(update={"aside_m": (8.0, 16.0), "min_rows": 6.25})
    for k, pixels in enumerate((50, 46, 42, 38, 34, 30, 26, 0)):
        road = np.zeros((200, 400), np.bool_)
        road[112 - k] = True
        found = ground_fractions(mask(road), CAMERA, regions, Place(9.0, 41.0, 0.0))
        assert found.left == pixels / 266


@pytest.mark.parametrize("size", [(400, 200), (200, 200), (400, 100)])
@pytest.mark.parametrize("roll_rad", [0.0, 0.3])
def test_ground_fraction_is_road_over_pixels_of_the_projected_region(
    size: tuple[int, int], roll_rad: float
) -> None:
    """The even-odd rule is the independent implementation; 40 % of the pixels are road (seed 3)."""
    width, height = size
    road = np.random.default_rng(3).random((height, width)) < 0.4
    camera = changed(roll_rad=roll_rad, center_px=(200.37, 100.23))
    found = fractions(camera, road=road, min_rows=1.0)

    seen = 0
    shown = outlines(camera, REGIONS, PLACE, SIZE)
    for outline, fraction in zip(shown, (found.left, found.straight, found.right), strict=True):
        inside = pixels_of(outline, height, width)
        if not math.isnan(fraction):
            seen += 1
            assert fraction == np.count_nonzero(road & inside) / np.count_nonzero(inside)
    assert seen >= 2


def test_quarter_of_a_region_has_to_be_in_the_picture() -> None:
    """Each side region is 100 * 8 / 13 = 61.54 px wide below, 38.10 px above and 5.861 px high.

    Its area is 0.5 * (61.54 + 38.10) * 5.861 = 292.0 px, and a quarter 73.0. The principal point
    is shifted, so that the picture's edge cuts it.
    """
    seen = []
    for center_x in (*range(60, 110, 2), *range(290, 340, 2)):
        camera = changed(center_px=(float(center_x), 100.0))
        outline = outlines(camera, REGIONS, PLACE, SIZE)[0 if center_x < 200 else 2]
        found = fractions(camera)

        seen.append(not math.isnan(found.left if center_x < 200 else found.right))

        assert seen[-1] == (np.count_nonzero(pixels_of(outline, 200, 400)) >= 73.0), center_x
    assert 5 < sum(seen[:25]) < 20
    assert 5 < sum(seen[25:]) < 20


@pytest.mark.parametrize(("far_m", "pixels"), [(15.0, 1), (12.5, 0)])
def test_region_of_one_pixel_is_seen_and_of_none_is_not(far_m: float, pixels: int) -> None:
    """A mask of 20 x 10 pixels: rows 5.476 to 5.769, so only centres at 5.5, where d = 20 m.

    There x = 10 - 5 l / 20, from 12 m at 7.0 to 15 m at 6.25, or to 12.5 m at 6.875: 6.5 is in
    the first.
    """
    regions: dict[str, Any] = {"aside_m": (12.0, far_m), "min_rows": 0.1}
    outline = outlines(CAMERA, REGIONS.model_copy(update=regions), PLACE, SIZE)[0]
    assert np.count_nonzero(pixels_of(outline, 10, 20)) == pixels

    found = fractions(road=np.ones((10, 20), np.bool_), **regions)

    assert math.isnan(found.left) == (pixels == 0)
