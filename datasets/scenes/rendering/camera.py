"""Pinhole camera behind the windscreen, its pose over time, and the ground that its pixels show.

Road is the drivable area between the kerbs: the approach, the crossroad, the road ahead and rounded
corners, with lines, crosswalks and parking lanes. Sidewalks, driveways, parking lots and grass are
not road, and neither are pixels of which half or more shows an object.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from crosscue.datasets.scenes.motion import ApproachMotion
from crosscue.replay.columns import Floats

from .ground import TEXELS_PER_M, X_M, Y_M


@dataclass(frozen=True, slots=True)
class SceneCamera:
    """Size, lens and mounting of a camera.

    Attributes:
        width_px: Width of the picture.
        height_px: Height of the picture.
        focal_px: Focal length; None for 0.55 picture widths (85 degrees across).
        x_m: Distance ahead of the rear axle.
        z_m: Height above the road.
        pitch_rad: Pitch, positive downwards.
    """

    width_px: int = 1280
    height_px: int = 720
    focal_px: float | None = None
    x_m: float = 1.7
    z_m: float = 1.45
    pitch_rad: float = 0.01

    @property
    def focal(self) -> float:
        """Focal length in pixels."""
        return 0.55 * self.width_px if self.focal_px is None else self.focal_px

    @property
    def centre_px(self) -> tuple[float, float]:
        """Intersection of the optical axis with the picture."""
        return 0.5 * self.width_px, 0.5 * self.height_px


@dataclass(frozen=True, slots=True, eq=False)
class CameraView:
    """A camera at one time.

    Attributes:
        camera: The camera.
        eye_axes: Rotation from local axes to right, down, ahead, shape (3, 3).
        at_m: Position of the camera in the local frame, shape (3,).
        rear_axle: x, y and heading of the car.
        speed_mps: Speed of the car.
        yaw_rate_radps: Yaw rate of the car.
    """

    camera: SceneCamera
    eye_axes: Floats
    at_m: Floats
    rear_axle: tuple[float, float, float]
    speed_mps: float
    yaw_rate_radps: float

    def project(self, points_m: Floats) -> Floats:
        """Project local points (N, 3) to pixels and depth, (N, 3); the origin is the corner."""
        eye = (points_m - self.at_m) @ self.eye_axes.T
        cx, cy = self.camera.centre_px
        with np.errstate(divide="ignore", invalid="ignore"):
            x = cx + self.camera.focal * eye[:, 0] / eye[:, 2]
            y = cy + self.camera.focal * eye[:, 1] / eye[:, 2]
        return np.column_stack([x, y, eye[:, 2]])


def view_at(camera: SceneCamera, approach: ApproachMotion, t_s: float) -> CameraView:
    """Return the view at a time; the body pitches with acceleration and shakes slightly."""
    motion = approach.motion
    at = np.arange(len(motion)) * 0.01
    x, y, heading, speed, rate = (
        float(np.interp(t_s, at, column))
        for column in (
            motion.x_m,
            motion.y_m,
            motion.heading_rad,
            motion.speed_mps,
            motion.yaw_rate_radps,
        )
    )
    before, after = np.interp([t_s - 0.25, t_s + 0.05], at, motion.speed_mps)
    nod = -0.0045 * float(after - before) / 0.3
    shake = 0.0011 * min(speed / 8.0, 1.0)
    nod += shake * (np.sin(9.1 * t_s) + 0.7 * np.sin(23.7 * t_s + 1.0))
    pitch = camera.pitch_rad + nod
    c, s = np.cos(heading), np.sin(heading)
    ahead = np.array([c * np.cos(pitch), s * np.cos(pitch), -np.sin(pitch)])
    right = np.array([s, -c, 0.0])
    down = np.cross(ahead, right)
    at_m = np.array([x + camera.x_m * c, y + camera.x_m * s, camera.z_m])
    return CameraView(camera, np.stack([right, down, ahead]), at_m, (x, y, heading), speed, rate)


# Vertical component of a ray above which it does not meet the ground.
SKY_UP = -0.002


def ground_seen(
    codes: NDArray[np.uint8], depth: NDArray[np.float32], samples: int, view: CameraView
) -> NDArray[np.uint8]:
    """Return the code of the ground that each pixel shows, shape (H, W); 0 behind objects.

    Args:
        codes: Map of the ground, of the size of ``Ground.road``.
        depth: Buffer of 1/z of the samples, 0 without object; (H * samples, W * samples).
        samples: Samples per pixel in each direction.
        view: View of the camera.
    """
    high, wide = depth.shape[0] // samples, depth.shape[1] // samples
    ray = _rays(view)
    up = ray[2]
    # A ray meets the ground at camera - ray * height / up; times up, that is linear in the pixel.
    camera, z = view.at_m, float(view.at_m[2])
    onto = np.stack(
        [
            ((camera[0] - X_M[0]) * up - z * ray[0]) * TEXELS_PER_M,
            ((camera[1] - Y_M[0]) * up - z * ray[1]) * TEXELS_PER_M,
            up,
        ]
    )
    flat = cv2.warpPerspective(
        codes,
        onto,
        (wide, high),
        flags=cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,
    )
    free = (depth == 0.0).reshape(high, samples, wide, samples).sum(axis=(1, 3), dtype=np.uint8)
    is_ground = _falls(ray, wide, high) & (2 * free > samples**2)
    seen: NDArray[np.uint8] = np.asarray(flat, np.uint8) * is_ground
    return seen


def _rays(view: CameraView) -> Floats:
    """Return the matrix from a pixel's (column, row, 1) to its ray in the local frame, (3, 3)."""
    f, (cx, cy) = view.camera.focal, view.camera.centre_px
    lens = np.array([[1 / f, 0.0, (0.5 - cx) / f], [0.0, 1 / f, (0.5 - cy) / f], [0.0, 0.0, 1.0]])
    ray: Floats = view.eye_axes.T @ lens
    return ray


def _falls(ray: Floats, wide: int, high: int) -> NDArray[np.bool_]:
    column, row = np.arange(wide, dtype=np.float32), np.arange(high, dtype=np.float32)[:, None]
    x, y, z = (k[0] * column + k[1] * row + k[2] for k in ray.astype(np.float32))
    falls: NDArray[np.bool_] = (z < 0.0) & (z * z > SKY_UP**2 * (x * x + y * y + z * z))
    return falls
