"""Detectors that read label images, whose pixels encode an object instead of a colour.

A label image is recorded by another program's segmentation or drawn by a simulator. Red holds the
class (its position in ``CLASSES``, counted from 1) and, in its highest bit, whether the pixel is
road. Green distinguishes the objects of one picture. Blue is the score, 255 for 1. The image must
be compressed without loss. The detectors' names are ``crosscue.detectors.label_images:objects`` and
``:road``.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from crosscue.detectors import rle
from crosscue.detectors.base import Detections, Found, Frame, RoadMask, View, nothing_found

CLASSES: Final = (
    "car", "stop sign", "traffic light", "one way left", "one way right", "do not enter",
)  # fmt: skip
ROAD_BIT: Final = 128
# Maximum number of objects in one picture, limited by the values of green.
MAX_OBJECTS: Final = 255


class LabelledObject(NamedTuple):
    """One object of a label image.

    Attributes:
        label: One of ``CLASSES``.
        score: 0 to 1.
        corner_px: Column and row of the mask's top-left pixel; the mask may exceed the image.
        mask: Shape (h, w).
    """

    label: str
    score: float
    corner_px: tuple[int, int]
    mask: NDArray[np.bool_]


def label_image(road: NDArray[np.bool_], objects: Sequence[LabelledObject]) -> NDArray[np.uint8]:
    """Draw a label image, shape (H, W, 3), red, green, blue; later objects hide earlier ones.

    Args:
        road: Shape (H, W).
        objects: The first ``MAX_OBJECTS`` are drawn.
    """
    image = np.zeros((*road.shape, 3), np.uint8)
    image[..., 0] = road * np.uint8(ROAD_BIT)
    high, wide = road.shape
    for number, one in enumerate(objects[:MAX_OBJECTS], 1):
        (x, y), (h, w) = one.corner_px, one.mask.shape
        left, top, right, bottom = max(x, 0), max(y, 0), min(x + w, wide), min(y + h, high)
        if left >= right or top >= bottom:
            continue
        part = one.mask[top - y : bottom - y, left - x : right - x]
        value = (CLASSES.index(one.label) + 1, number, round(255 * one.score))
        image[top:bottom, left:right][part] = value
    return image


@dataclass(frozen=True, slots=True)
class LabelledObjects:
    """Detector of the objects of a label image, each with its mask."""

    @property
    def labels(self) -> tuple[str, ...]:
        """All classes of label images."""
        return CLASSES

    @property
    def view(self) -> View:
        """The whole image: labels cannot be averaged."""
        return View()

    @property
    def identity(self) -> str:
        """Constant, because the detector has no settings."""
        return "label-objects 1"

    def __call__(self, frames: Sequence[Frame], /) -> Sequence[Found]:
        """Return the objects of each label image."""
        return [_objects_of(frame) for frame in frames]


def _objects_of(frame: Frame) -> Detections:
    kinds = frame.pixels[..., 2] & (ROAD_BIT - 1)
    rows, columns = np.nonzero(kinds)
    if not len(rows):
        return nothing_found(frame)
    numbers = frame.pixels[rows, columns, 1]
    boxes, labels, scores, masks = [], [], [], []
    for number in np.unique(numbers):
        y, x = rows[numbers == number], columns[numbers == number]
        kind = int(kinds[y[0], x[0]])
        if kind > len(CLASSES):
            continue
        x0, y0, x1, y1 = int(x.min()), int(y.min()), int(x.max()) + 1, int(y.max()) + 1
        mask = np.zeros((y1 - y0, x1 - x0), np.bool_)
        mask[y - y0, x - x0] = True
        boxes.append((x0, y0, x1, y1))
        labels.append(CLASSES[kind - 1])
        scores.append(int(frame.pixels[y[0], x[0], 0]) / 255.0)
        masks.append(rle.encode_mask(mask, (x0, y0), frame.size_px))
    return Detections(
        frame.t_ns,
        frame.size_px,
        np.array(boxes, np.float64).reshape(-1, 4),
        np.array(scores, np.float64),
        tuple(labels),
        tuple(masks),
    )


@dataclass(frozen=True, slots=True)
class LabelledRoad:
    """Detector of the road pixels of a label image."""

    @property
    def labels(self) -> tuple[str, ...]:
        """Empty: road is not an object."""
        return ()

    @property
    def view(self) -> View:
        """The whole image: labels cannot be averaged."""
        return View()

    @property
    def identity(self) -> str:
        """Constant, because the detector has no settings."""
        return "label-road 1"

    def __call__(self, frames: Sequence[Frame], /) -> Sequence[Found]:
        """Return the road pixels of each label image."""
        return [
            RoadMask(
                frame.t_ns,
                frame.size_px,
                rle.encode_mask(frame.pixels[..., 2] >= ROAD_BIT, (0, 0), frame.size_px),
                frame.size_px,
            )
            for frame in frames
        ]


def objects() -> LabelledObjects:
    """Build the detector of objects."""
    return LabelledObjects()


def road() -> LabelledRoad:
    """Build the detector of road."""
    return LabelledRoad()
