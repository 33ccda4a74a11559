"""Load drawings of US road signs, as pictures with transparency (RGBA).

They are read from files because fonts differ between versions of OpenCV.
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib.resources import files
from typing import Final

import numpy as np
from numpy.typing import NDArray

Rgba = NDArray[np.uint8]

WIDTH_M: Final[Mapping[str, float]] = {
    "stop_sign": 0.76,
    "do_not_enter": 0.76,
    "one_way_left": 1.37,
    "one_way_right": 1.37,
    "speed_limit": 0.61,
}


def sign(name: str) -> Rgba:
    """Return a sign named in ``WIDTH_M``, with a width of 128 pixels."""
    import cv2

    path = files("crosscue.datasets.scenes.rendering").joinpath("drawings", f"{name}.png")
    bgra = cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_UNCHANGED)
    return np.ascontiguousarray(np.asarray(bgra, np.uint8)[..., [2, 1, 0, 3]])
