"""Decoder of PicoDet (GFL): class scores, and a distribution of each side's distance."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from .base import (
    BoxCandidates,
    BoxOutput,
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
)

_STRIDES = (8, 16, 32, 64)


class PicodetOutput(BoxOutput):
    """Scores (1, cells, classes) and logits of distances (1, cells, 4 * bins) for each stride."""

    kind: Literal["picodet"]
    strides: tuple[int, ...] = _STRIDES
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
        corner, stride = cell_grid(size_px, self.strides, round_up=True)
        if not len(corner) == len(scores) == len(logits):
            raise ValueError(
                f"expected {len(corner)} cells at {size_px[0]} x {size_px[1]}, got {len(scores)} "
                f"scores and {len(logits)} distances"
            )
        center = (corner + 0.5) * stride
        sides = _expected(logits.reshape(-1, 4, self.bins)) * stride
        best, numbers = best_class(scores)
        return BoxCandidates(
            np.hstack([center - sides[:, :2], center + sides[:, 2:]]), best, numbers
        )

    @override
    @classmethod
    def recognise(cls, model: Interface, /) -> Guess | None:
        given = model.inputs[0].shape
        height, width = static(given, -2), static(given, -1)
        tables = [out for out in model.outputs if len(out.shape) == 3]
        if width is None or height is None or len(tables) != 2 * len(_STRIDES):
            return None
        wanted = [cell_count((width, height), (s,), round_up=True) for s in _STRIDES]
        by_cells = [[out for out in tables if static(out.shape, 1) == n] for n in wanted]
        if any(len(pair) != 2 for pair in by_cells):
            return None
        columns = sorted({static(out.shape, 2) or 0 for out in tables})
        if len(columns) != 2 or 32 not in columns:
            return None
        classes = next(n for n in columns if n != 32)
        return Guess(
            {
                "kind": "picodet",
                "scores": _with(by_cells, classes),
                "distances": _with(by_cells, 32),
            },
            classes,
            (f"four pairs of outputs over the cells of strides 8 to 64 at {width} x {height}",),
            ("scores are final", "pixels are normalised with ImageNet's mean, in RGB"),
            {
                "colour": "rgb",
                "fit": "stretch",
                "mean": (123.675, 116.28, 103.53),
                "scale": (1 / 58.395, 1 / 57.12, 1 / 57.375),
            },
        )


def _expected(logits: NDArray[np.float64]) -> NDArray[np.float64]:
    """Mean of each distribution: shape (N, 4, bins) to (N, 4)."""
    weights = np.exp(logits - logits.max(axis=2, keepdims=True))
    bins = np.arange(logits.shape[2], dtype=np.float64)
    return np.asarray((weights @ bins) / weights.sum(axis=2), np.float64)


def _with(by_cells: list[list[Tensor]], columns: int) -> tuple[str, ...]:
    return tuple(
        next(out.name for out in pair if static(out.shape, 2) == columns) for pair in by_cells
    )
