"""Motion from pictures: of a known plane between known walls, and its direction."""

import math
from collections.abc import Sequence
from typing import Final

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from crosscue.localization.visual_odometry import VisualOdometry, VisualStep, travel_between
from crosscue.replay.columns import Bytes, Floats
from crosscue.replay.vehicle.camera import Camera
from support.plane_pictures import CAMERA, SIZE_PX, WALL, arc, picture

NO_BOXES: Final = np.empty((0, 4))


def driven(
    poses: Sequence[tuple[float, float, float]], camera: Camera = CAMERA, *, plain: bool = False
) -> list[VisualStep]:
    """Odometry over the pictures of poses at 10 Hz."""
    odometry = VisualOdometry(camera)
    found = [
        odometry(i * 100_000_000, picture(*pose, plain=plain), NO_BOXES)
        for i, pose in enumerate(poses)
    ]
    assert found[0] is None
    return [step for step in found if step is not None]


@pytest.mark.parametrize(("step_m", "turn_deg"), [(0.3, 0.0), (1.0, 0.0), (1.0, 1.5), (0.8, -2.5)])
def test_distance_and_turn_of_an_arc_are_found_in_every_pair(
    step_m: float, turn_deg: float
) -> None:
    for step in driven(arc(step_m, math.radians(turn_deg), 6)):
        assert not step.is_standing
        assert step.distance_m == pytest.approx(step_m, rel=0.04)
        assert abs(step.distance_m - step_m) < 2.0 * step.distance_sd_m
        assert math.degrees(step.turn_rad) == pytest.approx(turn_deg, abs=0.1)


def test_pictures_in_a_mirror_turn_to_the_other_side() -> None:
    """The picture is mirrored about its middle, half a pixel from the camera's centre."""
    poses, (width_px, _) = arc(1.0, math.radians(1.5), 4), SIZE_PX
    x_px, y_px = CAMERA.center_px or (math.nan, math.nan)
    mirrored = VisualOdometry(CAMERA.model_copy(update={"center_px": (width_px - 1 - x_px, y_px)}))
    found = [
        mirrored(i * 100_000_000, np.ascontiguousarray(picture(*pose)[:, ::-1]), NO_BOXES)
        for i, pose in enumerate(poses)
    ]
    for step, other in zip(driven(poses), found[1:], strict=True):
        assert other is not None
        assert math.degrees(other.turn_rad + step.turn_rad) == pytest.approx(0.0, abs=0.01)
        assert other.distance_m == pytest.approx(step.distance_m, rel=0.01)


def test_a_wrong_pitch_is_corrected_by_the_ground_and_the_direction_of_travel() -> None:
    steps = driven(arc(1.0, 0.0, 10), CAMERA.model_copy(update={"pitch_rad": 0.0}))
    assert steps[-1].pitch_rad == pytest.approx(CAMERA.pitch_rad, abs=0.004)
    assert steps[-1].distance_m == pytest.approx(1.0, rel=0.04)


def test_distance_is_proportional_to_the_height_of_the_camera() -> None:
    poses = arc(0.8, 0.0, 3)
    higher = CAMERA.model_copy(update={"z_m": 1.25 * CAMERA.z_m})
    for step, scaled in zip(driven(poses), driven(poses, higher), strict=True):
        assert scaled.distance_m == pytest.approx(1.25 * step.distance_m, rel=0.03)


def test_a_standing_car_is_found_despite_noise_and_a_car_that_passes() -> None:
    rng = np.random.default_rng(5)
    scene, odometry = picture(0.0, 0.0, 0.0).astype(np.float64), VisualOdometry(CAMERA)
    for i in range(5):
        noisy = scene + rng.normal(0.0, 2.0, scene.shape)
        box = np.array([[100.0 + 30.0 * i, 90.0, 300.0 + 30.0 * i, 200.0]])
        noisy[90:200, 100 + 30 * i : 300 + 30 * i] = WALL[:110, :200]
        step = odometry(i, np.clip(noisy, 0, 255).astype(np.uint8), box)
        if i:
            assert step is not None
            assert step.is_standing
            assert (step.distance_m, step.turn_rad) == (0.0, 0.0)


def test_a_road_without_texture_has_no_distance_but_a_turn() -> None:
    (step,) = driven(arc(1.0, math.radians(1.0), 1), plain=True)
    assert math.isnan(step.distance_m)
    assert math.degrees(step.turn_rad) == pytest.approx(1.0, abs=0.15)
    assert not step.is_standing


def test_without_a_focal_length_only_standing_is_known() -> None:
    unknown = Camera(z_m=1.6)
    still, moving = driven([(0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (1.0, 0.0, 0.0)], unknown)
    assert still.is_standing
    assert not moving.is_standing
    assert math.isnan(moving.distance_m)
    assert math.isnan(moving.turn_rad)


def test_a_picture_of_another_size_or_time_starts_over() -> None:
    odometry = VisualOdometry(CAMERA)
    assert odometry(10, picture(0.0, 0.0, 0.0), NO_BOXES) is None
    assert odometry(20, picture(0.0, 0.0, 0.0)[:200], NO_BOXES) is None
    assert odometry(15, picture(0.0, 0.0, 0.0)[:200], NO_BOXES) is None
    assert odometry(30, picture(0.0, 0.0, 0.0)[:200], NO_BOXES) is not None
    assert odometry(1_000_000_031, picture(0.0, 0.0, 0.0)[:200], NO_BOXES) is None


FOCAL_PX, WIDE_PX = 600.0, (640, 400)
CENTER_PX = (320.0, 200.0)


def street(camera: Floats, camera_rotation: Rotation) -> Bytes:
    """Draw points in space (x right, y down, z ahead) as seen by a camera at a position."""
    rng = np.random.default_rng(4)
    dots = np.stack(
        [rng.uniform(-12, 12, 400), rng.uniform(-6, 3, 400), rng.uniform(8, 40, 400)], 1
    )
    seen = camera_rotation.inv().apply(dots - camera)
    picture = np.zeros(WIDE_PX[::-1], np.uint8)
    for (x, y, z), grey in zip(seen, rng.integers(80, 255, 400), strict=True):
        if z > 1.0:
            at = (FOCAL_PX * x / z + CENTER_PX[0], FOCAL_PX * y / z + CENTER_PX[1])
            place = (round(at[0] * 16), round(at[1] * 16))
            cv2.circle(picture, place, 24, int(grey), -1, cv2.LINE_AA, 4)
    return np.asarray(cv2.GaussianBlur(picture, (0, 0), 1.0), np.uint8)


@pytest.mark.parametrize(("left_deg", "below_deg"), [(0.0, 0.0), (2.0, 0.0), (-1.0, 3.0)])
def test_camera_axis_offset_matches_its_mounting(left_deg: float, below_deg: float) -> None:
    # A positive rotation about y (down) turns z towards x, to the right; about x, upwards.
    camera_rotation = Rotation.from_euler("yx", [-left_deg, -below_deg], degrees=True)
    before, after = (street(np.array([0.0, 0.0, z]), camera_rotation) for z in (0.0, 0.7))

    found = travel_between(before, after, FOCAL_PX, CENTER_PX)

    assert found is not None
    assert np.rad2deg(found.left_rad) == pytest.approx(left_deg, abs=0.4)
    assert np.rad2deg(found.below_rad) == pytest.approx(below_deg, abs=0.4)
    assert np.rad2deg(found.turned_rad) == pytest.approx(0.0, abs=0.1)


def test_left_turn_is_positive() -> None:
    ahead = Rotation.identity()
    later = Rotation.from_euler("y", -1.0, degrees=True)

    found = travel_between(
        street(np.zeros(3), ahead), street(np.array([0.0, 0.0, 0.7]), later), FOCAL_PX, CENTER_PX
    )

    assert found is not None
    assert np.rad2deg(found.turned_rad) == pytest.approx(1.0, abs=0.15)


def test_pictures_without_points_or_motion_yield_none() -> None:
    black = np.zeros(WIDE_PX[::-1], np.uint8)
    still = street(np.zeros(3), Rotation.identity())

    assert travel_between(black, black, FOCAL_PX, CENTER_PX) is None
    assert travel_between(still, still, FOCAL_PX, CENTER_PX) is None


def test_error_of_the_turn_is_taken_for_a_movement_to_the_side() -> None:
    """Corners that are followed wrongly turn both the rotation and the direction of travel."""
    found = []
    for seed in range(12):
        noise = np.random.default_rng(seed).normal(0.0, 6.0, (2, *WIDE_PX[::-1]))
        pair = (street(np.array([0.0, 0.0, z]), Rotation.identity()) for z in (0.0, 0.7))
        noisy = (np.clip(one + dots, 0, 255) for one, dots in zip(pair, noise, strict=True))
        before, after = (one.astype(np.uint8) for one in noisy)
        one = travel_between(before, after, FOCAL_PX, CENTER_PX)
        assert one is not None
        found.append((one.left_rad, one.turned_rad, one.per_turn))
    left, turned, per_turn = np.array(found).T

    assert per_turn.min() > 3.0
    assert np.std(left - per_turn * turned) < 0.7 * np.std(left)
