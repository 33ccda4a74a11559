"""Cues that are detections with a label."""

from __future__ import annotations

from collections.abc import Sequence

from crosscue.detectors.base import Detections
from crosscue.replay.vehicle.vehicle import CueSpec, Vehicle


def count(boxes: Sequence[Detections], vehicle: Vehicle, cue: CueSpec) -> int:
    """How many detections with a cue's labels score above its setting, if it has one."""
    setting, min_score = vehicle.threshold_of(cue)
    return count_labels(boxes, vehicle.labels_of(cue), 0.0 if setting is None else min_score)


def count_labels(boxes: Sequence[Detections], labels: tuple[str, ...], score: float | None) -> int:
    """How many detections with one of ``labels`` are sure enough, see ``Detections.are_sure``."""
    return sum(
        label in labels and is_sure
        for found in boxes
        for label, is_sure in zip(found.labels, found.are_sure(score).tolist(), strict=True)
    )
