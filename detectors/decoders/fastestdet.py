"""Decoder of FastestDet: one grid, whose channels are objectness, box and class scores."""

from typing import Final, Literal

import numpy as np
from typing_extensions import override

from .base import (
    BoxCandidates,
    BoxOutput,
    Floats,
    Guess,
    Interface,
    Outputs,
    Size,
    best_class,
    cell_grid,
    from_centers,
    named,
    sigmoid,
    static,
)

# Pixels of FastestDet and of YOLO-Fastest.
BGR_UNIT: Final = {"colour": "bgr", "fit": "stretch", "scale": (1 / 255,) * 3}


class FastestDetOutput(BoxOutput):
    """One output (1, 5 + classes, h, w) over cells of one stride."""

    kind: Literal["fastestdet"]
    name: str | None = None
    """Name of the output; by default the only output."""
    stride: int = 16

    @override
    def candidates(self, outputs: Outputs, size_px: Size, /) -> BoxCandidates:
        grid = named(outputs, self.name)
        rows, columns = size_px[1] // self.stride, size_px[0] // self.stride
        shape = (1, 5 + len(self.classes), rows, columns)
        if grid.shape != shape:
            raise ValueError(f"expected {shape}, got {grid.shape}")
        table: Floats = np.asarray(grid[0], np.float64).reshape(shape[1], -1).T
        corner, stride = cell_grid(size_px, (self.stride,))
        center = (np.tanh(table[:, 1:3]) + corner) * stride
        boxes = from_centers(np.hstack([center, sigmoid(table[:, 3:5]) * size_px]))
        best, numbers = best_class(table[:, 5:])
        # Both are final scores, and noise may be negative.
        parts = np.clip(table[:, 0], 0.0, None) ** 0.6 * np.clip(best, 0.0, None) ** 0.4
        return BoxCandidates(boxes, parts, numbers)

    @override
    @classmethod
    def recognise(cls, model: Interface, /) -> Guess | None:
        shape = model.outputs[0].shape
        channels = static(shape, 1)
        sides = list(zip((static(shape, 3), static(shape, 2)), model.declared_px, strict=True))
        if len(model.outputs) != 1 or len(shape) != 4 or channels is None or channels < 6:
            return None
        if any(not cells or not side or side // 16 != cells for cells, side in sides):
            return None
        return Guess(
            {"kind": "fastestdet"},
            channels - 5,
            (f"{channels} channels over the cells of stride 16",),
            (
                f"channels are objectness, box and {channels - 5} scores, as FastestDet exports",
                "pixels are BGR, scaled to 0..1",
            ),
            BGR_UNIT,
            is_decided=False,
        )
