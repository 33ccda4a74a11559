"""Projection between level ground and the picture of a pinhole camera, mounted at any angle.

Axes of the car and of the camera's body are forward, left, up (ISO 8855). The body is rotated from
the car by yaw about up, then pitch about left, then roll about forward, with the vehicle file's
values: yaw to the left, pitch down and roll to the right are positive. Points on the ground are
relative to the rear axle, ahead and to the left.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.vehicle.camera import Camera


@dataclass(frozen=True, slots=True, eq=False)
class GroundPlane:
    """A camera's view of the ground.

    Attributes:
        focal_px: Focal length.
        center_px: Principal point of the picture.
        position_m: Position of the camera: ahead of the rear axle, to its left, above the ground.
        to_car: Shape (3, 3): rotation from the camera's forward, left, up to the car's.
    """

    focal_px: float
    center_px: tuple[float, float]
    position_m: tuple[float, float, float]
    to_car: NDArray[np.float64]

    @classmethod
    @lru_cache(maxsize=16)
    def of(cls, camera: Camera, size_px: tuple[int, int]) -> GroundPlane:
        """Build the view of a camera with known focal length.

        Args:
            camera: Mounting of the camera.
            size_px: Width and height of the picture, whose centre is the default principal point.
        """
        return cls(
            camera.focal_px or math.nan,
            camera.center_px or (0.5 * size_px[0], 0.5 * size_px[1]),
            (camera.x_m, camera.y_m, camera.z_m),
            turned(camera.yaw_rad, camera.pitch_rad, camera.roll_rad),
        )

    def rays(self, points_px: NDArray[np.float64]) -> NDArray[np.float64]:
        """Convert pixels to directions in the car's axes, shape (N, 3), of unit depth.

        Args:
            points_px: Shape (N, 2): x and y.
        """
        right_down = (points_px - np.array(self.center_px)) / self.focal_px
        body = np.column_stack([np.ones(len(right_down)), -right_down])
        return np.asarray(body @ self.to_car.T, np.float64)

    def slope(self, x_px: float, y_px: float) -> float:
        """Downward slope of one pixel's ray per metre ahead; ``rays`` in plain numbers."""
        left = (self.center_px[0] - x_px) / self.focal_px
        above = (self.center_px[1] - y_px) / self.focal_px
        forward, _, up = self.to_car.tolist()
        ahead, rise = (one + by * left + high * above for one, by, high in (forward, up))
        return float(-rise / ahead)

    def seen_at(self, directions: NDArray[np.float64]) -> NDArray[np.float64]:
        """Project directions in the car's axes, shape (N, 3), to the picture, shape (N, 2).

        The result is NaN for directions next to or behind the camera.
        """
        forward, left, up = (directions @ self.to_car).T
        forward = np.where(forward > 0.0, forward, np.nan)
        center_x, center_y = self.center_px
        x = center_x - self.focal_px * left / forward
        return np.stack([x, center_y - self.focal_px * up / forward], axis=1)

    def project(self, ground_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Project ground points, shape (N, 2), to the picture; NaN next to or behind the camera."""
        x_m, y_m, z_m = self.position_m
        away_m = ground_m - np.array([x_m, y_m])
        return self.seen_at(np.column_stack([away_m, np.full(len(away_m), -z_m)]))

    def unproject(self, points_px: NDArray[np.float64]) -> NDArray[np.float64]:
        """Project pixels, shape (N, 2), to the ground; NaN at and above the horizon."""
        x_m, y_m, z_m = self.position_m
        rays = self.rays(points_px)
        below = np.where(rays[:, 2] < 0.0, -rays[:, 2], np.nan)
        return np.asarray(rays[:, :2] * (z_m / below)[:, None] + np.array([x_m, y_m]), np.float64)

    def ahead_px(self) -> tuple[float, float]:
        """Focus of expansion: the pixel that is stationary while the car drives straight ahead."""
        ((x, y),) = self.seen_at(np.array([[1.0, 0.0, 0.0]])).tolist()
        return x, y

    def horizon_px(self, x_px: NDArray[np.float64]) -> NDArray[np.float64]:
        """Vertical position of the horizon in the columns ``x_px``, shape (N,)."""
        forward, left, up = self.to_car[2]
        to_left = (self.center_px[0] - x_px) / self.focal_px
        return np.asarray(
            self.center_px[1] + self.focal_px * (forward + left * to_left) / up, np.float64
        )


def turned(yaw_rad: float, pitch_rad: float, roll_rad: float) -> NDArray[np.float64]:
    """Rotation matrix from the axes of a camera's body to the car's, shape (3, 3)."""
    (cy, sy), (cp, sp), (cr, sr) = (
        (math.cos(angle), math.sin(angle)) for angle in (yaw_rad, pitch_rad, roll_rad)
    )
    about_up = np.array([[cy, -sy, 0.0], [sy, cy, 0.0], [0.0, 0.0, 1.0]])
    about_left = np.array([[cp, 0.0, sp], [0.0, 1.0, 0.0], [-sp, 0.0, cp]])
    about_forward = np.array([[1.0, 0.0, 0.0], [0.0, cr, -sr], [0.0, sr, cr]])
    return np.asarray(about_up @ about_left @ about_forward, np.float64)
