"""Tests of the direction of travel from two pictures."""

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from crosscue.localization.visual_odometry import travel_between
from crosscue.replay.columns import Bytes, Floats

FOCAL_PX, SIZE_PX = 600.0, (640, 400)
CENTER_PX = (320.0, 200.0)


def street(camera: Floats, camera_rotation: Rotation) -> Bytes:
    """Draw points in space (x right, y down, z ahead) as seen by a camera at a position."""
    rng = np.random.default_rng(4)
    dots = np.stack(
        [rng.uniform(-12, 12, 400), rng.uniform(-6, 3, 400), rng.uniform(8, 40, 400)], 1
    )
    seen = camera_rotation.inv().apply(dots - camera)
    picture = np.zeros(SIZE_PX[::-1], np.uint8)
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
    black = np.zeros(SIZE_PX[::-1], np.uint8)
    still = street(np.zeros(3), Rotation.identity())

    assert travel_between(black, black, FOCAL_PX, CENTER_PX) is None
    assert travel_between(still, still, FOCAL_PX, CENTER_PX) is None


def test_error_of_the_turn_is_taken_for_a_movement_to_the_side() -> None:
    """Corners that are followed wrongly turn both the rotation and the direction of travel."""
    found = []
    for seed in range(12):
        noise = np.random.default_rng(seed).normal(0.0, 6.0, (2, *SIZE_PX[::-1]))
        pair = (street(np.array([0.0, 0.0, z]), Rotation.identity()) for z in (0.0, 0.7))
        noisy = (np.clip(one + dots, 0, 255) for one, dots in zip(pair, noise, strict=True))
        before, after = (one.astype(np.uint8) for one in noisy)
        one = travel_between(before, after, FOCAL_PX, CENTER_PX)
        assert one is not None
        found.append((one.left_rad, one.turned_rad, one.per_turn))
    left, turned, per_turn = np.array(found).T

    assert per_turn.min() > 3.0
    assert np.std(left - per_turn * turned) < 0.7 * np.std(left)
