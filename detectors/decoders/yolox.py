"""Decoder of YOLOX: boxes relative to grid cells, with objectness."""

from typing import Literal

import numpy as np
from typing_extensions import override

from .base import (
    GRID_STRIDES,
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
    named,
    static,
)
from .yolo import YOLOX_PICTURE


class YoloxOutput(BoxOutput):
    """One output (1, cells, 5 + classes): offset x and y, log width and height, objectness."""

    kind: Literal["yolox"]
    name: str | None = None
    """Name of the output; by default the only output."""
    strides: tuple[int, ...] = GRID_STRIDES

    @override
    def candidates(self, outputs: Outputs, size_px: Size, /) -> BoxCandidates:
        rows = named(outputs, self.name)
        shape = (1, cell_count(size_px, self.strides), 5 + len(self.classes))
        if rows.shape != shape:
            raise ValueError(
                f"expected {shape} for {len(self.classes)} classes at {size_px[0]} x {size_px[1]}, "
                f"got {rows.shape}"
            )
        # Most cells are empty. No class score is above 1, so a low objectness excludes a cell.
        is_able = ~(np.asarray(rows[0, :, 4], np.float64) < self.score)
        able = rows[0, is_able]
        table: Floats = np.asarray(able[:, :5], np.float64)
        corner, stride = (cell[is_able] for cell in cell_grid(size_px, self.strides))
        center = (table[:, :2] + corner) * stride
        # A width of e^20 cells exceeds any picture; more would overflow.
        half = np.exp(np.minimum(table[:, 2:4], 20.0)) * stride / 2.0
        best, classes = best_class(able[:, 5:])
        return BoxCandidates(np.hstack([center - half, center + half]), table[:, 4] * best, classes)

    @override
    @classmethod
    def recognise(cls, model: Interface, /) -> Guess | None:
        if len(model.outputs) != 1 or len(model.outputs[0].shape) != 3:
            return None
        rows, columns = (static(model.outputs[0].shape, axis) for axis in (1, 2))
        width, height = model.declared_px
        if columns is None or columns < 6 or rows is None or width is None or height is None:
            return None
        if rows != cell_count((width, height), GRID_STRIDES):
            return None
        return Guess(
            {"kind": "yolox"},
            columns - 5,
            (f"{rows} rows are the cells of strides 8, 16, 32 at {width} x {height}",),
            ("rows are relative to their cells, as YOLOX exports without --decode_in_inference",),
            YOLOX_PICTURE,
            is_decided=False,
        )
