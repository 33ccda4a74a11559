"""Simulated pictures of sign templates, scaled, blurred and noisy, over clutter."""

from typing import NamedTuple

import cv2
import numpy as np

from crosscue.detectors.signs.templates import MARGIN_PX, Kind, draw_sign_template
from crosscue.replay.columns import Bytes, Floats


class Scene(NamedTuple):
    """A picture and the box of the one sign in it."""

    grey: Bytes
    box: Floats


def clutter(seed: int, size_px: tuple[int, int] = (640, 360)) -> Bytes:
    """Draw rectangles, lines and noise as a cluttered background."""
    rng = np.random.default_rng(seed)
    width, height = size_px
    grey = np.full((height, width), 150, np.uint8)
    for _ in range(60):
        x, y = int(rng.integers(0, width)), int(rng.integers(0, height))
        w, h = int(rng.integers(5, 90)), int(rng.integers(5, 60))
        shade = (int(rng.integers(20, 240)),)
        cv2.rectangle(grey, (x, y), (x + w, y + h), shade, -1)
        cv2.line(grey, (x, y), (x + 3 * w, y - h), shade, int(rng.integers(1, 4)))
    noisy = grey + rng.normal(0.0, 4.0, grey.shape)
    return np.asarray(np.clip(noisy, 0, 255), np.uint8)


def scene(kind: Kind, seed: int, height_px: int | None = None) -> Scene:
    """One sign at a random position in clutter, 44 to 110 pixels high (one-way signs half that)."""
    rng = np.random.default_rng(seed)
    height = int(rng.integers(44, 110)) if height_px is None else height_px
    drawing = draw_sign_template(kind, height)
    inner = drawing.grey[MARGIN_PX:-MARGIN_PX, MARGIN_PX:-MARGIN_PX].astype(np.float64)
    inner = inner * rng.uniform(0.6, 1.0) + rng.uniform(0.0, 20.0)
    grey = clutter(seed + 1000)
    h, w = inner.shape
    x, y = int(rng.integers(10, 620 - w)), int(rng.integers(10, 250 - h))
    grey[y : y + h, x : x + w] = np.clip(inner + rng.normal(0.0, 4.0, inner.shape), 0, 255)
    grey = np.asarray(cv2.GaussianBlur(grey, (0, 0), 0.7), np.uint8)
    return Scene(grey, np.array([x, y, x + w, y + h], np.float64))
