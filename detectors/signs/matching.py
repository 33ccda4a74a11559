"""Match points of a picture with points of drawings, and count the matches' votes for a sign.

Two binary descriptors are compared by the number of bits in which they differ (Rublee et al., ORB,
2011). A point matches if its nearest descriptor in a drawing is much nearer than the second
nearest (the ratio test; Lowe, 2004). Signs are upright, and so are the descriptors.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numba import njit
from numpy.typing import NDArray

Words = NDArray[np.uint64]
Counts = NDArray[np.int32]
_BITS_AT: Final = np.uint64(32)
_PLACE: Final = np.uint64(0xFFFFFFFF)
# A key without a match: more differing bits than a descriptor has.
_NONE: Final = np.uint64(257 << 32)


@njit(cache=True)
def _ones(word: np.uint64) -> np.uint64:
    # LLVM compiles this pattern to one machine instruction, for several words at a time.
    word = word - ((word >> np.uint64(1)) & np.uint64(0x5555555555555555))
    word = (word & np.uint64(0x3333333333333333)) + (
        (word >> np.uint64(2)) & np.uint64(0x3333333333333333)
    )
    word = (word + (word >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return (word * np.uint64(0x0101010101010101)) >> np.uint64(56)


@njit(cache=True)
def _keys(point: Words, a: Words, b: Words, c: Words, d: Words, keys: Words) -> None:
    # The number of differing bits, then the index: keys are unique, and ties go to the first.
    p, q, r, s = point[0], point[1], point[2], point[3]
    for j in range(keys.size):
        bits = _ones(p ^ a[j]) + _ones(q ^ b[j]) + _ones(r ^ c[j]) + _ones(s ^ d[j])
        keys[j] = (bits << _BITS_AT) | np.uint64(j)


@njit(cache=True)
def _min_above(keys: Words, floor: np.uint64) -> np.uint64:
    smallest = _NONE
    for j in range(keys.size):
        smallest = min(smallest, keys[j] if keys[j] > floor else _NONE)
    return smallest


@njit(cache=True)
def _smallest(keys: Words) -> np.uint64:
    smallest = _NONE
    for j in range(keys.size):
        smallest = min(smallest, keys[j])
    return smallest


@njit(cache=True, nogil=True)
def nearest(
    points: Words, drawn: Words, first: NDArray[np.int64], ratio: float, max_count: int
) -> NDArray[np.int64]:
    """Index of the drawing's descriptor that passes the ratio test, per drawing and point, or -1.

    Args:
        points: Shape (N, 4), uint64: descriptors of the picture.
        drawn: Shape (M, 4): descriptors of all drawings, concatenated.
        first: Shape (K + 1,): start of each drawing's descriptors.
        ratio: Upper bound of nearest over second nearest distance.
        max_count: Maximum number of bits in which the nearest differs.

    Returns:
        Shape (K, N), int64.
    """
    found = np.full((len(first) - 1, len(points)), -1, np.int64)
    columns = drawn.T.copy()
    a, b, c, d = columns[0], columns[1], columns[2], columns[3]
    keys = np.empty(len(drawn), np.uint64)
    for i in range(len(points)):
        _keys(points[i], a, b, c, d, keys)
        for k in range(len(first) - 1):
            of_drawing = keys[first[k] : first[k + 1]]
            best = _smallest(of_drawing)
            bits = np.int64(best >> _BITS_AT)
            if bits <= max_count:
                second = np.int64(_min_above(of_drawing, best) >> _BITS_AT)
                if bits < ratio * second:
                    found[k, i] = np.int64(best & _PLACE)
    return found


@njit(cache=True, nogil=True)
def window_counts(
    at_cell: NDArray[np.int64], drawn: NDArray[np.int64], rows: int, columns: int, reach: int
) -> Counts:
    """Count the distinct points of one drawing that vote for the window around each cell.

    A texture that repeats one point of the drawing a hundred times still counts once.

    Args:
        at_cell: Shape (V, 2): column and row of each vote's cell.
        drawn: Shape (V,): index of the drawing's point that voted; equal indices are adjacent.
        rows: Number of rows of the grid.
        columns: Number of columns of the grid.
        reach: Number of cells of a window to each side of its centre.

    Returns:
        Shape (rows, columns), int32.
    """
    counts = np.zeros((rows, columns), np.int32)
    last = np.full((rows, columns), -1, np.int32)
    for i in range(len(drawn)):
        x, y = at_cell[i, 0], at_cell[i, 1]
        for row in range(max(y - reach, 0), min(y + reach + 1, rows)):
            for column in range(max(x - reach, 0), min(x + reach + 1, columns)):
                if last[row, column] != drawn[i]:
                    last[row, column] = drawn[i]
                    counts[row, column] += 1
    return counts
