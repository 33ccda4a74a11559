"""Masks as closed lines, for drawing."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from . import rle


def outline(
    mask: bytes, size_px: tuple[int, int], box_px: NDArray[np.float64]
) -> list[NDArray[np.float64]]:
    """Closed strips of shape (N, 2) around a mask, to a pixel; none for an empty mask."""
    if not mask:
        return []
    x0, y0 = (int(v) for v in np.maximum(np.floor(box_px[:2]) - 1, 0))
    x1, y1 = (int(v) for v in np.ceil(box_px[2:]) + 1)
    return borders(rle.decode(mask, size_px)[y0:y1, x0:x1], (x0, y0))


def borders(mask: NDArray[np.bool_], corner_px: tuple[int, int]) -> list[NDArray[np.float64]]:
    """Closed strips around the parts of a mask whose top-left pixel is ``corner_px``."""
    import cv2

    inside = np.ascontiguousarray(mask).view(np.uint8)
    found, _ = cv2.findContours(inside, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    rounded = [cv2.approxPolyDP(line, 1.0, closed=True)[:, 0, :] for line in found]
    corner = np.array(corner_px, np.float64) + 0.5
    return [corner + np.vstack([line, line[:1]]) for line in rounded if len(line) > 2]
