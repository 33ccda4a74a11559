"""Overlays anchored to the road are drawn on the road, and arrows follow the motion of cars."""

import numpy as np

from crosscue.detectors.cues.observed import Place
from crosscue.detectors.cues.road_ground import outlines
from crosscue.detectors.cues.tracked.motion import CarMotion
from crosscue.eval.recording.anchored import way_px
from crosscue.replay.vehicle.vehicle import Camera, Regions

SIZE = (1280, 720)
CAMERA = Camera(x_m=1.7, z_m=1.4, focal_px=700.0, center_px=(640.0, 360.0))
BOX = (700.0, 380.0, 740.0, 400.0)


def car(right_mps: float, ahead_mps: float) -> CarMotion:
    """A car below and to the right of the optical axis, 40 m away."""
    seen = CarMotion(1, 10, 40.0, 0.1, right_mps, 0.1, ahead_mps, 0.1, True, 2.0, 0.0)
    return seen._replace(box_px=BOX)


def test_oncoming_car_moves_from_the_optical_axis_and_outgoing_towards_it() -> None:
    assert (way_px(car(0.0, -10.0), CAMERA, SIZE) > 0.0).all()
    assert (way_px(car(0.0, 10.0), CAMERA, SIZE) < 0.0).all()


def test_arrow_of_crossing_car_equals_pinhole_projection() -> None:
    np.testing.assert_allclose(way_px(car(8.0, 0.0), CAMERA, SIZE), [700.0 * 8.0 / 40.0, 0.0])


def test_regions_are_below_the_horizon_and_symmetric() -> None:
    left, straight, right = outlines(CAMERA, Regions(kind="ground"), Place(20.0, 36.0, 0.5), SIZE)

    assert left is not None
    assert straight is not None
    assert right is not None
    for corners in (left, straight, right):
        assert (corners[:, 1] > 360.0).all()
    mirrored = np.sort(1280.0 - right[:, 0])
    np.testing.assert_allclose(np.sort(left[:, 0]), mirrored)
    assert left[:, 0].max() < straight[:, 0].min() < straight[:, 0].max() < right[:, 0].min()
