"""Tests of road regions on the ground: the ego road is not a side road; far ones are not seen."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from crosscue.detectors import rle
from crosscue.detectors.base import RoadMask
from crosscue.detectors.cues.candidates import REGION_NOT_SEEN
from crosscue.detectors.cues.frame import CuePass
from crosscue.detectors.cues.observed import FrameDetections, Place, RoadFractions
from crosscue.detectors.cues.road_ground import ground_fractions, outlines
from crosscue.detectors.ranging.ground_plane import GroundPlane
from crosscue.replay.errors import VehicleError
from crosscue.replay.vehicle.vehicle import SIMULATED_CAR, Camera, Regions, Vehicle, parse

SIZE = (1280, 720)
MASK = (640, 360)
CAMERA = Camera(
    x_m=1.7, z_m=1.5, focal_px=900.0, center_px=(640.0, 340.0), pitch_rad=0.01, pitch_sd_rad=0.005
)
GROUND = Regions(kind="ground")
DEPTH_M = 16.0


def pictured(
    right_m: float, left_m: float, place: Place | None = None, *, legs: str = "", ahead: bool = True
) -> RoadMask:
    """Draw a level road of given width about the ego vehicle, with side roads at a place."""
    width, height = MASK
    y, x = np.mgrid[0:height, 0:width] + 0.5
    scale = SIZE[0] / width
    across = (x * scale - CAMERA.center_px[0]) / CAMERA.focal_px  # type: ignore[index]
    below = (y * scale - CAMERA.center_px[1]) / CAMERA.focal_px  # type: ignore[index]
    angle = np.arctan(below) + CAMERA.pitch_rad
    is_ground = angle > 1e-4
    depth = CAMERA.z_m / np.tan(np.where(is_ground, angle, 1.0))
    slant = depth * math.cos(CAMERA.pitch_rad) + CAMERA.z_m * math.sin(CAMERA.pitch_rad)
    left = -across * slant
    from_axle = depth + CAMERA.x_m
    is_road = (left >= -right_m) & (left <= left_m)
    if place is not None:
        is_there = (from_axle >= place.start_m) & (from_axle <= place.end_m)
        is_road &= ahead | (from_axle <= place.end_m)
        is_road |= is_there & (left > 0.0) & ("left" in legs)
        is_road |= is_there & (left < 0.0) & ("right" in legs)
    mask = rle.encode_mask(is_road & is_ground, (0, 0), MASK)
    return RoadMask(0, SIZE, mask, MASK)


def at(start_m: float, sd_m: float = 1.0) -> Place:
    return Place(start_m, start_m + DEPTH_M, sd_m)


@given(ahead_m=st.floats(3.0, 80.0), left_m=st.floats(-30.0, 30.0))
def test_ground_point_is_projected_by_the_pinhole_model(ahead_m: float, left_m: float) -> None:
    level = CAMERA.model_copy(update={"pitch_rad": 0.0})

    ((x, y),) = (
        GroundPlane.of(level, SIZE).project(np.array([[ahead_m + level.x_m, left_m]])).tolist()
    )

    assert x == pytest.approx(640.0 - 900.0 * left_m / ahead_m)
    assert y == pytest.approx(340.0 + 900.0 * 1.5 / ahead_m)


def test_rotated_camera_keeps_its_regions_on_the_ground() -> None:
    turns = {"yaw_rad": 0.1, "pitch_rad": 0.05, "roll_rad": -0.08}
    found = []
    for camera in (CAMERA, CAMERA.model_copy(update=turns)):
        ground = GroundPlane.of(camera, SIZE)
        shown = outlines(camera, GROUND, at(16.0), SIZE)
        found.append([ground.unproject(one) for one in shown if one is not None])

    assert len(found[0]) == 3
    np.testing.assert_allclose(found[1], found[0], rtol=1e-6)


@given(
    start_m=st.floats(3.0, 60.0),
    right_m=st.floats(1.5, 11.0),
    left_m=st.floats(1.5, 11.0),
    off_m=st.floats(-3.0, 3.0),
)
def test_wide_ego_road_has_no_side_fraction(
    start_m: float, right_m: float, left_m: float, off_m: float
) -> None:
    estimated = at(start_m + off_m)

    fractions = ground_fractions(pictured(right_m, left_m), CAMERA, GROUND, estimated)

    for fraction in (fractions.left, fractions.right):
        assert math.isnan(fraction) or fraction < 0.05


@pytest.mark.parametrize("start_m", [10.0, 16.0, 24.0])
@pytest.mark.parametrize("legs", ["", "left", "right", "left right"])
@pytest.mark.parametrize("off_m", [-2.0, 0.0, 2.0])
def test_side_road_counts_only_on_its_side(legs: str, start_m: float, off_m: float) -> None:
    place = at(start_m)
    estimated = at(start_m + off_m)

    fractions = ground_fractions(pictured(3.0, 6.0, place, legs=legs), CAMERA, GROUND, estimated)

    for side in ("left", "right"):
        fraction = getattr(fractions, side)
        if not math.isnan(fraction):
            assert fraction > 0.9 if side in legs else fraction < 0.05
    seen = ground_fractions(pictured(3.0, 6.0), CAMERA, GROUND, at(16.0))
    assert not math.isnan(seen.left + seen.right + seen.straight)


@pytest.mark.parametrize("ahead", [False, True])
def test_straight_fraction_measures_the_lane_beyond_the_intersection(ahead: bool) -> None:
    place = at(12.0)

    fractions = ground_fractions(pictured(3.0, 6.0, place, ahead=ahead), CAMERA, GROUND, place)

    assert fractions.straight == pytest.approx(float(ahead), abs=0.1)


def test_mirrored_scene_has_mirrored_fractions() -> None:
    place = at(16.0)
    one = ground_fractions(pictured(3.0, 6.0, place, legs="left"), CAMERA, GROUND, place)
    other = ground_fractions(pictured(6.0, 3.0, place, legs="right"), CAMERA, GROUND, place)

    assert (one.left, one.right) == pytest.approx((other.right, other.left), abs=0.02)


@pytest.mark.parametrize(
    "place",
    [None, at(-8.0), at(80.0), at(16.0, sd_m=8.0)],
    ids=["no range", "behind", "too far", "place uncertain"],
)
def test_unresolved_side_regions_are_nan(place: Place | None) -> None:
    fractions = ground_fractions(pictured(3.0, 6.0), CAMERA, GROUND, place)

    assert math.isnan(fractions.left)
    assert math.isnan(fractions.right)


def test_coarse_mask_does_not_resolve_a_distant_region() -> None:
    fine = pictured(30.0, 30.0)
    coarse = replace(
        fine,
        mask=rle.encode_mask(np.ones((9, 16), np.bool_), (0, 0), (16, 9)),
        mask_size_px=(16, 9),
    )

    assert ground_fractions(fine, CAMERA, GROUND, at(16.0)).left > 0.9
    assert math.isnan(ground_fractions(coarse, CAMERA, GROUND, at(16.0)).left)


def test_unseen_region_yields_no_count_and_is_tallied() -> None:
    vehicle = Vehicle(version=1, camera=CAMERA, regions=Regions(kind="ground"))
    cues = CuePass(vehicle)
    tally = cues.candidates

    unseen = cues(FrameDetections(0, road=pictured(3.0, 6.0)))
    seen = cues(FrameDetections(1, road=pictured(3.0, 6.0)), None, at(16.0))

    assert not any(cue.startswith("road") for cue in unseen.counts)
    assert {cue: n for cue, n in seen.counts.items() if cue.startswith("road")} == {
        "road_left": 0,
        "road_straight": 1,
        "road_right": 0,
    }
    assert tally["road_left"].skipped[REGION_NOT_SEEN] == 1
    assert isinstance(seen.road, RoadFractions)


def test_regions_default_to_the_road_area_unless_drawn_or_simulated() -> None:
    drawn = "[regions]\nleft = [[0.0, 0.5], [0.2, 0.5], [0.2, 0.6]]\n"

    assert parse("version = 1", "a.toml").regions.kind == "area"
    assert parse("version = 1\n" + drawn, "a.toml").regions.kind == "picture"
    assert Vehicle(version=1, name=SIMULATED_CAR).regions.kind == "picture"


def test_region_with_reversed_ends_is_refused() -> None:
    with pytest.raises(VehicleError, match="aside_m: expected the nearer end first"):
        parse("version = 1\n[regions]\naside_m = [25.0, 12.0]\n", "a.toml")
