"""From a picture to a network's input, and from its pixels back."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from crosscue.detectors.catalog.card import Input
from crosscue.detectors.decoders.base import Array, Size
from crosscue.replay.columns import Bytes, Floats

_AXES: Final = {"nchw": (2, 0, 1), "chw": (2, 0, 1), "nhwc": (0, 1, 2)}
"""Of a picture's rows, columns and colours, in a network's order."""


@dataclass(frozen=True, slots=True)
class Placement:
    """Where a picture lies in a network's input: input = picture * scale + offset, x and y.

    Attributes:
        scale: Along x and y.
        offset: Likewise.
        size_px: Width and height of the input.
    """

    scale: tuple[float, float]
    offset: tuple[float, float]
    size_px: Size

    def to_picture(self, boxes_px: Floats) -> Floats:
        """Boxes (N, 4) in input pixels as boxes in the picture's."""
        return np.asarray((boxes_px - np.tile(self.offset, 2)) / np.tile(self.scale, 2), np.float64)


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


def prepared(pixels: Bytes, want: Input) -> tuple[Array, Placement]:
    """A picture (H, W, 3) as a network's input with its batch axis, and where it lies there."""
    height, width = pixels.shape[:2]
    placement = place((width, height), want)
    fitted = pixels if want.fit == "network" else _fitted(pixels, want, placement)
    return _numbers(fitted, want)[None], placement


def _fitted(pixels: Bytes, want: Input, placement: Placement) -> Bytes:
    """The picture in an input of the wanted size."""
    import cv2

    height, width = pixels.shape[:2]
    whole_size = (want.width_px, want.height_px)
    if want.fit == "crop":
        x, y = (round(-o / s) for o, s in zip(placement.offset, placement.scale, strict=True))
        pixels = pixels[y : height - y or None, x : width - x or None]
    size = whole_size if want.fit in ("crop", "stretch") else _inside((width, height), want)
    scaled = np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_LINEAR), np.uint8)
    if size == whole_size:
        return scaled
    left, top = (int(o) for o in placement.offset)
    right, bottom = (w - s - o for w, s, o in zip(whole_size, size, (left, top), strict=True))
    border = (want.pad,) * 3
    return np.asarray(
        cv2.copyMakeBorder(scaled, top, bottom, left, right, cv2.BORDER_CONSTANT, value=border),
        np.uint8,
    )


def _numbers(pixels: Bytes, want: Input) -> Array:
    """Pixels in the network's order, type and scale."""
    import cv2

    is_turned = want.colour == "rgb"
    if want.dtype == "uint8":
        turned = pixels[:, :, ::-1] if is_turned else pixels
        return np.ascontiguousarray(turned.transpose(_AXES[want.layout]))
    mean, scale = np.array(want.mean, np.float32), np.array(want.scale, np.float32)
    # A byte has 256 values: their numbers are looked up, a colour at a time.
    table = (np.arange(256, dtype=np.float32)[:, None] - mean) * scale
    planes = cv2.split(pixels)
    numbers = np.empty((3, *pixels.shape[:2]), np.float32)
    for i, plane in enumerate(reversed(planes) if is_turned else planes):
        cv2.LUT(plane, table[:, i], numbers[i])
    return numbers if want.layout != "nhwc" else np.ascontiguousarray(numbers.transpose(1, 2, 0))


def _inside(picture: Size, want: Input) -> Size:
    """Largest size of the picture's proportions that fits."""
    width, height = picture
    ratio = min(want.width_px / width, want.height_px / height)
    return max(round(width * ratio), 1), max(round(height * ratio), 1)
