"""Detect the lit lens of a traffic light, which is visible only from the front.

A housing seen from behind or from the side is completely dark and is no signal for the ego vehicle.
Classical image processing finds the largest spot inside the box that has a signal's colour, is
bright, saturated and round, and has about the size of a lens. A single frame is unreliable, because
lamps flicker and hoods hide them, so a track combines many frames to decide whether a light faces
the car.
"""

import math
from collections.abc import Mapping
from typing import Final, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

# Version of the rule; cached results of other versions are not used.
VERSION: Final = 2
Lens = Literal["red", "yellow", "green", "dark", "unknown"]
MIN_WIDTH_PX: Final = 6.0
# Height below which a box is too small: its lens, a third of it, is under five pixels.
MIN_HEIGHT_PX: Final = 14.0
MIN_SATURATION: Final = 90
# Minimum saturation and value, of 255. Sunlit walls and sky are pale, housings are dark.
MIN_VALUE: Final = 120
# Hues in OpenCV's half degrees; signal green is bluish (CIE S 004), and more so in cameras.
HUES: Final[Mapping[Lens, tuple[tuple[int, int], ...]]] = {
    "red": ((0, 10), (160, 179)),
    "yellow": ((11, 34),),
    "green": ((45, 105),),
}
# Number of the colour, from 1, by hue.
_COLOURS: Final = np.zeros(256, np.uint8)
for _number, _bands in enumerate(HUES.values(), 1):
    for _low, _high in _bands:
        _COLOURS[_low : _high + 1] = _number
# Bounds of the spot's diameter over the box's width: 0.30 m of 0.35 m without a backplate and of
# 0.60 m with one, with a margin for glare and blur.
LENS_PER_WIDTH: Final = (0.2, 1.0)
# Minimum fraction of the spot's bounding box that it fills (a disc: 0.79).
MIN_ROUND: Final = 0.5
# Maximum ratio of the spot's longer to its shorter side.
MAX_LONG: Final = 2.0
# Fraction of the box's width that is left out on either side, as background.
MARGIN: Final = 0.06


def lens_of(pixels: NDArray[np.uint8], box_px: NDArray[np.float64]) -> Lens:
    """Find the lit lens in one box; ``dark`` if none is lit, ``unknown`` if the box is too small.

    Args:
        pixels: Shape (H, W, 3), blue, green, red; or (H, W). In grey, the lens is unknown.
        box_px: x0, y0, x1, y1 in those pixels.
    """
    x0, y0, x1, y1 = box_px.tolist()
    width, height = x1 - x0, y1 - y0
    if pixels.ndim == 2 or width < MIN_WIDTH_PX or height < MIN_HEIGHT_PX:
        return "unknown"
    left, right = max(round(x0 + MARGIN * width), 0), round(x1 - MARGIN * width)
    crop = pixels[max(round(y0), 0) : round(y1), left:right]
    if not crop.size:
        return "unknown"
    hue, saturation, value = cv2.split(cv2.cvtColor(crop, cv2.COLOR_BGR2HSV))
    if not saturation.any():
        return "unknown"
    is_lit = (saturation >= MIN_SATURATION) & (value >= MIN_VALUE)
    lit: dict[Lens, float] = {"dark": 0.0}
    colours = np.asarray(cv2.LUT(hue, _COLOURS), np.uint8) * is_lit
    for number, colour in enumerate(HUES, 1):
        is_colour = colours == number
        lit[colour] = _spot_px(is_colour, min(width, height)) if is_colour.any() else 0.0
    return max(lit, key=lambda colour: lit[colour])


def _spot_px(is_lit: NDArray[np.bool_], width_px: float) -> float:
    """Area of the largest spot that can be a lens; 0 without one."""
    count, _, found, _ = cv2.connectedComponentsWithStats(is_lit.astype(np.uint8))
    best = 0.0
    for i in range(1, count):
        _, _, wide, high, area = found[i].tolist()
        across = math.sqrt(4.0 * area / math.pi) / width_px
        is_round = area >= MIN_ROUND * wide * high and max(wide, high) <= MAX_LONG * min(wide, high)
        if is_round and LENS_PER_WIDTH[0] <= across <= LENS_PER_WIDTH[1]:
            best = max(best, float(area))
    return best
