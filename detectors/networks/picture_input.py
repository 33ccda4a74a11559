"""Convert pictures to a network's input, and boxes back to the picture."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from crosscue.detectors.base import View
from crosscue.detectors.catalog.card import Input
from crosscue.detectors.decoders.base import Array, Size


@dataclass(frozen=True, slots=True)
class Placement:
    """Position of a picture in a network's input: input = picture * scale + offset.

    Attributes:
        scale: Factors along x and y.
        offset: Offsets along x and y, in input pixels.
        size_px: Width and height of the input.
    """

    scale: tuple[float, float]
    offset: tuple[float, float]
    size_px: Size

    def to_picture(self, boxes_px: NDArray[np.float64]) -> NDArray[np.float64]:
        """Convert boxes (N, 4) from input pixels to the picture's."""
        return np.asarray((boxes_px - np.tile(self.offset, 2)) / np.tile(self.scale, 2), np.float64)


def view_of(want: Input) -> View:
    """Resolution at which to decode pictures; full size for a network that scales them itself."""
    if want.decode == "full" or want.fit == "network":
        return View()
    return View(min_width_px=want.width_px)


def picture_placement(picture: Size, want: Input) -> Placement:
    """Compute the placement of a picture of this width and height."""
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
    """Convert a picture (H, W, 3) to a network's input with batch axis, and its placement."""
    height, width = pixels.shape[:2]
    placement = picture_placement((width, height), want)
    if want.fit == "network":
        return _numbers(pixels, want, (0, 0), (width, height))[None], placement
    left, top = (max(int(o), 0) for o in placement.offset)
    fitted = _fitted(pixels, want, placement)
    return _numbers(fitted, want, (left, top), placement.size_px)[None], placement


def _fitted(pixels: NDArray[np.uint8], want: Input, placement: Placement) -> NDArray[np.uint8]:
    """Resize a picture to its size in the input."""
    height, width = pixels.shape[:2]
    size = (want.width_px, want.height_px)
    if want.fit == "crop":
        x, y = (round(-o / s) for o, s in zip(placement.offset, placement.scale, strict=True))
        pixels = pixels[y : height - y or None, x : width - x or None]
    elif want.fit != "stretch":
        size = _inside((width, height), want)
    return np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_LINEAR), np.uint8)


def _numbers(pixels: NDArray[np.uint8], want: Input, corner: Size, size_px: Size) -> Array:
    """Convert pixels to the network's order, type and scale, and pad them.

    Args:
        pixels: Shape (h, w, 3), blue, green, red.
        want: The network's input.
        corner: Left and top of the pixels in the input.
        size_px: Width and height of the input.
    """
    (left, top), (height, width) = corner, pixels.shape[:2]
    numbers = np.empty((3, size_px[1], size_px[0]), want.dtype)
    planes = cv2.split(pixels)
    for i, plane in enumerate(reversed(planes) if want.colour == "rgb" else planes):
        around = numbers[i]
        inside = around[top : top + height, left : left + width]
        for strip in (around[:top], around[top + height :], around[:, :left]):
            strip[:] = want.pad
        around[:, left + width :] = want.pad
        inside[:] = plane
        if want.dtype == "float32":
            # Scalars of NumPy types prevent a second conversion of the plane.
            if want.mean[i]:
                around -= np.float32(want.mean[i])
            if want.scale[i] != 1.0:
                around *= np.float32(want.scale[i])
    return numbers if want.layout != "nhwc" else np.ascontiguousarray(numbers.transpose(1, 2, 0))


def _inside(picture: Size, want: Input) -> Size:
    """Largest size that fits into the input, with the picture's proportions."""
    width, height = picture
    ratio = min(want.width_px / width, want.height_px / height)
    return max(round(width * ratio), 1), max(round(height * ratio), 1)
