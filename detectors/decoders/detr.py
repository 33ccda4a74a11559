"""The DETR family: a fixed number of queries, each with a box and class scores."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from .base import (
    BoxOutput,
    Candidates,
    Guess,
    Interface,
    Outputs,
    Size,
    Tensor,
    best_class,
    from_centers,
    named,
    rows_of,
    sigmoid,
    static,
)


class DetrOutput(BoxOutput):
    """Boxes (1, N, 4) as center and size in fractions of the input; classes (1, N, C)."""

    kind: Literal["detr"]
    boxes: str
    """The output with the boxes; with the classes behind them, if ``logits`` is the same."""
    logits: str
    """The output with the classes."""
    activation: Literal["sigmoid", "softmax", "none"] = "sigmoid"
    """From logits to scores. With softmax, the class after the listed ones means "no object"."""
    first_class: int = 0
    """Column of the first listed class; 1 where column 0 is not used, as in COCO's numbering."""

    @override
    def candidates(self, outputs: Outputs, size_px: Size, /) -> Candidates:
        count = self.first_class + len(self.classes) + (self.activation == "softmax")
        if self.boxes == self.logits:
            both = rows_of(named(outputs, self.boxes, "boxes"), 4 + count, "boxes and classes")
            boxes, logits = both[:, :4], both[:, 4:]
        else:
            boxes = rows_of(named(outputs, self.boxes, "boxes"), 4, "boxes")
            logits = rows_of(named(outputs, self.logits, "logits"), count, "classes")
        scores = self._scores(logits)[:, self.first_class : self.first_class + len(self.classes)]
        best, classes = best_class(scores)
        return Candidates(from_centers(boxes) * np.tile(size_px, 2), best, classes)

    def _scores(self, logits: NDArray[np.float64]) -> NDArray[np.float64]:
        if self.activation == "none":
            return logits
        if self.activation == "sigmoid":
            return sigmoid(logits)
        shifted = np.exp(logits - logits.max(axis=1, keepdims=True))
        return np.asarray(shifted / shifted.sum(axis=1, keepdims=True), np.float64)

    @override
    @classmethod
    def recognise(cls, model: Interface, /) -> Guess | None:
        tables = [out for out in model.outputs if len(out.shape) == 3]
        picture: dict[str, object] = {"colour": "rgb", "fit": "stretch", "scale": (1 / 255,) * 3}
        if len(tables) == 1 and len(model.outputs) == 1:
            return _of_one(tables[0], model, picture)
        boxes = next((out for out in tables if static(out.shape, 2) == 4), None)
        logits = next((out for out in tables if out is not boxes), None)
        if boxes is None or logits is None or len(tables) != 2:
            return None
        columns = static(logits.shape, 2)
        return Guess(
            {"kind": "detr", "boxes": boxes.name, "logits": logits.name, "overlap": 1.0},
            columns,
            (f"{boxes.name} has 4 columns, {logits.name} the classes of the same queries",),
            (
                "logits become scores by the logistic function (RT-DETR, RF-DETR); the first DETR "
                'has activation = "softmax"',
                "boxes are center and size in fractions",
                "pixels are scaled to 0..1, without a mean",
            ),
            picture,
        )


def _of_one(output: Tensor, model: Interface, picture: dict[str, object]) -> Guess | None:
    """Ultralytics' RT-DETR: boxes and scores side by side, few queries, scores already."""
    rows, columns = static(output.shape, 1), static(output.shape, 2)
    names = len(model.class_names)
    if rows is None or rows > 1000 or columns is None or columns < 5 or columns != names + 4:
        return None
    return Guess(
        {
            "kind": "detr",
            "boxes": output.name,
            "logits": output.name,
            "activation": "none",
            "overlap": 1.0,
        },
        columns - 4,
        (f"rows of {columns}: 4 and the {names} classes of its metadata, {rows} queries",),
        ("boxes are center and size in fractions, scores are scores already",),
        picture,
    )
