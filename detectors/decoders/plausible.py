"""Tell boxes from the nonsense that a decoder makes of another layout's numbers."""

from typing import Final

import numpy as np

from .base import BoxCandidates, Floats, Size

# Minimum fraction of boxes with a sensible size if the layout is correct.
SENSIBLE_FRACTION: Final = 0.99
# Minimum fraction of boxes that touch the picture if the layout is correct.
INSIDE_FRACTION: Final = 0.9
# Number of detections in one picture that are suspicious if they are all alike.
_MANY: Final = 100
# Minimum number of boxes to judge by where they are.
_FEW: Final = 10
# Fraction of the picture that a box of the whole picture covers at least.
_WHOLE: Final = 0.9
# Boxes that all end before this are fractions of the picture, taken for pixels.
_CORNER_PX: Final = 2.0


def oddity(found: BoxCandidates, size_px: Size, score: float) -> str | None:
    """Return what is wrong with the boxes of one picture, or None if they may be right.

    Args:
        found: All candidates of a network for the picture.
        size_px: Width and height of the network's input.
        score: Minimum score of a detection.
    """
    numbers = np.column_stack([found.boxes_px, found.scores])
    bad = len(found) - int(np.isfinite(numbers).all(axis=1).sum())
    if bad:
        return f"{bad} of {len(found)} candidates are not finite numbers"
    if len(found) and not (found.scores.min() >= -1e-3 and found.scores.max() <= 1.0 + 1e-3):
        low, high = found.scores.min(), found.scores.max()
        return f"there are scores from {low:.4g} to {high:.4g}, not from 0 to 1"
    # Exports with built-in suppression pad their output with zeros.
    is_box = found.boxes_px.any(axis=1)
    is_sure = is_box & (found.scores >= score)
    for what, which in (("boxes", is_box), ("detections", is_sure)):
        why = _misplaced(found.boxes_px[which], size_px, what)
        if why is not None:
            return why
    why = _alike(found.boxes_px[is_sure], found.scores[is_sure], size_px)
    if why is None and _are_corners(found.boxes_px[is_box], size_px):
        return "the boxes are corners, taken for center and size"
    return why


def _are_corners(boxes_px: Floats, size_px: Size) -> bool:
    """Whether "sizes" exceed "centers" all over the picture, as x1 exceeds x0."""
    centers, sides = (boxes_px[:, :2] + boxes_px[:, 2:]) / 2.0, boxes_px[:, 2:] - boxes_px[:, :2]
    if (
        len(boxes_px) < _MANY
        or (np.percentile(centers, 95, axis=0) < np.multiply(0.8, size_px)).any()
    ):
        return False
    return bool((sides > centers).all(axis=1).mean() >= SENSIBLE_FRACTION)


def _misplaced(boxes_px: Floats, size_px: Size, what: str) -> str | None:
    sides = boxes_px[:, 2:] - boxes_px[:, :2]
    is_negative = (sides < 0.0).any(axis=1)
    is_huge = (sides > 4.0 * np.array(size_px)).any(axis=1)
    is_outside = (boxes_px[:, 2:] <= 0.0).any(axis=1) | (boxes_px[:, :2] >= size_px).any(axis=1)
    for how, is_odd, allowed in (
        ("have a negative size", is_negative, 1.0 - SENSIBLE_FRACTION),
        ("are more than four times as large as the picture", is_huge, 1.0 - SENSIBLE_FRACTION),
        ("are outside the picture", is_outside, 1.0 - INSIDE_FRACTION),
    ):
        if is_odd.sum() > allowed * len(boxes_px):
            return f"{is_odd.sum()} of {len(boxes_px)} {what} {how}"
    if len(boxes_px) >= _FEW and np.percentile(boxes_px, 99) <= _CORNER_PX:
        return (
            f"nearly all {len(boxes_px)} {what} are within {_CORNER_PX:g} pixels of the corner: "
            "fractions taken for pixels"
        )
    return None


def _alike(boxes_px: Floats, scores: Floats, size_px: Size) -> str | None:
    """Judge the detections by how many are alike."""
    inside = np.clip(boxes_px, 0.0, np.tile(size_px, 2))
    areas = np.prod(inside[:, 2:] - inside[:, :2], axis=1)
    whole = int((areas >= _WHOLE * size_px[0] * size_px[1]).sum())
    if whole >= _MANY:
        return f"{whole} boxes cover the whole picture"
    values, counts = np.unique(scores, return_counts=True)
    if len(scores) >= _MANY and counts.max() >= INSIDE_FRACTION * len(scores):
        return f"{counts.max()} detections have the score {values[counts.argmax()]:.4g}"
    return None
