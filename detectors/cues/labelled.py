"""Cues that count detections by label."""

from __future__ import annotations

from collections.abc import Sequence

from crosscue.detectors.base import Detections
from crosscue.replay.vehicle.vehicle import CueSpec, OwnCue, Vehicle

from .candidates import Count, count_by_label


def count(boxes: Sequence[Detections], vehicle: Vehicle, cue: CueSpec) -> Count:
    """Count the detections with a cue's labels and a score above its threshold."""
    setting, score = vehicle.threshold_of(cue)
    labels = vehicle.labels_of(cue)
    boxes = [found for found in boxes if not set(labels).isdisjoint(found.labels)]
    number = count_labels(boxes, labels, 0.0 if setting is None else score)
    return count_by_label(boxes, labels, number, setting, score)


def count_own(boxes: Sequence[Detections], name: str, own: OwnCue) -> Count:
    """Count the detections of a user-defined cue."""
    number = count_labels(boxes, own.labels, own.score)
    return count_by_label(boxes, own.labels, number, f"[cues.own.{name}] score", own.score)


def count_labels(boxes: Sequence[Detections], labels: tuple[str, ...], score: float | None) -> int:
    """Count detections with one of ``labels`` and a high score, as in ``Detections.are_sure``."""
    return sum(
        label in labels and is_sure
        for found in boxes
        for label, is_sure in zip(found.labels, found.are_sure(score).tolist(), strict=True)
    )
