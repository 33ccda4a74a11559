"""Cues that count detections by label."""

from __future__ import annotations

from collections.abc import Sequence

from crosscue.detectors.base import Detections
from crosscue.replay.vehicle.vehicle import CueSpec, Vehicle


def count(boxes: Sequence[Detections], vehicle: Vehicle, cue: CueSpec) -> int:
    """Count the detections with a cue's labels and a score above its threshold."""
    setting, min_score = vehicle.threshold_of(cue)
    return count_labels(boxes, vehicle.labels_of(cue), 0.0 if setting is None else min_score)


def count_labels(boxes: Sequence[Detections], labels: tuple[str, ...], score: float | None) -> int:
    """Count detections with one of ``labels`` and a high score, as in ``Detections.are_sure``."""
    return sum(
        label in labels and is_sure
        for found in boxes
        for label, is_sure in zip(found.labels, found.are_sure(score).tolist(), strict=True)
    )
