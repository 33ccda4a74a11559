"""Decoder of Darknet's networks as its exporters to ONNX decode them."""

from typing import Literal

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
    is_called,
    named,
    output_rows,
    static,
)


class DarknetOutput(BoxOutput):
    """Boxes (1, N, 1, 4) as corners in fractions of the input; scores (1, N, classes)."""

    kind: Literal["darknet"]
    boxes: str = "boxes"
    scores: str = "confs"

    @override
    def candidates(self, outputs: Outputs, size_px: Size, /) -> BoxCandidates:
        boxes = named(outputs, self.boxes, "boxes")
        scores = output_rows(named(outputs, self.scores, "scores"), len(self.classes), "scores")
        if boxes.shape != (1, len(scores), 1, 4):
            raise ValueError(f"boxes: expected (1, {len(scores)}, 1, 4), got {boxes.shape}")
        best, classes = best_class(scores)
        corners = np.asarray(boxes[0, :, 0], np.float64) * np.tile(size_px, 2)
        return BoxCandidates(corners, best, classes)

    @override
    @classmethod
    def recognise(cls, model: Interface, /) -> Guess | None:
        by_name = {out.name: out.shape for out in model.outputs}
        if not is_called(model, "boxes", "confs") or len(by_name["boxes"]) != 4:
            return None
        return Guess(
            {"kind": "darknet"},
            static(by_name["confs"], 2),
            ("its outputs are called boxes and confs, as Darknet's exporters do",),
            ("pixels are RGB, scaled to 0..1",),
            {"colour": "rgb", "fit": "stretch", "scale": (1 / 255,) * 3},
        )
