"""Pool boxes of a pyramid's levels to a small grid on a CPU (RoIAlign; He et al. 2017).

The result is that of torchvision's ``MultiScaleRoIAlign``. The channels of a cell are adjacent in
memory and interpolated together, which is several times as fast.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray
from torch import Tensor

Grid = NDArray[np.float32]
# Value added to a level before it is rounded down, as in torchvision.
_ROUNDING: Final = 1e-6


class Pooler:
    """Pools boxes of the pictures of one batch."""

    def __init__(self, levels: Sequence[Tensor], height_px: int) -> None:
        """Rearrange the levels in memory.

        Args:
            levels: Features (N, channels, H, W) on a CPU, finest first.
            height_px: Height of the pictures.
        """
        self._levels: Final = [level.permute(0, 2, 3, 1).contiguous().numpy() for level in levels]
        self._halvings: Final = [
            round(float(np.log2(height_px / level.shape[1]))) for level in self._levels
        ]

    def __call__(self, pool: Any, boxes: Sequence[Tensor]) -> Tensor:
        """Pool all boxes, in order of pictures; shape (M, channels, side, side), channels last.

        Args:
            pool: A ``MultiScaleRoIAlign``, whose sizes are used.
            boxes: Boxes of each picture, shape (M, 4), in pixels.
        """
        every = torch.cat(list(boxes))
        pictures = np.repeat(np.arange(len(boxes)), [len(of_one) for of_one in boxes])
        side = int(pool.output_size[0])
        pooled = np.empty((len(every), side, side, self._levels[0].shape[3]), np.float32)
        wanted = self._levels_of(every, pool)
        for number, (level, halvings) in enumerate(zip(self._levels, self._halvings, strict=True)):
            rows = np.flatnonzero(wanted == number)
            if rows.size:
                _pool(
                    level,
                    np.float32(0.5**halvings),
                    every.numpy(),
                    pictures,
                    rows,
                    int(pool.sampling_ratio),
                    pooled,
                )
        return torch.from_numpy(pooled).permute(0, 3, 1, 2)

    def _levels_of(self, boxes: Tensor, pool: Any) -> NDArray[np.int64]:
        """Level of each box; larger boxes use coarser levels (Lin et al. 2017, eq. 1)."""
        width, height = boxes[:, 2] - boxes[:, 0], boxes[:, 3] - boxes[:, 1]
        size = torch.sqrt(width * height) / pool.canonical_scale
        exact = torch.floor(pool.canonical_level + torch.log2(size) + _ROUNDING)
        kept = exact.clamp(self._halvings[0], self._halvings[-1]) - self._halvings[0]
        return np.asarray(kept.nan_to_num(nan=0.0).long().numpy(), np.int64)


@njit(cache=True)
def _places(
    start: np.float32,
    cell: np.float32,
    samples: int,
    size: int,
    low: NDArray[np.int64],
    high: NDArray[np.int64],
    fraction: Grid,
) -> None:
    """Compute each sample's neighbouring cells in a row, and its distance from the lower one.

    The lower cell is -1 if a sample is more than one cell outside.
    """
    for i in range(low.size):
        # Summed in torchvision's order, for the same rounding.
        at = start + np.float32(i // samples) * cell
        at += (np.float32(i % samples) + np.float32(0.5)) * cell / np.float32(samples)
        # Negated so that NaN counts as outside.
        if not (at >= np.float32(-1.0) and at <= np.float32(size)):
            low[i] = -1
            continue
        at = max(at, np.float32(0.0))
        low[i] = min(np.int64(at), np.int64(size - 1))
        high[i] = min(low[i] + 1, np.int64(size - 1))
        fraction[i] = at - np.float32(low[i]) if low[i] < size - 1 else np.float32(0.0)


@njit(cache=True, fastmath={"contract"})
def _add(
    into: Grid,
    corners: tuple[Grid, Grid, Grid, Grid],
    weights: tuple[np.float32, np.float32, np.float32, np.float32],
) -> None:
    a, b, c, d = corners
    of_a, of_b, of_c, of_d = weights
    for i in range(into.size):
        into[i] += of_a * a[i] + of_b * b[i] + of_c * c[i] + of_d * d[i]


@njit(cache=True)
def _pool(
    level: Grid,
    scale: np.float32,
    boxes: Grid,
    pictures: NDArray[np.int64],
    rows: NDArray[np.int64],
    samples: int,
    pooled: Grid,
) -> None:
    _, height, width, channels = level.shape
    side = pooled.shape[1]
    count, one = side * samples, np.float32(1.0)
    left, right, top, bottom = np.empty((4, count), np.int64)
    of_right, of_bottom = np.empty((2, count), np.float32)
    for row in rows:
        box, picture = boxes[row] * scale, level[pictures[row]]
        cell_x = max(box[2] - box[0], one) / np.float32(side)
        cell_y = max(box[3] - box[1], one) / np.float32(side)
        _places(box[0], cell_x, samples, width, left, right, of_right)
        _places(box[1], cell_y, samples, height, top, bottom, of_bottom)
        cells = pooled[row].reshape(side * side, channels)
        cells[:] = np.float32(0.0)
        for y in range(count):
            if top[y] < 0:
                continue
            upper, lower, v = picture[top[y]], picture[bottom[y]], of_bottom[y]
            for x in range(count):
                if left[x] < 0:
                    continue
                u = of_right[x]
                _add(
                    cells[y // samples * side + x // samples],
                    (upper[left[x]], upper[right[x]], lower[left[x]], lower[right[x]]),
                    ((one - v) * (one - u), (one - v) * u, v * (one - u), v * u),
                )
        cells *= one / np.float32(samples * samples)
