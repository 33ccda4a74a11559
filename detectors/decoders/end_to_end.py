"""Decoder of networks with built-in suppression: YOLOv10, YOLO26, exports with NMS."""

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
    class_numbers,
    named,
    output_rows,
    static,
)
from .detr import ULTRALYTICS_HEAD
from .yolo import PICTURE, PrototypeMasks, prototype_output, prototypes_of


class EndToEndOutput(BoxOutput):
    """One output (1, N, 6): x0, y0, x1, y1 in input pixels, score, class; then mask weights."""

    kind: Literal["end-to-end"]
    name: str | None = None
    """Name of the output with the boxes; by default the only output."""
    prototypes: str | None = None
    """Name of the output with prototype masks, if there are masks."""
    is_fraction: bool = False
    """True if boxes are in fractions of the input, as in TFLite files; else in its pixels."""

    @override
    def candidates(self, outputs: Outputs, size_px: Size, /) -> BoxCandidates:
        masks, rows = None, named(outputs, self.name)
        if self.prototypes is None:
            table = output_rows(rows, 6, "x0, y0, x1, y1, score, class")
            # Some exporters pad with a class of -1.
            table = table[~(table[:, 5] < 0.0)]
        else:
            prototypes = prototypes_of(named(outputs, self.prototypes, "prototypes"))
            table = output_rows(rows, 6 + len(prototypes), "boxes and mask weights")
            masks = PrototypeMasks(table[:, 6:], prototypes)
        boxes = table[:, :4] * (np.tile(size_px, 2) if self.is_fraction else 1.0)
        numbers = class_numbers(table[:, 5], len(self.classes))
        return BoxCandidates(boxes, table[:, 4], numbers, masks)

    @override
    @classmethod
    def recognise(cls, model: Interface, /) -> Guess | None:
        prototypes = prototype_output(model)
        columns = 6 + (prototypes[1] if prototypes else 0)
        output = next((o for o in model.outputs if len(o.shape) == 3), None)
        is_detr = model.metadata.get("head") == ULTRALYTICS_HEAD
        if output is None or static(output.shape, 2) != columns or is_detr:
            return None
        settings: dict[str, object] = {"kind": "end-to-end", "name": output.name, "overlap": 1.0}
        if prototypes:
            settings["prototypes"] = prototypes[0]
        names = len(model.class_names)
        return Guess(
            settings,
            names or None,
            (f"rows of {columns}: box, score, class" + (", mask weights" if prototypes else ""),),
            ("boxes are in input pixels",),
            PICTURE,
            is_decided=bool(names),
        )
