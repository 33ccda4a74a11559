"""Overlap of boxes, and non-maximum suppression."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

# Number of boxes compared with all others at a time. Most are suppressed by the first ones.
_BLOCK: Final = 32


def box_ious(boxes: NDArray[np.float64], others: NDArray[np.float64]) -> NDArray[np.float64]:
    """Intersection over union of boxes, shape (..., 4), with others of a shape that fits."""
    x0, y0, x1, y1 = (boxes[..., i] for i in range(4))
    left, top, right, bottom = (others[..., i] for i in range(4))
    width = np.maximum(np.minimum(x1, right) - np.maximum(x0, left), 0.0)
    both = width * np.maximum(np.minimum(y1, bottom) - np.maximum(y0, top), 0.0)
    own, other = (x1 - x0) * (y1 - y0), (right - left) * (bottom - top)
    return np.asarray(both / np.maximum(own + other - both, 1e-12), np.float64)


def non_maximum_suppression(
    boxes: NDArray[np.float64],
    scores: NDArray[np.float64],
    groups: NDArray[np.int64],
    min_score: float,
    max_overlap: float,
) -> NDArray[np.int64]:
    """Indices of the boxes that non-maximum suppression keeps, best first.

    Args:
        boxes: Shape (N, 4): x0, y0, x1, y1.
        scores: Shape (N,), finite.
        groups: Shape (N,): only boxes of the same group suppress each other.
        min_score: Boxes with a lower score are removed.
        max_overlap: Of two boxes with a larger intersection over union, only the better is kept.
    """
    left = np.flatnonzero(scores >= min_score)
    left = left[np.argsort(-scores[left], kind="stable")]
    kept: list[int] = []
    while len(left):
        block, rest = left[:_BLOCK], left[_BLOCK:]
        rivals = _rivals(boxes, groups, block, left, max_overlap)
        is_left = np.ones(len(left), np.bool_)
        for i in range(len(block)):
            if is_left[i]:
                kept.append(int(block[i]))
                is_left[i:] &= ~rivals[i, i:]
        left = rest[is_left[len(block) :]]
    return np.array(kept, np.int64)


def is_best_label(
    boxes: NDArray[np.float64],
    scores: NDArray[np.float64],
    groups: NDArray[np.int64],
    labels: NDArray[np.int64],
    max_overlap: float,
) -> NDArray[np.bool_]:
    """Mark the boxes that no better box of their group with another label suppresses, shape (N,).

    Boxes of one label are left to the network's own suppression. Arguments are those of
    ``non_maximum_suppression``; ``labels`` has shape (N,).
    """
    is_kept = np.zeros(len(scores), np.bool_)
    order = np.lexsort([-scores, groups])
    for some in np.split(order, np.flatnonzero(np.diff(groups[order])) + 1):
        for i in some:
            rivals = some[is_kept[some] & (labels[some] != labels[i])]
            is_kept[i] = not (box_ious(boxes[i], boxes[rivals]) > max_overlap).any()
    return is_kept


def _rivals(
    boxes: NDArray[np.float64],
    groups: NDArray[np.int64],
    some: NDArray[np.int64],
    others: NDArray[np.int64],
    max_overlap: float,
) -> NDArray[np.bool_]:
    """Mark pairs of one group that overlap by more than ``max_overlap``, shape (some, others)."""
    is_over = box_ious(boxes[some, None], boxes[others]) > max_overlap
    return np.asarray(is_over & (groups[some, None] == groups[others]))
