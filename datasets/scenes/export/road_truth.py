"""Ground truth of road segmentation: the pixels of a picture that show road.

Road is the drivable area between the kerbs: the approach, the crossroad, the road ahead and rounded
corners, with lines, crosswalks and parking lanes. Sidewalks, driveways, parking lots and grass are
not road, and neither are pixels of which half or more shows an object.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from crosscue.datasets.scenes.rendering.camera import CameraView
from crosscue.datasets.scenes.rendering.ground import TEXELS_PER_M, X_M, Y_M

# Vertical component of a ray above which it does not meet the ground.
SKY_UP = -0.002


def road_seen(
    road: NDArray[np.uint8], depth: NDArray[np.float32], samples: int, view: CameraView
) -> NDArray[np.bool_]:
    """Return a mask of road pixels, shape (H, W); ``road`` is ``Ground.road``, 0 or 1."""
    return np.asarray(ground_seen(road, depth, samples, view) > 0)


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
    import cv2

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


def _rays(view: CameraView) -> NDArray[np.float64]:
    """Return the matrix from a pixel's (column, row, 1) to its ray in the local frame, (3, 3)."""
    f, (cx, cy) = view.camera.focal, view.camera.centre_px
    lens = np.array([[1 / f, 0.0, (0.5 - cx) / f], [0.0, 1 / f, (0.5 - cy) / f], [0.0, 0.0, 1.0]])
    ray: NDArray[np.float64] = view.eye_axes.T @ lens
    return ray


def _falls(ray: NDArray[np.float64], wide: int, high: int) -> NDArray[np.bool_]:
    column, row = np.arange(wide, dtype=np.float32), np.arange(high, dtype=np.float32)[:, None]
    x, y, z = (k[0] * column + k[1] * row + k[2] for k in ray.astype(np.float32))
    falls: NDArray[np.bool_] = (z < 0.0) & (z * z > SKY_UP**2 * (x * x + y * y + z * z))
    return falls
