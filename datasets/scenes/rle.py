"""Masks as COCO's compressed run lengths: columns first, zeros first."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def encode(mask: NDArray[np.bool_], left: int, top: int, width: int, height: int) -> str:
    """The run lengths of a picture that is zero but for ``mask``, whose first pixel is given.

    Args:
        mask: Shape (h, w).
        left: Column of the mask's first pixel.
        top: Row of the mask's first pixel.
        width: Of the picture.
        height: Of the picture.

    Raises:
        ValueError: The mask does not lie within the picture.
    """
    high, wide = mask.shape
    if left < 0 or top < 0 or left + wide > width or top + high > height:
        raise ValueError(f"mask {wide}x{high} at {left}, {top}: not within {width}x{height}")
    columns = np.zeros((wide, high + 2), np.int8)
    columns[:, 1:-1] = mask.T
    step = np.diff(columns, axis=1)
    column, begin = np.nonzero(step == 1)
    _, end = np.nonzero(step == -1)
    base = (left + column.astype(np.int64)) * height + top
    edges = np.column_stack([base + begin, base + end]).ravel()
    # A run to the bottom goes on at the top of the next column.
    if len(edges):
        meets = np.flatnonzero(edges[1:-1:2] == edges[2::2])
        edges = np.delete(edges, np.concatenate([2 * meets + 1, 2 * meets + 2]))
    counts = np.diff(np.concatenate([[0], edges, [width * height]]))
    if counts[-1] == 0:
        counts = counts[:-1]
    return _text(counts.tolist())


def decode(text: str, width: int, height: int) -> NDArray[np.bool_]:
    """The picture, shape (height, width).

    Raises:
        ValueError: The runs do not fill the picture.
    """
    counts = _counts(text)
    if sum(counts) != width * height or min(counts, default=0) < 0:
        raise ValueError(f"runs of {sum(counts)} pixels: want {width} x {height}")
    values = np.arange(len(counts)) % 2 == 1
    flat: NDArray[np.bool_] = np.repeat(values, counts)
    return flat.reshape(width, height).T


def _text(counts: list[int]) -> str:
    """Differences to the count but one before, five bits a character, lowest first."""
    out = []
    for i, count in enumerate(counts):
        left = count - counts[i - 2] if i > 2 else count
        while True:
            bits = left & 31
            left >>= 5
            more = left != (-1 if bits & 16 else 0)
            out.append(chr(48 + bits + (32 if more else 0)))
            if not more:
                break
    return "".join(out)


def _counts(text: str) -> list[int]:
    counts: list[int] = []
    value = shift = 0
    for character in text:
        bits = ord(character) - 48
        value |= (bits & 31) << shift
        shift += 5
        if bits & 32:
            continue
        if bits & 16:
            value |= -1 << shift
        counts.append(value + counts[-2] if len(counts) > 2 else value)
        value = shift = 0
    return counts
