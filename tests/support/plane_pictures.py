"""Pictures of a known plane between two known walls, rendered ray by ray."""

import math
from typing import Final

import numpy as np

from crosscue.detectors.ranging.ground_plane import GroundPlane
from crosscue.replay.columns import Bytes, Floats
from crosscue.replay.vehicle.camera import Camera

SIZE_PX: Final = (640, 240)
CAMERA: Final = Camera(focal_px=360.0, center_px=(320.0, 100.0), z_m=1.6, x_m=1.0, pitch_rad=0.02)
WALL_M: Final = 9.0


def texture(seed: int) -> Floats:
    """Random smooth texture."""
    import cv2

    noise = np.random.default_rng(seed).normal(size=(1024, 1024))
    soft = sum(
        weight * cv2.GaussianBlur(noise, (0, 0), sigma) * sigma
        for sigma, weight in ((1.0, 1.0), (3.0, 1.0), (8.0, 1.0))
    )
    return np.asarray(128.0 + 40.0 * soft / np.std(soft), np.float64)


GROUND, WALL, SKY = texture(1), texture(2), texture(3)


def lookup(of: Floats, u_m: Floats, v_m: Floats, per_m: float) -> Floats:
    """Sample a texture between its points."""
    x, y = np.mod(u_m * per_m, 1023.0), np.mod(v_m * per_m, 1023.0)
    i, j = x.astype(int), y.astype(int)
    a, b = x - i, y - j
    rows = of[j, i] * (1 - a) + of[j, i + 1] * a, of[j + 1, i] * (1 - a) + of[j + 1, i + 1] * a
    return np.asarray(rows[0] * (1 - b) + rows[1] * b, np.float64)


def picture(x_m: float, y_m: float, heading_rad: float, *, plain: bool = False) -> Bytes:
    """What the camera sees from the rear axle at a pose."""
    ground = GroundPlane.of(CAMERA, SIZE_PX)
    columns, rows = np.meshgrid(np.arange(SIZE_PX[0]) + 0.0, np.arange(SIZE_PX[1]) + 0.0)
    rays = ground.rays(np.column_stack([columns.ravel(), rows.ravel()]))
    cos, sin = math.cos(heading_rad), math.sin(heading_rad)
    east, north = rays[:, 0] * cos - rays[:, 1] * sin, rays[:, 0] * sin + rays[:, 1] * cos
    x_m, y_m = x_m + CAMERA.x_m * cos, y_m + CAMERA.x_m * sin
    with np.errstate(divide="ignore"):
        to_ground = np.where(rays[:, 2] < 0.0, -CAMERA.z_m / rays[:, 2], np.inf)
        side = np.where(north > 0.0, WALL_M - y_m, -WALL_M - y_m)
        to_wall = np.where(north != 0.0, side / north, np.inf)
        to_end = np.where(east > 0.0, (120.0 - x_m) / east, np.inf)
    nearest = np.minimum(np.minimum(to_ground, to_wall), to_end)
    at_x, at_y, at_z = x_m + nearest * east, y_m + nearest * north, nearest * rays[:, 2]
    on_ground = lookup(GROUND, at_x, at_y + 50.0, 10.0)
    grey = np.where(
        nearest == to_ground,
        np.full_like(on_ground, 120.0) if plain else on_ground,
        np.where(
            nearest == to_wall,
            lookup(WALL, at_x, at_z + 50.0, 10.0),
            lookup(SKY, at_y + 200.0, at_z + 200.0, 2.0),
        ),
    )
    return np.clip(grey, 0.0, 255.0).astype(np.uint8).reshape(SIZE_PX[1], SIZE_PX[0])


def arc(step_m: float, turn_rad: float, n: int) -> list[tuple[float, float, float]]:
    """Poses of the rear axle on a circle."""
    poses = [(0.0, 0.0, 0.0)]
    for _ in range(n):
        x_m, y_m, heading = poses[-1]
        middle = heading + 0.5 * turn_rad
        poses.append(
            (x_m + step_m * math.cos(middle), y_m + step_m * math.sin(middle), heading + turn_rad)
        )
    return poses
