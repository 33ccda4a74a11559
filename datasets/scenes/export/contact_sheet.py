"""Render a contact sheet: one small picture of every run, layouts as rows, runs as columns."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from crosscue.datasets.scenes.rendering.render import Renderer
from crosscue.datasets.scenes.settings import SceneSettings, world_of
from crosscue.detectors.overlay import write_label

# Distance of the pictures before the intersection.
BEFORE_M: Final = 25.0
# Central fraction of each picture's width and height that is shown; the rest is mostly sky.
SHOWN: Final = 0.7


def contact_sheet(
    runs: Sequence[SceneSettings], columns: int, width_px: int = 192
) -> NDArray[np.uint8]:
    """Return pictures of all runs, ``columns`` in a row, each with its name in a corner.

    Args:
        runs: Runs, row by row.
        columns: Number of pictures in a row.
        width_px: Width of a picture in the sheet; it is rendered as in a drive and resized.
    """
    import cv2

    high = width_px * 9 // 16
    rows = -(-len(runs) // columns)
    sheet = np.full((rows * high, columns * width_px, 3), 255, np.uint8)
    for place, settings in enumerate(runs):
        _, _, world = world_of(settings)
        motion = world.approach.motion
        t_s = float(np.argmax(motion.x_m >= -BEFORE_M)) / 100.0
        rgb = _middle(Renderer(world, settings.camera, settings.picture).picture(t_s).rgb)
        small = np.asarray(
            cv2.resize(rgb, (width_px, high), interpolation=cv2.INTER_AREA), np.uint8
        )
        write_label(small, settings.name, (4, high - 5), (255, 255, 255), 0.4)
        y, x = place // columns * high, place % columns * width_px
        sheet[y : y + high, x : x + width_px] = small
    return sheet


def _middle(rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
    y, x = (round(side * (1.0 - SHOWN) / 2.0) for side in rgb.shape[:2])
    return np.ascontiguousarray(rgb[y : rgb.shape[0] - y, x : rgb.shape[1] - x])


def sheet_jpeg(sheet: NDArray[np.uint8], quality: int = 82) -> bytes:
    """Encode a sheet as JPEG."""
    import cv2

    bgr = np.ascontiguousarray(sheet[..., ::-1])
    return bytes(cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, quality])[1])
