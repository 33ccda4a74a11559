"""Tests of the projection of the ground for a camera mounted at any angle."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from crosscue.detectors.ranging.ground_plane import GroundPlane, turned
from crosscue.replay.vehicle.vehicle import Camera

SIZE = (1280, 720)
angles = st.floats(-0.25, 0.25)


def plane(yaw_rad: float = 0.0, pitch_rad: float = 0.0, roll_rad: float = 0.0) -> GroundPlane:
    camera = Camera(
        x_m=1.7,
        y_m=0.3,
        z_m=1.5,
        focal_px=900.0,
        center_px=(640.0, 340.0),
        yaw_rad=yaw_rad,
        pitch_rad=pitch_rad,
        roll_rad=roll_rad,
    )
    return GroundPlane.of(camera, SIZE)


@given(angles, angles, angles, st.floats(5.0, 80.0), st.floats(-0.5, 0.5))
def test_unprojection_inverts_projection(
    yaw: float, pitch: float, roll: float, ahead_m: float, slope: float
) -> None:
    ground = np.array([[1.7 + ahead_m, ahead_m * slope]])
    mounted = plane(yaw, pitch, roll)

    np.testing.assert_allclose(
        mounted.unproject(mounted.project(ground)), ground, rtol=1e-7, atol=1e-6
    )


@given(angles, angles, angles)
def test_mounting_rotation_matches_scipy(yaw: float, pitch: float, roll: float) -> None:
    expected = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix()

    np.testing.assert_allclose(turned(yaw, pitch, roll), expected, atol=1e-12)


@given(angles, angles, angles, st.floats(-1.0, 1.0))
def test_horizon_is_the_projection_of_distant_ground(
    yaw: float, pitch: float, roll: float, bearing: float
) -> None:
    mounted = plane(yaw, pitch, roll)
    far = np.array([[math.cos(bearing), math.sin(bearing), 0.0]])
    ((x, y),) = mounted.seen_at(far)

    assert mounted.horizon_px(np.array([x]))[0] == pytest.approx(y, abs=1e-6)
