"""Road masks of areas on the ground, as a camera with any focal length and height sees them."""

from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from crosscue.detectors import rle
from crosscue.detectors.base import RoadMask

SIZE_PX = (640, 360)
# Corners of areas on the ground: metres to the right, metres ahead.
Area = list[tuple[float, float]]
ROAD: Area = [(-5.0, 2.0), (3.0, 2.0), (3.0, 150.0), (-5.0, 150.0)]
RIGHT: Area = [(0.0, 14.0), (60.0, 14.0), (60.0, 22.0), (0.0, 22.0)]
LEFT: Area = [(0.0, 14.0), (-60.0, 14.0), (-60.0, 22.0), (0.0, 22.0)]


def seen_from(areas: list[Area], focal: float, height_m: float, row: float) -> RoadMask:
    """The mask of areas, seen by a camera with its focal length in picture widths."""
    pixels = np.zeros(SIZE_PX[::-1], np.uint8)
    focal_px = focal * SIZE_PX[0]
    for area in areas:
        # Edges are followed in short steps, so that a side far away does not bend.
        ends = [*area, area[0]]
        points = [
            (x0 + f * (x1 - x0), z0 + f * (z1 - z0))
            for (x0, z0), (x1, z1) in pairwise(ends)
            for f in np.linspace(0.0, 1.0, 20)
        ]
        corners = [
            (320 + focal_px * x / z, row * SIZE_PX[1] + focal_px * height_m / z) for x, z in points
        ]
        cv2.fillPoly(pixels, [np.round(corners).astype(np.int32)], 1)
    return mask_of(pixels > 0)


def mask_of(pixels: NDArray[np.bool_]) -> RoadMask:
    return RoadMask(0, SIZE_PX, rle.encode_mask(pixels, (0, 0), SIZE_PX), SIZE_PX)
