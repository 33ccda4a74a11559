"""Decoder of PicoDet and NanoDet (GFL): class scores, and a distribution of each distance."""

from typing import Final, Literal

import numpy as np
from typing_extensions import override

from .base import (
    IMAGENET,
    IMAGENET_BGR,
    BoxCandidates,
    BoxOutput,
    Floats,
    Guess,
    Interface,
    Outputs,
    Size,
    Tensor,
    best_class,
    cell_count,
    cell_grid,
    named,
    output_rows,
    static,
    table_rows,
)

STRIDES: Final = (8, 16, 32, 64)


class PicodetOutput(BoxOutput):
    """Scores (1, cells, classes) and logits of distances (1, cells, 4 * bins) for each stride."""

    kind: Literal["picodet"]
    strides: tuple[int, ...] = STRIDES
    scores: tuple[str, ...]
    """Names of the outputs with scores, in the order of strides."""
    distances: tuple[str, ...]
    """Names of the outputs with distances to left, top, right and bottom, in the same order."""
    bins: int = 8
    """Number of values of a distribution: distances of 0 to bins - 1 strides."""

    @override
    def candidates(self, outputs: Outputs, size_px: Size, /) -> BoxCandidates:
        if not len(self.strides) == len(self.scores) == len(self.distances):
            raise ValueError("strides, scores and distances: expected equally many")
        classes = len(self.classes)
        scores = np.vstack(
            [output_rows(named(outputs, name, "scores"), classes, name) for name in self.scores]
        )
        logits = np.vstack(
            [
                output_rows(named(outputs, name, "distances"), 4 * self.bins, name)
                for name in self.distances
            ]
        )
        return distance_boxes(scores, logits, size_px, self.strides, 0.5)

    @override
    @classmethod
    def recognise(cls, model: Interface, /) -> Guess | None:
        width, height = model.declared_px
        tables = [out for out in model.outputs if table_rows(out.shape) is not None]
        strides = STRIDES[: len(tables) // 2]
        if width is None or height is None or len(tables) not in (6, 8):
            return None
        wanted = [cell_count((width, height), (s,), round_up=True) for s in strides]
        by_cells = [[out for out in tables if table_rows(out.shape) == n] for n in wanted]
        if any(len(pair) != 2 for pair in by_cells):
            return None
        columns = sorted({static(out.shape, -1) or 0 for out in tables})
        if len(columns) != 2 or 32 not in columns:
            return None
        classes = next(n for n in columns if n != 32)
        # PicoDet has four strides, and NanoDet before Plus three.
        is_nanodet = len(strides) == 3
        return Guess(
            {
                "kind": "picodet",
                "strides": strides,
                "scores": _with(by_cells, classes),
                "distances": _with(by_cells, 32),
            },
            classes,
            (f"{len(strides)} pairs of outputs over the cells of strides 8 to {strides[-1]}",),
            (
                "scores are final",
                "pixels are normalised with ImageNet's mean, in "
                + ("BGR, as NanoDet expects" if is_nanodet else "RGB"),
            ),
            {"fit": "stretch", **(IMAGENET_BGR if is_nanodet else {"colour": "rgb", **IMAGENET})},
        )


def distance_boxes(
    scores: Floats, logits: Floats, size_px: Size, strides: tuple[int, ...], center: float
) -> BoxCandidates:
    """Return boxes from the distances of a point of each cell to the four sides.

    Args:
        scores: Shape (cells, classes).
        logits: Shape (cells, 4 * bins): of distances to left, top, right and bottom.
        size_px: Width and height of the input.
        strides: Strides of the grids, in the order of the rows.
        center: Point of a cell that distances count from, in strides.

    Raises:
        ValueError: The number of rows is not that of the cells.
    """
    corner, stride = cell_grid(size_px, strides, round_up=True)
    if not len(corner) == len(scores) == len(logits):
        raise ValueError(
            f"expected {len(corner)} cells at {size_px[0]} x {size_px[1]}, got {len(scores)} "
            f"scores and {len(logits)} distances"
        )
    middle = (corner + center) * stride
    sides = _expected(logits.reshape(len(logits), 4, -1)) * stride
    best, numbers = best_class(scores)
    return BoxCandidates(np.hstack([middle - sides[:, :2], middle + sides[:, 2:]]), best, numbers)


def _expected(logits: Floats) -> Floats:
    """Mean of each distribution: shape (N, 4, bins) to (N, 4)."""
    weights = np.exp(logits - logits.max(axis=2, keepdims=True))
    bins = np.arange(logits.shape[2], dtype=np.float64)
    return np.asarray((weights @ bins) / weights.sum(axis=2), np.float64)


def _with(by_cells: list[list[Tensor]], columns: int) -> tuple[str, ...]:
    return tuple(
        next(out.name for out in pair if static(out.shape, -1) == columns) for pair in by_cells
    )
