"""Decoder of YOLO-NAS and DAMO-YOLO, exported without suppression: boxes and final scores."""

from typing import Literal

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
    grid_cells,
    named,
    output_rows,
    static,
)
from .yolo import PICTURE


class YoloNasOutput(BoxOutput):
    """Boxes (1, N, 4): x0, y0, x1, y1 in input pixels; class scores (1, N, C)."""

    kind: Literal["yolo-nas"]
    boxes: str
    """Name of the output with the boxes."""
    scores: str
    """Name of the output with the scores, from 0 to 1."""

    @override
    def candidates(self, outputs: Outputs, size_px: Size, /) -> BoxCandidates:
        boxes: Floats = output_rows(named(outputs, self.boxes, "boxes"), 4, "boxes")
        scores = output_rows(named(outputs, self.scores, "scores"), len(self.classes), "scores")
        if len(boxes) != len(scores):
            raise ValueError(f"expected as many boxes as scores, got {len(boxes)}, {len(scores)}")
        best, classes = best_class(scores)
        return BoxCandidates(boxes, best, classes)

    @override
    @classmethod
    def recognise(cls, model: Interface, /) -> Guess | None:
        tables = [out for out in model.outputs if len(out.shape) == 3]
        boxes = next((out for out in tables if static(out.shape, 2) == 4), None)
        scores = next((out for out in tables if out is not boxes), None)
        if boxes is None or scores is None or len(model.outputs) != 2:
            return None
        rows = grid_cells(model)
        if rows is None or not static(boxes.shape, 1) == static(scores.shape, 1) == rows:
            return None
        # DAMO-YOLO's exporter names the first of its outputs, the scores.
        is_damo = scores is model.outputs[0] and scores.name == "output"
        return Guess(
            {"kind": "yolo-nas", "boxes": boxes.name, "scores": scores.name},
            static(scores.shape, 2),
            (f"a box and scores for each of the {rows} cells of strides 8, 16, 32",),
            (
                "boxes are corners in input pixels, scores are final",
                "pixels are RGB, from 0 to 255, as DAMO-YOLO expects"
                if is_damo
                else "pixels are RGB, scaled to 0..1, as YOLO-NAS expects; it is trained with a "
                "margin of 2 pixels, which is left out",
            ),
            {"colour": "rgb", "fit": "letterbox", "pad": 0} if is_damo else PICTURE,
            is_decided=False,
        )
