"""Divide a picture into tiles at full resolution, to detect small objects."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from crosscue.detectors.catalog.card import Tiles
from crosscue.detectors.decoders.base import Size

Corner = tuple[int, int]
# Distance to a tile's inner edge within which a box counts as cut off.
EDGE_PX = 2.0


def corners(picture: Size, tile: Size, tiles: Tiles) -> list[Corner]:
    """Left and top of each tile, in rows from ``tiles.top`` to ``tiles.bottom``."""
    width, height = picture
    top, bottom = round(tiles.top * height), round(tiles.bottom * height)
    lefts = _starts(0, width, tile[0], tiles.overlap, width)
    tops = _starts(top, bottom, tile[1], tiles.overlap, height)
    return [(x, y) for y in tops for x in lefts]


def _starts(first: int, last: int, length: int, overlap: float, side: int) -> list[int]:
    """Starts of tiles of a length that cover first to last and stay inside 0 to side."""
    span = last - first
    if span <= length or side <= length:
        return [min(max((first + last - length) // 2, 0), max(side - length, 0))]
    count = int(np.ceil((span - length) / (length * (1.0 - overlap)))) + 1
    return [first + round(i * (span - length) / (count - 1)) for i in range(count)]


def is_uncut(
    boxes_px: NDArray[np.float64], corner: Corner, tile: Size, picture: Size
) -> NDArray[np.bool_]:
    """Mark the boxes (N, 4), in the picture's pixels, that no inner edge of the tile cuts off."""
    low = np.array(corner, np.float64)
    high = np.minimum(low + tile, picture)
    at_low = (boxes_px[:, :2] < low + EDGE_PX) & (low > 0)
    at_high = (boxes_px[:, 2:] > high - EDGE_PX) & (high < picture)
    return np.asarray(~(at_low | at_high).any(axis=1))
