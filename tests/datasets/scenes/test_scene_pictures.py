"""Properties of the simulated pictures: geometry, masks, visibility, symmetry, determinism."""

from __future__ import annotations

import numpy as np
import pytest

from crosscue.datasets.scenes.rendering.camera import SceneCamera, view_at
from crosscue.datasets.scenes.rendering.ground import TEXELS_PER_M, X_M, Y_M
from crosscue.datasets.scenes.rendering.render import RenderedFrame, RenderedObject
from support.scenes import mirrored, picture_at, when_at, world


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
