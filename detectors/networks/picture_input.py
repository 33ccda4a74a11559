"""From a picture to a network's input, and from its pixels back."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from crosscue.detectors.catalog.card import Input
from crosscue.detectors.decoders.base import Array, Size
from crosscue.replay.columns import Bytes, Floats

_AXES: Final = {"nchw": (2, 0, 1), "chw": (2, 0, 1), "nhwc": (0, 1, 2)}


@dataclass(frozen=True, slots=True)
class Placement:
    """Where a picture lies in a network's input: input = picture * scale + offset, x and y."""

    scale: tuple[float, float]
    offset: tuple[float, float]

    def to_picture(self, boxes_px: Floats) -> Floats:
        """Boxes (N, 4) in input pixels as boxes in the picture's."""
        return np.asarray((boxes_px - np.tile(self.offset, 2)) / np.tile(self.scale, 2), np.float64)


def place(picture: Size, want: Input) -> Placement:
    """Where a picture of this width and height goes."""
    width, height = picture
    ratio = (want.width_px / width, want.height_px / height)
    if want.fit == "stretch":
        return Placement(ratio, (0.0, 0.0))
    if want.fit == "crop":
        whole = max(ratio)
        centered = ((want.width_px - width * whole) / 2, (want.height_px - height * whole) / 2)
        return Placement((whole, whole), centered)
    size = _inside(picture, want)
    scale = (size[0] / width, size[1] / height)
    if want.fit == "letterbox":
        return Placement(scale, (0.0, 0.0))
    spare = (want.width_px - size[0], want.height_px - size[1])
    return Placement(scale, (float(spare[0] // 2), float(spare[1] // 2)))


def prepared(pixels: Bytes, want: Input) -> tuple[Array, Placement]:
    """A picture (H, W, 3) as a network's input with its batch axis, and where it lies there."""
    import cv2

    height, width = pixels.shape[:2]
    placement = place((width, height), want)
    whole = np.full((want.height_px, want.width_px, 3), want.pad, np.uint8)
    if want.fit == "crop":
        x, y = (round(-o / s) for o, s in zip(placement.offset, placement.scale, strict=True))
        part = pixels[y : height - y or None, x : width - x or None]
        cv2.resize(part, (want.width_px, want.height_px), whole, interpolation=cv2.INTER_LINEAR)
    else:
        size = (want.width_px, want.height_px)
        if want.fit != "stretch":
            size = _inside((width, height), want)
        left, top = (int(o) for o in placement.offset)
        whole[top : top + size[1], left : left + size[0]] = cv2.resize(
            pixels, size, interpolation=cv2.INTER_LINEAR
        )
    if want.colour == "rgb":
        whole = whole[:, :, ::-1]
    given: Array = whole
    if want.dtype == "float32":
        mean, scale = np.array(want.mean, np.float32), np.array(want.scale, np.float32)
        given = (whole.astype(np.float32) - mean) * scale
    return np.ascontiguousarray(given.transpose(_AXES[want.layout])[None]), placement


def _inside(picture: Size, want: Input) -> Size:
    """Largest size of the picture's proportions that fits."""
    width, height = picture
    ratio = min(want.width_px / width, want.height_px / height)
    return max(round(width * ratio), 1), max(round(height * ratio), 1)
