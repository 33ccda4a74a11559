"""Decoders of SSD: with suppression, of TensorFlow's and OpenVINO's model zoos, and without."""

from typing import Final, Literal

import numpy as np
from typing_extensions import override

from .base import (
    BoxCandidates,
    BoxOutput,
    Guess,
    Interface,
    Outputs,
    Size,
    best_class,
    class_numbers,
    grid_cells,
    is_called,
    named,
    output_rows,
    static,
)

_BOXES: Final = "detection_boxes"
_KEYS: Final = ("boxes", "labels", "scores")
# Ends of the names of boxes, classes and scores in TFLite files, by their beginning.
_TFLITE_NAMES: Final = {
    "TFLite_Detection_PostProcess": ("", ":1", ":2"),
    "StatefulPartitionedCall": (":3", ":2", ":1"),
}


class TensorflowSsdOutput(BoxOutput):
    """Boxes (1, N, 4) as y0, x0, y1, x1 in fractions, class numbers (1, N), scores (1, N)."""

    kind: Literal["ssd-tensorflow"]
    boxes: str = _BOXES
    labels: str = "detection_classes"
    scores: str = "detection_scores"
    first_class: int = 1
    """Number of the first listed class; TFLite exports start at 0."""

    @override
    def candidates(self, outputs: Outputs, size_px: Size, /) -> BoxCandidates:
        boxes = np.asarray(named(outputs, self.boxes, "boxes"), np.float64)
        scores = np.asarray(named(outputs, self.scores, "scores"), np.float64)
        labels = np.asarray(named(outputs, self.labels, "labels"), np.float64)
        n = boxes.shape[1] if boxes.ndim == 3 else 0
        if boxes.shape != (1, n, 4) or scores.shape != (1, n) or labels.shape != (1, n):
            raise ValueError(
                f"expected boxes (1, N, 4), labels (1, N), scores (1, N), got {boxes.shape}, "
                f"{labels.shape}, {scores.shape}"
            )
        corners = boxes[0][:, [1, 0, 3, 2]] * np.tile(size_px, 2)
        # Rows after the detections are zeros, whose class may not exist.
        kept = ~(scores[0] <= 0.0)
        numbers = class_numbers(labels[0][kept] - self.first_class, len(self.classes))
        return BoxCandidates(corners[kept], scores[0][kept], numbers)

    @override
    @classmethod
    def recognise(cls, model: Interface, /) -> Guess | None:
        if (tflite := _of_tflite(model)) is not None:
            return tflite
        if not any(out.name.split(":")[0] == _BOXES for out in model.outputs):
            return None
        names = {out.name.split(":")[0]: out.name for out in model.outputs}
        if not {"detection_classes", "detection_scores"} <= names.keys():
            return None
        # TensorRT's EfficientNMS has these names, too, with integers for classes.
        if any(out.is_integer for out in model.outputs if out.name == names["detection_classes"]):
            return None
        return Guess(
            {
                "kind": "ssd-tensorflow",
                "boxes": names[_BOXES],
                "labels": names["detection_classes"],
                "scores": names["detection_scores"],
                "overlap": 1.0,
            },
            len(model.class_names) or None,
            ("its outputs have the names of TensorFlow's detection API",),
            ("class numbers start at 1 (--first-class)",),
            {"colour": "rgb", "fit": "stretch", "layout": "nhwc", "dtype": "uint8"},
            numbers_as_coco=True,
        )


def _of_tflite(model: Interface) -> Guess | None:
    """Recognise the four outputs of the operation TFLite_Detection_PostProcess."""
    for begin, ends in _TFLITE_NAMES.items():
        names = [begin + end for end in ends]
        if len(model.outputs) == 4 and is_called(model, *names):
            settings = {"kind": "ssd-tensorflow", **dict(zip(_KEYS, names, strict=True))}
            return Guess(
                {**settings, "first_class": 0, "overlap": 1.0},
                len(model.class_names) or model.class_count,
                (f"its outputs are called {begin}, as TensorFlow's detection API names them",),
                ("class numbers start at 0 (--first-class)",),
                {
                    "colour": "rgb",
                    "fit": "stretch",
                    "mean": (127.5,) * 3,
                    "scale": (1 / 127.5,) * 3,
                },
                numbers_as_coco=True,
            )
    return None


class DetectionOutput(BoxOutput):
    """One output (1, 1, N, 7): picture, class, score, x0, y0, x1, y1 in fractions."""

    kind: Literal["ssd"]
    name: str | None = None
    """Name of the output; by default the only output."""
    first_class: int = 1
    """Number of the first listed class; 0 is the background."""

    @override
    def candidates(self, outputs: Outputs, size_px: Size, /) -> BoxCandidates:
        output = named(outputs, self.name)
        if output.ndim != 4 or output.shape[:2] != (1, 1) or output.shape[3] != 7:
            raise ValueError(f"expected (1, 1, N, 7), got {output.shape}")
        table = np.asarray(output[0, 0], np.float64)
        # A picture number of -1 ends the list.
        end = np.flatnonzero(table[:, 0] < 0)
        table = table[: end[0]] if len(end) else table
        numbers = class_numbers(table[:, 1] - self.first_class, len(self.classes))
        return BoxCandidates(table[:, 3:7] * np.tile(size_px, 2), table[:, 2], numbers)

    @override
    @classmethod
    def recognise(cls, model: Interface, /) -> Guess | None:
        if len(model.outputs) != 1 or len(model.outputs[0].shape) != 4:
            return None
        if static(model.outputs[0].shape, 3) != 7 or static(model.outputs[0].shape, 1) != 1:
            return None
        first = model.first_class
        start = f"the classes start at {1 if first is None else first}"
        return Guess(
            {"kind": "ssd", "name": model.outputs[0].name, "overlap": 1.0}
            | ({} if first is None else {"first_class": first}),
            len(model.class_names) or model.class_count,
            (
                "rows of 7, as the operation DetectionOutput returns",
                *(() if first is None else (f"{start}, the background is its other number",)),
            ),
            (f"class 0 is the background, {start} (--first-class)",) if first is None else (),
            {"colour": "bgr", "fit": "stretch"},
            numbers_as_coco=True,
        )


class SsdScoresOutput(BoxOutput):
    """Scores (1, N, 1 + C), the first of the background; boxes (1, N, 4): corners in fractions."""

    kind: Literal["ssd-scores"]
    scores: str = "scores"
    boxes: str = "boxes"

    @override
    def candidates(self, outputs: Outputs, size_px: Size, /) -> BoxCandidates:
        boxes = output_rows(named(outputs, self.boxes, "boxes"), 4, "boxes")
        scores = output_rows(
            named(outputs, self.scores, "scores"), 1 + len(self.classes), "scores and a background"
        )
        if len(boxes) != len(scores):
            raise ValueError(f"expected as many boxes as scores, got {len(boxes)}, {len(scores)}")
        best, classes = best_class(scores[:, 1:])
        return BoxCandidates(boxes * np.tile(size_px, 2), best, classes)

    @override
    @classmethod
    def recognise(cls, model: Interface, /) -> Guess | None:
        shapes = {out.name: out.shape for out in model.outputs}
        if shapes.keys() != {"scores", "boxes"} or static(shapes["boxes"], 2) != 4:
            return None
        rows, columns = static(shapes["scores"], 1), static(shapes["scores"], 2) or 0
        if rows != static(shapes["boxes"], 1) or columns < 2 or rows == grid_cells(model):
            return None
        return Guess(
            {"kind": "ssd-scores"},
            columns - 1,
            ("its outputs are called scores and boxes, as those of pytorch-ssd and UltraFace",),
            ("the first score is of the background; pixels are (x - 127) / 128",),
            {"colour": "rgb", "fit": "stretch", "mean": (127.0,) * 3, "scale": (1 / 128,) * 3},
        )
