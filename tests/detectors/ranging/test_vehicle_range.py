"""Ranges of vehicles, and the plane of the ground."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from crosscue.detectors.ranging.detection_range import (
    CAMERA_HEIGHT_SD,
    EDGE_FRACTION,
    EDGE_PX,
    OVERHANG_M,
    GroundCamera,
    detection_range,
    ground_range,
    size_range,
    vehicle_range,
)
from crosscue.detectors.ranging.ground_plane import GroundPlane, turned
from crosscue.detectors.ranging.standard_sizes import VEHICLES, SizePrior
from crosscue.detectors.ranging.usable import are_cut, is_cut
from crosscue.replay.vehicle.vehicle import Camera, Vehicle, parse

CAMERA = GroundCamera(focal_px=1500.0, height_m=1.5)
CENTER_Y_PX = 540.0
CAR = VEHICLES["car"]
SIZE = (1920, 1080)


def edge_px(range_m: float, camera: GroundCamera = CAMERA, pitch_rad: float = 0.0) -> float:
    """Return the row of a point on level ground."""
    angle = math.atan(camera.height_m / range_m) - pitch_rad
    return CENTER_Y_PX + camera.focal_px * math.tan(angle)


def slope(bottom_px: float) -> float:
    """Return the slope of the ray through a row of a level camera."""
    return (bottom_px - CENTER_Y_PX) / CAMERA.focal_px


@pytest.mark.parametrize("range_m", [4.0, 17.0, 40.0])
def test_range_of_a_point_on_level_ground_is_exact(range_m: float) -> None:
    found = ground_range(slope(edge_px(range_m)), 60.0, CAMERA)

    assert found is not None
    assert found.mean_m == pytest.approx(range_m, rel=1e-9)


def test_near_range_relies_on_ground_and_far_range_on_size() -> None:
    tall = SizePrior(1.65, 0.15)
    for range_m, nearer in ((8.0, "ground"), (60.0, "size")):
        height_px = 1500.0 * 2.0 / range_m
        both = vehicle_range(slope(edge_px(range_m)), height_px, CAMERA, tall)
        by_size = size_range(height_px, 1500.0, tall)
        by_ground = ground_range(slope(edge_px(range_m)), height_px, CAMERA)
        assert by_ground is not None
        to_ground = abs(math.log(both.mean_m / by_ground.mean_m))
        to_size = abs(math.log(both.mean_m / by_size.mean_m))
        assert (to_ground < to_size) == (nearer == "ground")
        assert both.sd_m < min(by_size.sd_m, by_ground.sd_m)


@pytest.mark.parametrize("range_m", [10.0, 20.0, 35.0])
def test_range_interval_has_its_nominal_coverage(range_m: float) -> None:
    rng = np.random.default_rng(3)
    inside = 0
    for _ in range(2000):
        height_m = math.exp(CAR.log_mean + math.sqrt(CAR.log_var) * rng.normal())
        true_px = 1500.0 * height_m / range_m
        edge_sd = math.hypot(EDGE_PX, EDGE_FRACTION * true_px)
        tilt, raised = 0.005 * rng.normal(), 1.0 + CAMERA_HEIGHT_SD * rng.normal()
        stands_m = range_m + OVERHANG_M * rng.normal()
        camera = GroundCamera(1500.0, 1.5 * raised)
        bottom_px = edge_px(stands_m, camera, tilt) + edge_sd * rng.normal()
        found = vehicle_range(slope(bottom_px), true_px + edge_sd * rng.normal(), CAMERA, CAR)
        inside += abs(found.mean_m - range_m) < 1.96 * found.sd_m

    assert 0.92 <= inside / 2000 <= 0.985


def vehicle(text: str) -> Vehicle:
    return parse("version = 1\n" + text, "v.toml")


FOCAL = "[camera]\nfocal_px = 1500.0\nx_m = 1.5\nz_m = 1.5\n"
CURVE = "[ranges.traffic_light]\nparameters = [1800.0]\nresidual_sd_m = 4.0\n"
BOX = np.array([900.0, 300.0, 914.0, 330.0])


@pytest.mark.parametrize(
    ("text", "range_m", "sd_m"),
    [(FOCAL + CURVE, 60.0, 4.0), (FOCAL, 1500.0 * 1.26 / 30.0 + 1.5, 0.15 * 63.0)],
)
def test_default_range_is_used_without_a_fitted_curve(
    text: str, range_m: float, sd_m: float
) -> None:
    found = detection_range(vehicle(text), "traffic light", BOX, 30.0, SIZE)

    assert found is not None
    assert found.mean_m == pytest.approx(range_m, rel=0.02)
    assert found.sd_m == pytest.approx(sd_m, rel=0.2)


@pytest.mark.parametrize(("yaw", "roll"), [(0.1, 0.0), (0.0, 0.05), (-0.1, 0.03)])
def test_range_does_not_depend_on_camera_yaw_and_roll(yaw: float, roll: float) -> None:
    found = []
    for turns in ("", f"yaw_rad = {yaw}\nroll_rad = {roll}\n"):
        car = vehicle(FOCAL + turns)
        ((x, y),) = GroundPlane.of(car.camera, SIZE).project(np.array([[13.5, 2.0]]))
        found.append(detection_range(car, "bus", np.array([x - 9, y - 9, x + 9, y]), 380.0, SIZE))

    assert found[0] is not None
    assert found[0] == pytest.approx(found[1])


@pytest.mark.parametrize(
    ("label", "box"),
    [
        ("person", (900.0, 500.0, 930.0, 600.0)),
        ("car", (0.0, 500.0, 80.0, 600.0)),
        ("bus", (900.0, 500.0, 1300.0, 1080.0)),
    ],
)
def test_object_without_size_or_at_the_picture_edge_has_no_range(
    label: str, box: tuple[float, float, float, float]
) -> None:
    assert detection_range(vehicle(FOCAL), label, np.array(box), 100.0, SIZE) is None


SIZE_PLANE = (1280, 720)
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
    return GroundPlane.of(camera, SIZE_PLANE)


@given(ahead_m=st.floats(3.0, 80.0), left_m=st.floats(-30.0, 30.0))
def test_ground_point_is_projected_by_the_pinhole_model(ahead_m: float, left_m: float) -> None:
    ((x, y),) = plane().project(np.array([[ahead_m + 1.7, left_m + 0.3]])).tolist()

    assert x == pytest.approx(640.0 - 900.0 * left_m / ahead_m)
    assert y == pytest.approx(340.0 + 900.0 * 1.5 / ahead_m)


@given(angles, angles, angles, st.floats(5.0, 80.0), st.floats(-0.5, 0.5))
def test_unprojection_inverts_projection(
    yaw: float, pitch: float, roll: float, ahead_m: float, slope: float
) -> None:
    ground = np.array([[1.7 + ahead_m, ahead_m * slope]])
    mounted = plane(yaw, pitch, roll)

    np.testing.assert_allclose(
        mounted.unproject(mounted.project(ground)), ground, rtol=1e-7, atol=1e-6
    )


@given(angles, angles, angles, st.floats(0.0, 1280.0), st.floats(0.0, 720.0))
def test_slope_of_one_pixel_is_that_of_its_ray(
    yaw: float, pitch: float, roll: float, x_px: float, y_px: float
) -> None:
    mounted = plane(yaw, pitch, roll)

    ((ahead, _, up),) = mounted.rays(np.array([[x_px, y_px]])).tolist()
    assert mounted.slope(x_px, y_px) == pytest.approx(-up / ahead, rel=1e-9, abs=1e-12)


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


@given(box=st.lists(st.sampled_from([0.0, 1.9, 2.0, 50.0, 98.0, 98.1]), min_size=4, max_size=4))
def test_one_box_is_cut_as_boxes_are(box: list[float]) -> None:
    box_px = np.array(box)

    assert is_cut(box_px, (100, 52)) == are_cut(box_px[None], (100, 52))[0]
