"""From a picture to a network's input, and from its pixels back."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from crosscue.detectors.base import View
from crosscue.detectors.catalog.card import Input
from crosscue.detectors.decoders.base import Array, Size


@dataclass(frozen=True, slots=True)
class Placement:
    """Where a picture is in a network's input: input = picture * scale + offset, x and y.

    Attributes:
        scale: Along x and y.
        offset: Likewise.
        size_px: Width and height of the input.
    """

    scale: tuple[float, float]
    offset: tuple[float, float]
    size_px: Size

    def to_picture(self, boxes_px: NDArray[np.float64]) -> NDArray[np.float64]:
        """Boxes (N, 4) in input pixels as boxes in the picture's."""
        return np.asarray((boxes_px - np.tile(self.offset, 2)) / np.tile(self.scale, 2), np.float64)


def view_of(want: Input) -> View:
    """How finely pictures are decoded; in full for a network that scales them itself."""
    if want.decode == "full" or want.fit == "network":
        return View()
    return View(min_width_px=want.width_px)


def place(picture: Size, want: Input) -> Placement:
    """Where a picture of this width and height goes."""
    width, height = picture
    whole = (want.width_px, want.height_px)
    if want.fit == "network":
        return Placement((1.0, 1.0), (0.0, 0.0), picture)
    ratio = (want.width_px / width, want.height_px / height)
    if want.fit == "stretch":
        return Placement(ratio, (0.0, 0.0), whole)
    if want.fit == "crop":
        larger = max(ratio)
        centered = ((want.width_px - width * larger) / 2, (want.height_px - height * larger) / 2)
        return Placement((larger, larger), centered, whole)
    size = _inside(picture, want)
    scale = (size[0] / width, size[1] / height)
    if want.fit == "letterbox":
        return Placement(scale, (0.0, 0.0), whole)
    spare = (want.width_px - size[0], want.height_px - size[1])
    return Placement(scale, (float(spare[0] // 2), float(spare[1] // 2)), whole)


def prepared(pixels: NDArray[np.uint8], want: Input) -> tuple[Array, Placement]:
    """A picture (H, W, 3) as a network's input with its batch axis, and where it is there."""
    height, width = pixels.shape[:2]
    placement = place((width, height), want)
    if want.fit == "network":
        return _numbers(pixels, want, (0, 0), (width, height))[None], placement
    left, top = (max(int(o), 0) for o in placement.offset)
    fitted = _fitted(pixels, want, placement)
    return _numbers(fitted, want, (left, top), placement.size_px)[None], placement


def _fitted(pixels: NDArray[np.uint8], want: Input, placement: Placement) -> NDArray[np.uint8]:
    """The picture at the size that it has in the input."""
    import cv2

    height, width = pixels.shape[:2]
    size = (want.width_px, want.height_px)
    if want.fit == "crop":
        x, y = (round(-o / s) for o, s in zip(placement.offset, placement.scale, strict=True))
        pixels = pixels[y : height - y or None, x : width - x or None]
    elif want.fit != "stretch":
        size = _inside((width, height), want)
    return np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_LINEAR), np.uint8)


def _numbers(pixels: NDArray[np.uint8], want: Input, corner: Size, size_px: Size) -> Array:
    """Pixels in the network's order, type and scale, the pad's value around them.

    Args:
        pixels: Shape (h, w, 3), blue, green, red.
        want: The network's input.
        corner: Left and top of the pixels in the input.
        size_px: Width and height of the input.
    """
    import cv2

    (left, top), (height, width) = corner, pixels.shape[:2]
    numbers = np.empty((3, size_px[1], size_px[0]), want.dtype)
    planes = cv2.split(pixels)
    for i, plane in enumerate(reversed(planes) if want.colour == "rgb" else planes):
        around = numbers[i]
        inside = around[top : top + height, left : left + width]
        if inside.shape != around.shape:
            around[:] = want.pad
        inside[:] = plane
        if want.dtype == "float32":
            # The types of NumPy's scalars keep a plane from being converted twice.
            if want.mean[i]:
                around -= np.float32(want.mean[i])
            if want.scale[i] != 1.0:
                around *= np.float32(want.scale[i])
    return numbers if want.layout != "nhwc" else np.ascontiguousarray(numbers.transpose(1, 2, 0))


def _inside(picture: Size, want: Input) -> Size:
    """Largest size of the picture's proportions that fits."""
    width, height = picture
    ratio = min(want.width_px / width, want.height_px / height)
    return max(round(width * ratio), 1), max(round(height * ratio), 1)
