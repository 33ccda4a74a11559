"""The simulated car's vehicle file: it parses, and its curves fit any size of picture."""

from __future__ import annotations

import numpy as np
import pytest

from crosscue.datasets.scenes.rendering.camera import SceneCamera
from crosscue.datasets.scenes.settings import scene_vehicle_text
from crosscue.detectors.ranging.height_to_range import range_of
from crosscue.replay.vehicle.vehicle import Vehicle, parse
from support.scenes import picture_at, world


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
