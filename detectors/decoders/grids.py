"""Grids of cells that networks report boxes relative to."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from crosscue.replay.columns import Floats

from .base import Size


def cell_count(size_px: Size, strides: Sequence[int], *, round_up: bool = False) -> int:
    """How many cells the grids of all strides have over a picture."""
    return sum(w * h for w, h in _grids(size_px, strides, round_up))


def cells(
    size_px: Size, strides: Sequence[int], *, round_up: bool = False
) -> tuple[Floats, Floats]:
    """Column and row of each cell, shape (N, 2), and its stride in pixels, shape (N, 1)."""
    grids = _grids(size_px, strides, round_up)
    corners = [
        np.stack(np.meshgrid(np.arange(w), np.arange(h)), axis=-1).reshape(-1, 2) for w, h in grids
    ]
    steps = [np.full((w * h, 1), s) for (w, h), s in zip(grids, strides, strict=True)]
    return np.concatenate(corners).astype(np.float64), np.concatenate(steps).astype(np.float64)


def _grids(size_px: Size, strides: Sequence[int], round_up: bool) -> list[Size]:
    width, height = size_px
    if round_up:
        return [(-(-width // s), -(-height // s)) for s in strides]
    return [(width // s, height // s) for s in strides]
