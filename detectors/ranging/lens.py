"""Which way a traffic light faces, from its picture: a lit lens is seen only from the front.

A housing seen from behind or from the side is dark all over, and is not a signal for this car. The
rule is plain image processing: inside the box, the largest spot of a signal's colour, bright,
saturated, round, and about as large as a lens should be. One frame proves little (lamps flicker,
hoods hide them), so that a light faces the car or does not is said of a track, over many frames.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from crosscue.detectors.base import Detections, Frame

VERSION: Final = 1
"""Of the rule; results kept by an older one are not used."""
Lens = Literal["red", "yellow", "green", "dark", "unknown"]
MIN_WIDTH_PX: Final = 6.0
MIN_HEIGHT_PX: Final = 14.0
"""A smaller box says nothing: a lens of a third of its height is under five pixels."""
MIN_SATURATION: Final = 90
MIN_VALUE: Final = 120
"""Of 255. Sunlit walls and sky are pale, housings dark."""
HUES: Final[Mapping[Lens, tuple[tuple[int, int], ...]]] = {
    "red": ((0, 10), (160, 179)),
    "yellow": ((11, 34),),
    "green": ((45, 105),),
}
"""In OpenCV's half degrees; signal green is a bluish one (CIE S 004), and cameras lean to cyan."""
LENS_PER_WIDTH: Final = (0.2, 1.0)
"""Diameter of the spot by the width of the box: 0.30 m of 0.35 m bare, of 0.60 m with a
backplate, and glare or a blurred rim beyond that."""
MIN_ROUND: Final = 0.5
"""Fraction of the spot's own bounding box that it fills (a disc: 0.79)."""
MAX_LONG: Final = 2.0
"""Longer side of the spot by the shorter."""
MARGIN: Final = 0.06
"""Of the box's width, left out on either side: what is behind the housing."""


def lens_of(pixels: NDArray[np.uint8], box_px: NDArray[np.float64]) -> Lens:
    """The lit lens in one box; ``dark`` where none is lit, ``unknown`` where too small to say.

    Args:
        pixels: Shape (H, W, 3), blue, green, red; or (H, W) grey, which says nothing.
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
    import cv2

    hue, saturation, value = cv2.split(cv2.cvtColor(crop, cv2.COLOR_BGR2HSV))
    is_lit = (saturation >= MIN_SATURATION) & (value >= MIN_VALUE)
    lit: dict[Lens, float] = {"dark": 0.0}
    for colour, bands in HUES.items():
        is_colour = np.any([(hue >= low) & (hue <= high) for low, high in bands], axis=0)
        lit[colour] = _spot_px(is_lit & is_colour, min(width, height))
    return max(lit, key=lambda colour: lit[colour])


def with_lenses(found: Detections, frame: Frame, labels: Sequence[str]) -> Detections:
    """The same detections, with the lenses of those that carry one of ``labels``.

    Args:
        found: In one frame.
        frame: Its pixels, perhaps smaller than the camera's.
        labels: Of traffic lights.
    """
    if not any(label in labels for label in found.labels):
        return found
    scale = np.array([*frame.scale, *frame.scale])
    return replace(
        found,
        lenses=tuple(
            lens_of(frame.pixels, box_px / scale) if label in labels else ""
            for label, box_px in zip(found.labels, found.boxes_px, strict=True)
        ),
    )


def _spot_px(is_lit: NDArray[np.bool_], width_px: float) -> float:
    """Area of the largest spot that a lens may be; 0 for none."""
    import cv2

    count, _, found, _ = cv2.connectedComponentsWithStats(is_lit.astype(np.uint8))
    best = 0.0
    for i in range(1, count):
        _, _, wide, high, area = found[i].tolist()
        across = math.sqrt(4.0 * area / math.pi) / width_px
        is_round = area >= MIN_ROUND * wide * high and max(wide, high) <= MAX_LONG * min(wide, high)
        if is_round and LENS_PER_WIDTH[0] <= across <= LENS_PER_WIDTH[1]:
            best = max(best, float(area))
    return best
