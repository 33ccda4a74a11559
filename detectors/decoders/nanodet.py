"""Decoder of NanoDet-Plus: scores and distributions of distances in one table."""

from typing import Literal

from typing_extensions import override

from .base import (
    IMAGENET_BGR,
    BoxCandidates,
    BoxOutput,
    Guess,
    Interface,
    Outputs,
    Size,
    cell_count,
    named,
    output_rows,
    static,
)
from .picodet import STRIDES, distance_boxes


class NanodetOutput(BoxOutput):
    """One output (1, cells, classes + 4 * bins): scores, and logits of distances in strides."""

    kind: Literal["nanodet"]
    name: str | None = None
    """Name of the output; by default the only output."""
    strides: tuple[int, ...] = STRIDES
    bins: int = 8
    """Number of values of a distribution: distances of 0 to bins - 1 strides."""
    center: float = 0.0
    """Point of a cell that distances count from, in strides; 0.5 for NanoDet before Plus."""

    @override
    def candidates(self, outputs: Outputs, size_px: Size, /) -> BoxCandidates:
        classes = len(self.classes)
        rows = output_rows(named(outputs, self.name), classes + 4 * self.bins, "scores, distances")
        return distance_boxes(
            rows[:, :classes], rows[:, classes:], size_px, self.strides, self.center
        )

    @override
    @classmethod
    def recognise(cls, model: Interface, /) -> Guess | None:
        width, height = model.declared_px
        shape = model.outputs[0].shape
        rows, columns = static(shape, 1), static(shape, 2)
        if len(model.outputs) != 1 or len(shape) != 3 or not (width and height and columns):
            return None
        for strides, name, center in (
            (STRIDES, "NanoDet-Plus", 0.0),
            (STRIDES[:3], "NanoDet", 0.5),
        ):
            cells = cell_count((width, height), strides, round_up=True)
            # Networks with a table over the cells of three strides are usually of the YOLO family;
            # 112 columns are COCO's 80 classes and 32.
            is_known = len(strides) == 4 or model.outputs[0].name == "output" or columns == 112
            if rows == cells and columns > 32 and is_known:
                return Guess(
                    {"kind": "nanodet", "strides": strides, "center": center},
                    columns - 32,
                    (f"{rows} rows are the cells of strides {', '.join(map(str, strides))}",),
                    (
                        f"rows are {columns - 32} scores and 4 x 8 logits of distances, as {name} "
                        "exports",
                        "pixels have ImageNet's mean and deviation, in BGR",
                    ),
                    {**IMAGENET_BGR, "fit": "stretch"},
                    is_decided=False,
                )
        return None
