"""Draw rain in front of the camera: streaks in the air and drops on the windscreen."""

from __future__ import annotations

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray


def streaks(rgb: NDArray[np.uint8], rain: float, speed_mps: float, rng: Generator) -> None:
    """Draw falling drops as short bright lines, in place."""
    import cv2

    high, wide = rgb.shape[:2]
    size = wide / 1280
    veil = np.zeros((high, wide), np.uint8)
    for _ in range(round(420 * rain)):
        x, y = rng.uniform(0, wide), rng.uniform(0, high)
        near = rng.random() ** 2
        length = (8 + 34 * near) * size
        lean = 0.12 + 0.5 * (x / wide - 0.5) * min(speed_mps / 10.0, 1.0)
        ends = np.rint(np.array([x, y, x + lean * length, y + length]) * 16).astype(int).tolist()
        grey = int(30 + 50 * (1 - near))
        cv2.line(veil, (ends[0], ends[1]), (ends[2], ends[3]), grey, 1, cv2.LINE_AA, 4)
    lift = veil[..., None].astype(np.uint16)
    rgb[:] = (rgb + (255 - rgb.astype(np.uint16)) * lift // 400).astype(np.uint8)


def drops(rgb: NDArray[np.uint8], rain: float, rng: Generator) -> None:
    """Draw drops on the glass, which show the scene upside down and blurred, in place."""
    import cv2

    high, wide = rgb.shape[:2]
    for _ in range(round(34 * rain)):
        r = max(2, round(rng.uniform(3, 13) * wide / 1280))
        x, y = int(rng.integers(2 * r, wide - 2 * r)), int(rng.integers(2 * r, high - 2 * r))
        around = rgb[y - 2 * r : y + 2 * r, x - 2 * r : x + 2 * r]
        lens = cv2.resize(around, (2 * r, 2 * r), interpolation=cv2.INTER_AREA)[::-1]
        disc = np.zeros((2 * r, 2 * r), np.uint8)
        cv2.circle(disc, (r, r), round(0.8 * r), 210, -1, cv2.LINE_AA)
        soft = cv2.GaussianBlur(disc, (0, 0), 0.2 * r + 0.3)[..., None].astype(np.float32) / 255
        spot = rgb[y - r : y + r, x - r : x + r]
        spot[:] = (spot * (1 - soft) + np.minimum(lens * 0.94 + 10, 255) * soft).astype(np.uint8)
