"""Conditions under which a detection can measure the range to an intersection."""

from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from crosscue.detectors.base import Detections
from crosscue.detectors.cues.candidates import BELOW_SCORE, NO_CURVE
from crosscue.replay.vehicle.vehicle import Vehicle

# Margin at the picture's edge; the height of a box within it is truncated.
BORDER_PX: Final = 2.0

Source = Literal["curve", "motion"]
NO_HEIGHT: Final = "no height"
CUT: Final = "cut by the picture's edge"


def source_of(vehicle: Vehicle, cue: str) -> Source | None:
    """Return the source of ranges to a cue's objects; None without a curve and a camera."""
    chosen = vehicle.ranges.kind
    if chosen != "motion" and getattr(vehicle.ranges, cue) is not None:
        return "curve"
    return None if chosen == "curve" or vehicle.camera.focal_px is None else "motion"


def are_cut(boxes_px: NDArray[np.float64], size_px: tuple[int, int]) -> NDArray[np.bool_]:
    """Return whether the picture's edge cuts boxes, shape (N, 4)."""
    are_near: NDArray[np.bool_] = boxes_px[:, :2].min(axis=1) < BORDER_PX
    return are_near | (boxes_px[:, 2:] > np.array(size_px) - BORDER_PX).any(axis=1)


def is_cut(box_px: NDArray[np.float64], size_px: tuple[int, int]) -> bool:
    """Return whether the picture's edge cuts one box; ``are_cut`` in plain numbers."""
    x0, y0, x1, y1 = box_px.tolist()
    is_past: bool = x1 > size_px[0] - BORDER_PX or y1 > size_px[1] - BORDER_PX
    return is_past or min(x0, y0) < BORDER_PX


def why_not(
    found: Detections,
    i: int,
    are_sure: NDArray[np.bool_],
    source: Source | None,
) -> str | None:
    """Return why a detection has no range; None if it or its track has one."""
    if not are_sure[i]:
        return BELOW_SCORE
    if found.heights_px[i] <= 0.0:
        return NO_HEIGHT
    if is_cut(found.boxes_px[i], found.size_px):
        return CUT
    return NO_CURVE if source is None else None
