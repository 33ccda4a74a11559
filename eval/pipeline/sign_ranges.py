"""Distances to an intersection from the signs and lights of one frame."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from crosscue.detectors.base import Detections
from crosscue.detectors.ranging.height_to_range import range_of
from crosscue.fusion.approaches import SignRange
from crosscue.fusion.intersection_range import Reference
from crosscue.replay.columns import Floats
from crosscue.replay.vehicle.vehicle import RangeCurve, Vehicle

BORDER_PX: Final = 2.0
"""A sign that reaches the picture's edge is cut, so its height says nothing of its distance."""


def sign_ranges(
    found: Sequence[Detections], heights_px: Sequence[Floats], vehicle: Vehicle
) -> tuple[SignRange, ...]:
    """A stop sign measures the start of the intersection, a traffic light its end.

    Args:
        found: Of the detectors of objects.
        heights_px: For each, the rows that every mask spans.
        vehicle: Labels, scores and curves; no curve, no range.
    """
    cues, ranges = vehicle.cues, vehicle.ranges
    kinds = (
        (cues.stop_sign_labels, cues.stop_sign_score, ranges.stop_sign, Reference.START),
        (cues.traffic_light_labels, cues.traffic_light_score, ranges.traffic_light, Reference.END),
    )
    return tuple(
        one
        for labels, score, curve, reference in kinds
        if curve is not None
        for detections, heights in zip(found, heights_px, strict=True)
        for one in _of_kind(detections, heights, labels, score, curve, reference)
    )


def _of_kind(
    found: Detections,
    heights_px: Floats,
    labels: tuple[str, ...],
    score: float,
    curve: RangeCurve,
    reference: Reference,
) -> list[SignRange]:
    width, height = found.size_px
    ranges = []
    for i, label in enumerate(found.labels):
        if label not in labels or found.scores[i] <= score or heights_px[i] <= 0.0:
            continue
        x0, y0, x1, y1 = found.boxes_px[i].tolist()
        is_cut = min(x0, y0) < BORDER_PX or x1 > width - BORDER_PX or y1 > height - BORDER_PX
        if not is_cut:
            range_m = float(range_of(np.array([heights_px[i]]), curve)[0])
            ranges.append(SignRange(reference, range_m, curve.residual_sd_m**2))
    return ranges
