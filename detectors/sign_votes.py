"""Points of a picture compared with those of drawings; likenesses vote for where a sign would be.

Two binary descriptors are compared by the number of bits in which they differ (Rublee et al., ORB,
2011). A point counts when its nearest descriptor in a drawing is much nearer than the second (the
ratio test; Lowe, 2004). Signs stand upright, and so do the descriptors.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from crosscue.replay.columns import Int64s

Words = NDArray[np.uint64]


@njit(cache=True)
def _ones(word: np.uint64) -> np.int64:
    # The pattern that LLVM knows as one machine instruction.
    word = word - ((word >> np.uint64(1)) & np.uint64(0x5555555555555555))
    word = (word & np.uint64(0x3333333333333333)) + (
        (word >> np.uint64(2)) & np.uint64(0x3333333333333333)
    )
    word = (word + (word >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return np.int64((word * np.uint64(0x0101010101010101)) >> np.uint64(56))


@njit(cache=True, nogil=True)
def nearest(points: Words, drawn: Words, first: Int64s, ratio: float, most: int) -> Int64s:
    """For each point and drawing the drawing's descriptor that passes the ratio test, else -1.

    Args:
        points: Shape (N, 4), uint64: descriptors of the picture.
        drawn: Shape (M, 4): descriptors of all drawings, one after the other.
        first: Shape (K + 1,): where each drawing's descriptors begin.
        ratio: Nearest over second nearest must be below.
        most: Bits in which the nearest may differ.

    Returns:
        Shape (N, K), int64.
    """
    found = np.full((len(points), len(first) - 1), -1, np.int64)
    for i in range(len(points)):
        a, b, c, d = points[i, 0], points[i, 1], points[i, 2], points[i, 3]
        for k in range(len(first) - 1):
            best, second, at = 257, 257, -1
            for j in range(first[k], first[k + 1]):
                bits = int(
                    _ones(a ^ drawn[j, 0])
                    + _ones(b ^ drawn[j, 1])
                    + _ones(c ^ drawn[j, 2])
                    + _ones(d ^ drawn[j, 3])
                )
                if bits < best:
                    second, best, at = best, bits, j
                elif bits < second:
                    second = bits
            if best <= most and best < ratio * second:
                found[i, k] = at
    return found


@njit(cache=True, nogil=True)
def window_counts(at_cell: Int64s, drawn: Int64s, rows: int, columns: int, reach: int) -> Int64s:
    """How many different points of one drawing vote for the window around each cell of a grid.

    A texture that repeats one point of the drawing a hundred times still counts once.

    Args:
        at_cell: Shape (V, 2): column and row of each vote's cell.
        drawn: Shape (V,): which of the drawing's points voted; equal ones stand together.
        rows: Of the grid.
        columns: Of the grid.
        reach: Cells to each side of the middle one that belong to a window.

    Returns:
        Shape (rows, columns), int64.
    """
    counts = np.zeros((rows, columns), np.int64)
    last = np.full((rows, columns), -1, np.int64)
    for i in range(len(drawn)):
        x, y = at_cell[i, 0], at_cell[i, 1]
        for row in range(max(y - reach, 0), min(y + reach + 1, rows)):
            for column in range(max(x - reach, 0), min(x + reach + 1, columns)):
                if last[row, column] != drawn[i]:
                    last[row, column] = drawn[i]
                    counts[row, column] += 1
    return counts
