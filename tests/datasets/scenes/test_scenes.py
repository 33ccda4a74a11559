"""Simulated scenes: layouts, pictures, road, detections and the car's file."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from crosscue.datasets.scenes.faulty_labels import LABELS, FaultyLabels
from crosscue.datasets.scenes.layout import CURVE_SLOPE, KINDS, mixed_layout
from crosscue.datasets.scenes.motion import conditions_of, lane_y_m
from crosscue.datasets.scenes.rendering.camera import SceneCamera, view_at
from crosscue.datasets.scenes.rendering.ground import TEXELS_PER_M, X_M, Y_M
from crosscue.datasets.scenes.rendering.render import RenderedFrame, RenderedObject
from crosscue.datasets.scenes.settings import SceneSettings, scene_vehicle_text
from crosscue.datasets.scenes.world import build_world
from crosscue.detectors import rle
from crosscue.detectors.base import Detections, Frame, RoadMask
from crosscue.detectors.label_images import objects, road
from crosscue.detectors.ranging.height_to_range import range_of
from crosscue.replay.vehicle.vehicle import Vehicle, parse
from support.perfect_boxes import NO_FAULTS
from support.scenes import SMALL, mirrored, picture_at, renderer, when_at, world


def only(picture: RenderedFrame, category: str) -> RenderedObject:
    (found,) = [one for one in picture.seen if one.thing.category == category]
    return found


@pytest.mark.parametrize("x_m", [-45.0, -30.0, -15.0, -8.0])
def test_sign_box_matches_pinhole_projection(x_m: float) -> None:
    camera = SceneCamera()
    sign = only(picture_at(world("D"), x_m, camera), "stop_sign")
    view = view_at(camera, world("D").approach, when_at(world("D"), x_m))
    x0, y0, x1, y1 = sign.box_px
    _, y_m, z_m = sign.thing.at
    pitch = float(np.arcsin(-view.eye_axes[2, 2]))  # The body pitches when it brakes.
    depth_m = -view.at_m[0] * np.cos(pitch) - (z_m - view.at_m[2]) * np.sin(pitch)

    assert y1 - y0 == pytest.approx(camera.focal * 0.76 / depth_m, abs=1.6)
    assert x1 - x0 == pytest.approx(camera.focal * 0.76 / depth_m, abs=1.6)
    right_m = view.at_m[1] - y_m
    assert (x0 + x1) / 2 == pytest.approx(640 + camera.focal * right_m / depth_m, abs=1.2)
    assert sign.distance_m == pytest.approx(-view.rear_axle[0], abs=1e-6)


@pytest.mark.parametrize("layout", ["D", "E", "F"])
def test_masks_fill_their_boxes_and_match_owner_image(layout: str) -> None:
    picture = picture_at(world(layout), -25.0)

    assert picture.seen
    for seen in picture.seen:
        x0, y0, x1, y1 = seen.box_px
        assert seen.mask.shape == (y1 - y0, x1 - x0)
        assert all(edge.any() for edge in (seen.mask[0], seen.mask[-1]))
        assert all(edge.any() for edge in (seen.mask[:, 0], seen.mask[:, -1]))
        assert np.array_equal(picture.owner[y0:y1, x0:x1] == seen.thing.number, seen.mask)
        assert seen.mask.sum() == (picture.owner == seen.thing.number).sum()
        assert 0.0 < seen.visible <= 1.0
        assert 0.0 < seen.in_picture <= 1.0


@pytest.mark.slow
def test_mirrored_world_yields_mirrored_picture() -> None:
    plain = world("F", 2)
    one, other = picture_at(plain, -22.0), picture_at(mirrored(plain), -22.0)

    same = (one.owner == other.owner[:, ::-1]).mean()
    away = np.abs(one.rgb.astype(int) - other.rgb[:, ::-1]).mean()
    not_mirrored = np.abs(one.rgb.astype(int) - other.rgb).mean()

    assert same > 0.999
    assert away < 4.0  # Noise and the road's fine texture are not mirrored.
    assert not_mirrored > 3 * away


def test_vegetation_hides_stop_sign_only_at_distance() -> None:
    camera = SceneCamera()
    far = picture_at(world("G"), -55.0, camera)
    hidden = max((s.visible for s in far.seen if s.thing.category == "stop_sign"), default=0.0)

    assert hidden < 0.6
    assert only(picture_at(world("D"), -55.0, camera), "stop_sign").visible > 0.9
    assert only(picture_at(world("G"), -12.0, camera), "stop_sign").visible > 0.9


@pytest.mark.parametrize("layout", ["D", "F", "L12"])
def test_moving_cars_stay_on_road(layout: str) -> None:
    scene = world(layout)
    moving = [one for one in scene.things if one.velocity != (0.0, 0.0)]
    assert moving
    for thing in moving:
        for t_s in np.arange(0.0, 15.0, 0.5):
            x, y = thing.at[0] + thing.shift(t_s)[0], thing.at[1] + thing.shift(t_s)[1]
            if thing.is_there(t_s) and abs(x) < 105.0 and abs(y) < 60.0:
                place = int((y - Y_M[0]) * TEXELS_PER_M), int((x - X_M[0]) * TEXELS_PER_M)
                assert scene.ground.road[place], f"{thing.role} at {x:.1f}, {y:.1f}"


def test_ego_vehicle_stays_on_road_and_makes_only_allowed_turns() -> None:
    for layout in ("D", "F"):
        scene = world(layout)
        motion, plan = scene.approach.motion, scene.layout
        goes = {"left": plan.goes_left, "right": plan.goes_right, "ahead": plan.goes_ahead}
        rows = ((motion.y_m - Y_M[0]) * TEXELS_PER_M).astype(int)
        columns = ((motion.x_m - X_M[0]) * TEXELS_PER_M).astype(int)
        assert goes[scene.approach.turn]
        assert scene.ground.road[rows, columns].all()


@cache
def picture(layout: str, x_m: float) -> RenderedFrame:
    of = world(layout)
    return renderer(of).picture(when_at(of, x_m), with_road=True)


@pytest.mark.slow
@pytest.mark.parametrize(("layout", "x_m"), [("D", -30.0), ("D", -8.0), ("A", -15.0)])
def test_road_mask_agrees_with_map(layout: str, x_m: float) -> None:
    of, shown = world(layout), picture(layout, x_m)
    assert shown.road is not None
    rng = np.random.default_rng(3)
    points = np.column_stack(
        [rng.uniform(x_m + 6, x_m + 45, 4000), rng.uniform(-25, 25, 4000), np.zeros(4000)]
    )
    column, row, depth = shown.view.project(points).T
    high, wide = shown.road.shape
    inside = (depth > 0) & (column >= 0) & (column < wide - 1) & (row >= 0) & (row < high - 1)
    column, row = column[inside].astype(int), row[inside].astype(int)
    texel = ((points[inside, :2] - [X_M[0], Y_M[0]]) * TEXELS_PER_M).astype(int)
    on_road = of.ground.road[texel[:, 1], texel[:, 0]]
    # A pixel at this distance is over a metre long, so points that close to a kerb are omitted.
    kerb = int(1.5 * TEXELS_PER_M)
    clear = np.ones_like(on_road)
    for dx, dy in ((kerb, 0), (-kerb, 0), (0, kerb), (0, -kerb)):
        clear &= of.ground.road[texel[:, 1] + dy, texel[:, 0] + dx] == on_road
    clear &= depth[inside] < 20.0
    seen = shown.road[row, column]

    assert not seen[clear & ~on_road].any()
    # An object may hide the road.
    assert seen[clear & on_road].mean() > 0.9
    assert on_road.any()
    assert not on_road.all()


FEATURES = ("intersection", "left", "right", "straight")


@pytest.mark.parametrize("first", [0, 13, 5, 1000])
@pytest.mark.parametrize("feature", FEATURES)
def test_any_thirteen_consecutive_layouts_have_every_feature_present_and_absent(
    first: int, feature: str
) -> None:
    known = [mixed_layout(first + i).features.get(feature) for i in range(len(KINDS))]

    assert {True, False} <= set(known)


def test_curved_layout_moves_car_and_objects_with_lane() -> None:
    curved = mixed_layout(12)
    straight = replace(curved, curve_per_m=0.0)
    one, other = (
        build_world(layout, conditions_of(layout, 1), is_painted=False)
        for layout in (curved, straight)
    )
    motion = one.approach.motion

    np.testing.assert_allclose(motion.y_m - curved.aside_m(motion.x_m), lane_y_m(curved), atol=0.05)
    assert abs(motion.heading_rad[-1]) == pytest.approx(np.arctan(CURVE_SLOPE), abs=0.01)
    for bent, plain in zip(one.things, other.things, strict=True):
        at_s = max(bent.span_s[0], 0.0)
        moved = plain.at[0] + plain.shift(at_s)[0]
        aside = (bent.at[1] + bent.shift(at_s)[1]) - (plain.at[1] + plain.shift(at_s)[1])
        assert aside == pytest.approx(float(curved.aside_m(np.array(moved))), abs=1e-6)
    assert one.ground.road.sum() == pytest.approx(other.ground.road.sum(), rel=0.02)


def vehicle(width_px: int) -> Vehicle:
    camera = SceneCamera(width_px=width_px, height_px=width_px * 9 // 16)
    text = scene_vehicle_text(camera, mounting_yaw_rad=0.1, declination_rad=0.0, heading_rad=0.5)
    return parse(text, "vehicle.toml")


@pytest.mark.parametrize("x_m", [-12.0, -22.0, -35.0])
def test_range_from_stop_sign_equals_distance_to_start(x_m: float) -> None:
    camera = SceneCamera(width_px=1280, height_px=720)
    picture = picture_at(world("L204"), x_m, camera)
    curve = vehicle(1280).ranges.stop_sign
    (sign,) = [one for one in picture.seen if one.thing.category == "stop_sign"]
    assert curve is not None
    height = np.array([float(sign.box_px[3] - sign.box_px[1])])

    # The curve is fitted to detections of a network, which may differ from the true outline.
    assert range_of(height, curve)[0] == pytest.approx(-x_m, abs=2.0 * curve.residual_sd_m)


def test_detector_without_faults_finds_exactly_visible_objects() -> None:
    there = world("A")
    settings = SceneSettings(layout="A", camera=SMALL)
    picture = FaultyLabels(there, settings, NO_FAULTS).picture(when_at(there, -20.0))
    size_px = (SMALL.width_px, SMALL.height_px)
    frame = Frame(7, "camera", np.ascontiguousarray(picture.rgb[..., ::-1]), size_px)

    (found,), (ground,) = objects()([frame]), road()([frame])

    assert isinstance(found, Detections)
    assert isinstance(ground, RoadMask)
    clear = [LABELS[one.thing.category] for one in picture.seen if one.visible > 0.7]
    hidden = [LABELS[one.thing.category] for one in picture.seen if 0.25 < one.visible <= 0.7]
    assert "stop sign" in clear
    for label in set(LABELS.values()):
        many = found.labels.count(label)
        assert clear.count(label) <= many <= clear.count(label) + hidden.count(label)
    assert rle.decode_mask(ground.mask, ground.mask_size_px)[-1].all()
