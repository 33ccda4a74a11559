"""Recognise networks that give each pixel a class, by the shape of their output."""

from collections.abc import Sequence
from typing import Final, TypeAlias

from crosscue.detectors.decoders.base import IMAGENET, Guess, Interface, Tensor, static

_MAX_CLASSES: Final = 256
# Maximum size of an output's pixel, in pixels of the input, and the fewest of them along a side.
# FOMO finds centers of objects in such a grid: 12 to 40 cells.
_COARSEST: Final = 8
_FEWEST: Final = 48
# What networks expect by the name of their input: in words, and the keys of the card's ``[input]``.
_Picture: TypeAlias = tuple[str, dict[str, object]]
_USUAL: Final[_Picture] = ("RGB, scaled to 0..1", {"colour": "rgb", "scale": (1 / 255,) * 3})
_PICTURES: Final[dict[str, _Picture]] = {
    "data": ("BGR, from 0 to 255, as Open Model Zoo's networks expect", {"colour": "bgr"}),
    "pixel_values": ("RGB with ImageNet's mean, as in Transformers", {"colour": "rgb", **IMAGENET}),
}
# Names of drivable classes, without blanks and underscores.
_DRIVABLE: Final = frozenset(
    {"road", "mark", "roadmark", "marking", "lanemarking", "drivable", "drivablearea", "lane"}
)


def recognise_segmentation(model: Interface) -> Guess | None:
    """Return the settings with which a model file is a segmentation; None if it cannot be one."""
    maps = [_classes_of(out, model) for out in model.outputs]
    first = model.outputs[0]
    count = maps[0]
    if count is None or any(out.shape != first.shape for out in model.outputs):
        return None
    others = ", ".join(out.name for out in model.outputs[1:])
    expected, picture = _PICTURES.get(model.inputs[0].name, _USUAL)
    return Guess(
        {"kind": "segmentation", **({"name": first.name} if others else {})},
        count or None,
        (f"{first.name} has {f'{count} scores' if count else 'a class'} for each pixel",),
        (
            *((f"{first.name} is the road, not {others} (output.name)",) if others else ()),
            f"pixels are {expected}",
        ),
        {**picture, "fit": "stretch"},
        is_decided=False,
    )


def _classes_of(output: Tensor, model: Interface) -> int | None:
    """Number of an output's scores per pixel, 0 for class numbers; None for another output."""
    # Networks with the channels of the picture last have those of the classes last, too.
    is_last = model.layout == "nhwc" and len(output.shape) == 4
    channels, *axes = (3, 1, 2) if is_last else (1, -2, -1)
    sides = [static(output.shape, axis) for axis in axes]
    if len(model.inputs[0].shape) != 4 or not all(sides) or not all(model.declared_px):
        return None
    height, width, columns, rows = (side or 1 for side in (*sides, *model.declared_px))
    if rows % height or rows * width != columns * height or rows // height > _COARSEST:
        return None
    if rows // height == _COARSEST and min(height, width) < _FEWEST:
        return None
    count = static(output.shape, channels)
    if len(output.shape) == 4 and count is not None and 2 <= count <= _MAX_CLASSES:
        return count
    is_numbers = len(output.shape) == 3 or (len(output.shape) == 4 and count == 1)
    return 0 if is_numbers and output.is_integer else None


def drivable(names: Sequence[str]) -> tuple[str, ...]:
    """Select the names of drivable classes."""
    return tuple(
        name for name in names if name.lower().replace("_", "").replace(" ", "") in _DRIVABLE
    )
