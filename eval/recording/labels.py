"""Which boxes of a frame get a permanent label, so that no label covers another or is cut off."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

# Width of the picture in the viewer, in points, as in a window of 1400 points.
PICTURE_POINTS: Final = 640.0
# Size of the viewer's text, the frame around it, and the distance below its box, in points.
LETTER: Final = (7.0, 17.0)
FRAME: Final = (10.0, 6.0)
BELOW: Final = 3.0
# Narrowest column into which the viewer wraps a label, in points.
NARROWEST: Final = 60.0


def label_places(
    boxes: NDArray[np.float64], texts: Sequence[str], width_px: int
) -> NDArray[np.float64]:
    """Return the rectangles of labels in the viewer, centred below their boxes, shape (N, 4)."""
    points = width_px / PICTURE_POINTS
    widths = LETTER[0] * np.array([len(text) for text in texts], np.float64)
    columns = np.maximum((boxes[:, 2] - boxes[:, 0]) / points, NARROWEST)
    lines = np.ceil(widths / columns)
    half_px = points * (np.minimum(widths, columns) + FRAME[0]) / 2.0
    middle_px, top_px = boxes[:, [0, 2]].mean(axis=1), boxes[:, 3] + BELOW * points
    bottom_px = top_px + points * (LETTER[1] * lines + FRAME[1])
    return np.stack([middle_px - half_px, top_px, middle_px + half_px, bottom_px], axis=1)


def labelled(
    boxes: NDArray[np.float64],
    texts: Sequence[str],
    scores: Sequence[float],
    size_px: tuple[int, int],
) -> list[bool]:
    """Return which boxes get a label: the surest first, each inside the picture and legible.

    Args:
        boxes: Corners x0, y0, x1, y1 in pixels, shape (N, 4).
        texts: Labels.
        scores: Scores of the detections; negative for boxes that only get in the way.
        size_px: Width and height of the picture.
    """
    places = label_places(boxes, texts, size_px[0])
    is_inside = (
        (np.asarray(scores) >= 0.0)
        & (places[:, :2] >= 0.0).all(axis=1)
        & (places[:, 2:] <= size_px).all(axis=1)
    )
    kept: list[int] = []
    for row in sorted(np.flatnonzero(is_inside).tolist(), key=lambda row: (-scores[row], row)):
        place = places[row]
        holds = (boxes[:, :2] <= place[:2]).all(axis=1) & (place[2:] <= boxes[:, 2:]).all(axis=1)
        if not any(_overlap(one, place) for one in (*places[kept], *boxes[~holds])):
            kept.append(row)
    return [row in kept for row in range(len(places))]


def _overlap(one: NDArray[np.float64], other: NDArray[np.float64]) -> bool:
    sizes = np.minimum(one[2:], other[2:]) - np.maximum(one[:2], other[:2])
    return bool((sizes > 0.0).all())
