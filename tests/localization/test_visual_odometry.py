"""Visual odometry on pictures of a known plane between two known walls."""

import math
from collections.abc import Sequence
from typing import Final

import numpy as np
import pytest

from crosscue.localization.visual_odometry import VisualOdometry, VisualStep
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
