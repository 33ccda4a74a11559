"""Selection of the detections that can measure the range to an intersection."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from crosscue.detectors.base import Detections
from crosscue.detectors.cues.candidates import BELOW_SCORE, NO_CURVE
from crosscue.fusion.intersection_range import Reference
from crosscue.replay.vehicle.vehicle import STOP_SIGN, TRAFFIC_LIGHT, Vehicle

# Margin at the picture's edge; the height of a sign within it is truncated.
BORDER_PX: Final = 2.0

Source = Literal["curve", "motion"]
NO_HEIGHT: Final = "no height"
CUT: Final = "cut by the picture's edge"
# Cues of the dissertation whose detections measure a range, with its reference.
MEASURED: Final = ((STOP_SIGN, Reference.START), (TRAFFIC_LIGHT, Reference.END))


def source_of(vehicle: Vehicle, cue: str) -> Source | None:
    """Return the source of ranges to a cue's objects; None without a curve and a camera."""
    chosen = vehicle.ranges.kind
    if chosen != "motion" and getattr(vehicle.ranges, cue) is not None:
        return "curve"
    return None if chosen == "curve" or vehicle.camera.focal_px is None else "motion"


def why_not(
    found: Detections,
    heights_px: NDArray[np.float64],
    i: int,
    are_sure: NDArray[np.bool_],
    source: Source | None,
) -> str | None:
    """Return why a detection has no range; None if it or its track has one."""
    if not are_sure[i]:
        return BELOW_SCORE
    if heights_px[i] <= 0.0:
        return NO_HEIGHT
    width, height = found.size_px
    x0, y0, x1, y1 = found.boxes_px[i].tolist()
    if min(x0, y0) < BORDER_PX or x1 > width - BORDER_PX or y1 > height - BORDER_PX:
        return CUT
    return NO_CURVE if source is None else None


class Usable(NamedTuple):
    """N detections that may yield a range.

    Attributes:
        boxes_px: Boxes, shape (N, 4).
        heights_px: Heights, shape (N,).
        lenses: N lenses of lights; empty where they were not examined.
    """

    boxes_px: NDArray[np.float64]
    heights_px: NDArray[np.float64]
    lenses: tuple[str, ...]


def usable(
    vehicle: Vehicle,
    row: int,
    found: Sequence[Detections],
    heights_px: Sequence[NDArray[np.float64]],
) -> Usable:
    """Return the usable detections of one row of ``MEASURED``; ``SignRanges`` counts the rest."""
    cue, _ = MEASURED[row]
    labels = vehicle.labels_of(cue)
    _, score = vehicle.threshold_of(cue)
    some = [
        (detections.boxes_px[i], float(heights[i]), *(detections.lenses[i : i + 1] or ("",)))
        for detections, heights, are_sure in zip(
            found, heights_px, (one.are_sure(score) for one in found), strict=True
        )
        for i, label in enumerate(detections.labels)
        if label in labels and why_not(detections, heights, i, are_sure, "motion") is None
    ]
    boxes = np.array([box for box, _, _ in some]).reshape(-1, 4)
    heights = np.array([height for _, height, _ in some])
    return Usable(boxes, heights, tuple(lens for _, _, lens in some))
