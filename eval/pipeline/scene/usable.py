"""Which detections may say how far an intersection is, and why the others may not."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from crosscue.detectors.base import Detections
from crosscue.detectors.cues.candidates import BELOW_SCORE, NO_CURVE
from crosscue.fusion.intersection_range import Reference
from crosscue.replay.vehicle.vehicle import STOP_SIGN, TRAFFIC_LIGHT, Vehicle

BORDER_PX: Final = 2.0
"""A sign that reaches the picture's edge is cut, so its height says nothing about its distance."""

Source = Literal["curve", "motion"]
NO_HEIGHT: Final = "no height"
CUT: Final = "cut by the picture's edge"
MEASURED: Final = ((STOP_SIGN, Reference.START), (TRAFFIC_LIGHT, Reference.END))
"""Cues whose detections measure a distance, and to where: the source's."""


def source_of(vehicle: Vehicle, cue: str) -> Source | None:
    """Where ranges to a cue's objects come from; None if there is neither curve nor camera."""
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
    """Why a detection has no range; None where it has one, or belongs to a track that has."""
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
    """N detections that may give a range.

    Attributes:
        boxes_px: Shape (N, 4).
        heights_px: Shape (N,).
        lenses: N lenses of lights, empty where nobody looked.
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
    """Detections of one row of ``MEASURED``; ``SignRanges`` counts the rest."""
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
