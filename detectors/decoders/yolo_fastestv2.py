"""Decoder of YOLO-Fastest v2: two grids with three anchors, whose class scores are shared."""

from typing import Literal

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
    cell_count,
    cell_grid,
    from_centers,
    named,
    output_rows,
    static,
    table_rows,
)
from .fastestdet import BGR_UNIT

_STRIDES = (16, 32)
_ANCHORS_PX = (
    ((12.64, 19.39), (37.88, 51.48), (55.71, 138.31)),
    ((126.91, 78.23), (131.57, 214.55), (279.92, 258.87)),
)
Anchors = tuple[tuple[float, float], ...]


class YoloFastestV2Output(BoxOutput):
    """For each stride (1, h, w, 15 + classes): 3 boxes, 3 objectness scores, class scores.

    One output has the rows of all strides, (cells, 15 + classes).
    """

    kind: Literal["yolo-fastestv2"]
    names: tuple[str, ...]
    """Names of the outputs, in the order of strides."""
    strides: tuple[int, ...] = _STRIDES
    anchors_px: tuple[Anchors, ...] = _ANCHORS_PX
    """Width and height of the anchors of each stride; those of COCO by default."""

    @override
    def candidates(self, outputs: Outputs, size_px: Size, /) -> BoxCandidates:
        count = len(self.strides)
        if len(self.names) not in (1, count) or len(self.anchors_px) != count:
            raise ValueError("names, strides and anchors_px: expected equally many")
        grids = [named(outputs, name, "names") for name in self.names]
        if len(grids) < count:
            sides = [(size_px[1] // stride, size_px[0] // stride) for stride in self.strides]
            rows = output_rows(grids[0], 15 + len(self.classes), "the cells of all strides")
            parts = np.split(rows, np.cumsum([h * w for h, w in sides])[:-1])
            if len(parts[-1]) != sides[-1][0] * sides[-1][1]:
                raise ValueError(f"expected the cells of strides {self.strides}, got {len(rows)}")
            grids = [part.reshape(1, *side, -1) for part, side in zip(parts, sides, strict=True)]
        found = [
            self._of_stride(grid, size_px, stride, np.array(anchors))
            for grid, stride, anchors in zip(grids, self.strides, self.anchors_px, strict=True)
        ]
        boxes, scores, classes = (np.concatenate(part) for part in zip(*found, strict=True))
        return BoxCandidates(boxes, scores, classes)

    def _of_stride(
        self, grid: np.typing.NDArray[np.generic], size_px: Size, stride_px: int, anchors: Floats
    ) -> tuple[Floats, Floats, np.typing.NDArray[np.int64]]:
        count = len(anchors)
        width, height = size_px[0] // stride_px, size_px[1] // stride_px
        shape = (1, height, width, 5 * count + len(self.classes))
        if grid.shape != shape:
            raise ValueError(f"expected {shape}, got {grid.shape}")
        table: Floats = np.asarray(grid[0], np.float64).reshape(-1, shape[3])
        corner, stride = (cell[:, None] for cell in cell_grid(size_px, (stride_px,)))
        box = table[:, : 4 * count].reshape(-1, count, 4)
        center = (2.0 * box[..., :2] - 0.5 + corner) * stride
        sides = (2.0 * box[..., 2:]) ** 2 * anchors
        best, classes = best_class(table[:, 5 * count :])
        scores = table[:, 4 * count : 5 * count] * best[:, None]
        flat = np.concatenate([center, sides], axis=2).reshape(-1, 4)
        return from_centers(flat), scores.reshape(-1), np.repeat(classes, count)

    @override
    @classmethod
    def recognise(cls, model: Interface, /) -> Guess | None:
        width, height = model.declared_px
        shapes = [out.shape for out in model.outputs]
        if len(shapes) > 2 or not height or not width:
            return None
        columns = static(shapes[0], -1)
        wanted = {(1, height // s, width // s, columns) for s in _STRIDES}
        is_joined = table_rows(shapes[0]) == cell_count((width, height), _STRIDES)
        if columns is None or columns < 16 or not (set(shapes) == wanted or is_joined):
            return None
        ordered = sorted(model.outputs, key=lambda out: -(static(out.shape, 1) or 0))
        return Guess(
            {"kind": "yolo-fastestv2", "names": tuple(out.name for out in ordered)},
            columns - 15,
            (f"two grids of strides 16 and 32 with 3 anchors and {columns - 15} classes",),
            (
                "anchors are those of COCO (output.anchors_px); take yours from the .data file",
                "pixels are BGR, scaled to 0..1",
            ),
            BGR_UNIT,
        )
