"""Decoder of the DETR family: a fixed number of queries, each with a box and class scores."""

from dataclasses import replace
from typing import Final, Literal

import numpy as np
from typing_extensions import override

from .base import (
    IMAGENET,
    MAX_QUERIES,
    BoxCandidates,
    BoxOutput,
    Floats,
    Guess,
    Interface,
    Outputs,
    Size,
    Tensor,
    best_class,
    class_numbers,
    from_centers,
    grid_cells,
    named,
    output_rows,
    sigmoid,
    static,
)

_SELECTED_COLUMNS: Final = 6
_COCO_COLUMNS_OF_DETR: Final = 92
_RF_DETR_NAMES: Final = ("dets", "labels")
# Name of RT-DETR's head in the metadata of Ultralytics' exports, since 8.4.
ULTRALYTICS_HEAD: Final = "RTDETRDecoder"


class DetrOutput(BoxOutput):
    """Boxes (1, N, 4) as center and size in fractions of the input; classes (1, N, C)."""

    kind: Literal["detr"]
    boxes: str
    """Name of the output with the boxes; the classes follow them if ``logits`` is the same."""
    logits: str
    """Name of the output with the classes."""
    activation: Literal["sigmoid", "softmax", "none"] = "sigmoid"
    """Function from logits to scores. With softmax, the last class means "no object"."""
    is_selected: bool = False
    """True if each box is followed by score and number of its best class instead of all logits."""
    first_class: int = 0
    """Column of the first listed class; 1 if column 0 is unused, as in COCO's numbering."""

    @override
    def candidates(self, outputs: Outputs, size_px: Size, /) -> BoxCandidates:
        if self.is_selected:
            rows = output_rows(named(outputs, self.boxes, "boxes"), 6, "box, score, class")
            numbers = class_numbers(rows[:, 5] - self.first_class, len(self.classes))
            return BoxCandidates(_in_pixels(rows[:, :4], size_px), rows[:, 4], numbers)
        count = self.first_class + len(self.classes) + (self.activation == "softmax")
        if self.boxes == self.logits:
            both = output_rows(named(outputs, self.boxes, "boxes"), 4 + count, "boxes and classes")
            boxes, logits = both[:, :4], both[:, 4:]
        else:
            boxes = output_rows(named(outputs, self.boxes, "boxes"), 4, "boxes")
            logits = output_rows(named(outputs, self.logits, "logits"), count, "classes")
        scores = self._scores(logits)[:, self.first_class : self.first_class + len(self.classes)]
        best, classes = best_class(scores)
        return BoxCandidates(_in_pixels(boxes, size_px), best, classes)

    def _scores(self, logits: Floats) -> Floats:
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
        rows = static(boxes.shape, 1)
        # A box for each cell of a grid is not a query, and such boxes are in pixels.
        if rows is not None and (rows > MAX_QUERIES or rows == grid_cells(model)):
            return None
        columns = static(logits.shape, 2)
        settings = {"kind": "detr", "boxes": boxes.name, "logits": logits.name, "overlap": 1.0}
        why = f"{boxes.name} has 4 columns, {logits.name} the classes of the same queries"
        are_fractions = "boxes are center and size in fractions"
        if columns == _COCO_COLUMNS_OF_DETR:
            return Guess(
                {**settings, "activation": "softmax", "first_class": 1},
                columns - 2,
                (why,),
                (
                    f"{columns} columns are COCO's 90 between an unused one and no object, as "
                    "of the first DETR: softmax, and pixels with ImageNet's mean",
                    are_fractions,
                ),
                {**picture, **IMAGENET},
                is_decided=False,
            )
        is_rf_detr = (boxes.name, logits.name) == _RF_DETR_NAMES
        # Deformable DETR, Conditional DETR, DINO and LW-DETR.
        is_normalised = is_rf_detr or columns == _COCO_COLUMNS_OF_DETR - 1
        return Guess(
            settings,
            columns,
            (why,),
            (
                "logits become scores by the logistic function (RT-DETR, RF-DETR); the first DETR "
                'has activation = "softmax"',
                are_fractions,
                "pixels have ImageNet's mean, as of RF-DETR and of others with COCO's 91 numbers"
                if is_normalised
                else "pixels are scaled to 0..1, without a mean",
            ),
            {**picture, **IMAGENET} if is_normalised else picture,
            is_decided=is_rf_detr,
        )


def with_no_object(guess: Guess) -> Guess:
    """Return the layout whose last column means "no object", as in DETR and YOLOS."""
    assumption = (
        "the last column is no object, as of DETR: softmax, and pixels with ImageNet's mean"
    )
    return replace(
        guess,
        settings={**guess.settings, "activation": "softmax"},
        class_count=None if guess.class_count is None else guess.class_count - 1,
        assumptions=(assumption, *guess.assumptions[1:2]),
        input={**(guess.input or {}), **IMAGENET},
    )


def _in_pixels(boxes: Floats, size_px: Size) -> Floats:
    pixels: Floats = from_centers(boxes) * np.tile(size_px, 2)
    return pixels


def _of_one(output: Tensor, model: Interface, picture: dict[str, object]) -> Guess | None:
    """Recognise Ultralytics' RT-DETR: one output with boxes and final scores, few queries."""
    rows, columns = static(output.shape, 1), static(output.shape, 2)
    names = len(model.class_names)
    settings = {
        "kind": "detr",
        "boxes": output.name,
        "logits": output.name,
        "activation": "none",
        "overlap": 1.0,
    }
    if rows is None or rows > MAX_QUERIES or columns is None or columns < 5:
        return None
    is_known = model.metadata.get("head") == ULTRALYTICS_HEAD
    if columns == _SELECTED_COLUMNS and (is_known or not model.metadata):
        why = f"rows of {columns}: box, score, class"
        return Guess(
            {**settings, "is_selected": True},
            names or None,
            (why, f"its head is {ULTRALYTICS_HEAD}") if is_known else (why,),
            () if is_known else ("boxes are center and size in fractions",),
            picture,
            is_decided=is_known,
        )
    if columns != names + 4:
        return None
    return Guess(
        settings,
        names,
        (f"rows of {columns}: 4 and the {names} classes of its metadata, {rows} queries",),
        ("boxes are center and size in fractions, scores are final",),
        picture,
    )
