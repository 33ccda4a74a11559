"""Geometry of boxes: overlap, and suppression of double ones."""

from __future__ import annotations

import numpy as np

from crosscue.replay.columns import Floats, Int64s


def overlaps(box: Floats, others: Floats) -> Floats:
    """Intersection over union of one box with each of N others, shape (N,)."""
    low = np.maximum(box[:2], others[:, :2])
    high = np.minimum(box[2:], others[:, 2:])
    both = np.prod(np.maximum(high - low, 0.0), axis=1)
    areas = np.prod(others[:, 2:] - others[:, :2], axis=1) + np.prod(box[2:] - box[:2])
    return np.asarray(both / np.maximum(areas - both, 1e-12), np.float64)


def best_of(
    boxes: Floats, scores: Floats, groups: Int64s, min_score: float, max_overlap: float
) -> Int64s:
    """Which boxes stay: good enough, and no better one of their group over them; best first.

    Args:
        boxes: Shape (N, 4): x0, y0, x1, y1.
        scores: Shape (N,), finite.
        groups: Shape (N,): boxes of different groups do not compete.
        min_score: Lower scores go.
        max_overlap: Of two with a larger intersection over union, the better stays.
    """
    left = np.flatnonzero(scores >= min_score)
    left = left[np.argsort(-scores[left], kind="stable")]
    kept: list[int] = []
    while len(left):
        first, left = int(left[0]), left[1:]
        kept.append(first)
        is_rival = overlaps(boxes[first], boxes[left]) > max_overlap
        left = left[~(is_rival & (groups[left] == groups[first]))]
    return np.array(kept, np.int64)
