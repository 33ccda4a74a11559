"""Decoders of PaddleDetection's exports, without and with its suppression."""

from typing import Final, Literal

import numpy as np
from typing_extensions import override

from .base import (
    PADDLE_SCALE_INPUT,
    BoxCandidates,
    BoxOutput,
    Guess,
    Interface,
    Outputs,
    Size,
    best_class,
    class_numbers,
    grid_cells,
    named,
    output_rows,
    static,
)

_PICTURE: Final = {"colour": "rgb", "fit": "stretch", "scale": (1 / 255,) * 3}
_ASSUMED: Final = (
    "pixels are RGB, scaled to 0..1, as PP-YOLOE+ expects; others have ImageNet's mean (mean, "
    "scale: see infer_cfg.yml)",
)


class PpYoloeOutput(BoxOutput):
    """Boxes (1, N, 4) as corners in pixels, scores (1, C, N); or both in one (1, N, 4 + C)."""

    kind: Literal["pp-yoloe"]
    boxes: str
    """Name of the output with the boxes; the scores follow them if ``scores`` is the same."""
    scores: str
    """Name of the output with the scores."""

    @override
    def candidates(self, outputs: Outputs, size_px: Size, /) -> BoxCandidates:
        count = len(self.classes)
        if self.boxes == self.scores:
            both = output_rows(named(outputs, self.boxes, "boxes"), 4 + count, "boxes and scores")
            best, classes = best_class(both[:, 4:])
            return BoxCandidates(both[:, :4], best, classes)
        boxes = output_rows(named(outputs, self.boxes, "boxes"), 4, "boxes")
        scores = named(outputs, self.scores, "scores")
        if scores.shape != (1, count, len(boxes)):
            raise ValueError(f"expected scores (1, {count}, {len(boxes)}), got {scores.shape}")
        best, classes = best_class(scores[0].T)
        return BoxCandidates(boxes, best, classes)

    @override
    @classmethod
    def recognise(cls, model: Interface, /) -> Guess | None:
        cells, outputs = grid_cells(model), model.outputs
        # Paddle's name of the picture; others have such shapes, too.
        if model.inputs[0].name != "image" or cells is None or len(outputs) > 2:
            return None
        boxes = next((out for out in outputs if static(out.shape, 1) == cells), outputs[0])
        scores = next((out for out in outputs if out is not boxes), boxes)
        columns, channels = static(boxes.shape, 2), static(scores.shape, 1)
        count = (columns or 0) - 4 if scores is boxes else channels
        if static(boxes.shape, 1) != cells or not count or count < 1:
            return None
        if scores is not boxes and (columns != 4 or static(scores.shape, 2) != cells):
            return None
        return Guess(
            {"kind": "pp-yoloe", "boxes": boxes.name, "scores": scores.name},
            count,
            (f"a box and {count} scores for each of {cells} cells; the input is named image",),
            _ASSUMED,
            _PICTURE,
            is_decided=scores is not boxes,
        )


class PaddleNmsOutput(BoxOutput):
    """Rows (N, 6): class, score, x0, y0, x1, y1 in pixels; class -1 where nothing is found."""

    kind: Literal["paddle-nms"]
    name: str
    """Name of the output with the rows."""
    count: str
    """Name of the output with the number of rows; others pad the table."""

    @override
    def candidates(self, outputs: Outputs, size_px: Size, /) -> BoxCandidates:
        rows, count = named(outputs, self.name), named(outputs, self.count, "count")
        if rows.ndim != 2 or rows.shape[1] != 6 or count.size != 1:
            raise ValueError(f"expected (N, 6) and a count, got {rows.shape}, {count.shape}")
        table = np.asarray(rows[: int(count.reshape(-1)[0])], np.float64)
        table = table[~(table[:, 0] < 0.0)]
        return BoxCandidates(
            table[:, 2:], table[:, 1], class_numbers(table[:, 0], len(self.classes))
        )

    @override
    @classmethod
    def recognise(cls, model: Interface, /) -> Guess | None:
        rows = next((out for out in model.outputs if static(out.shape, 1) == 6), None)
        count = next((out for out in model.outputs if out.is_integer), None)
        is_paddle = any(one.name == PADDLE_SCALE_INPUT for one in model.inputs)
        if rows is None or count is None or len(rows.shape) != 2 or not is_paddle:
            return None
        return Guess(
            {"kind": "paddle-nms", "name": rows.name, "count": count.name, "overlap": 1.0},
            len(model.class_names) or None,
            (f"rows of 6, and Paddle's input {PADDLE_SCALE_INPUT}",),
            ("rows are class, score, box", *_ASSUMED),
            _PICTURE,
        )
