"""Cues that are detections with a label."""

from __future__ import annotations

from collections.abc import Sequence

from crosscue.detectors.base import Detections
from crosscue.replay.vehicle.cue_spec import CueSpec
from crosscue.replay.vehicle.vehicle import Vehicle


def count(boxes: Sequence[Detections], vehicle: Vehicle, cue: CueSpec) -> int:
    """How many detections with a cue's labels are surer than its setting, if it has one."""
    _, least = vehicle.threshold_of(cue)
    return count_labels(boxes, vehicle.labels_of(cue), least or 0.0)


def count_labels(boxes: Sequence[Detections], labels: tuple[str, ...], score: float) -> int:
    """How many detections have one of ``labels`` and more than ``score``."""
    return sum(
        label in labels and bool(s > score)
        for found in boxes
        for label, s in zip(found.labels, found.scores.tolist(), strict=True)
    )
