"""Cues that are detections with a label."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from crosscue.detectors.base import Detections
from crosscue.replay.vehicle.cue_spec import CueSpec
from crosscue.replay.vehicle.vehicle import Vehicle

SAME_SIGN: Final = {"do not enter": ("do not enter", "no entry")}
"""The American and the international sign, which say the same."""


def labels_of(cue: CueSpec, vehicle: Vehicle) -> tuple[str, ...]:
    """Labels of the things that a cue is made of; none for road and Mobileye."""
    if cue.observed_by == "car pairs":
        return vehicle.cars.labels
    if cue.settings is not None:
        labels: tuple[str, ...] = getattr(vehicle.cues, f"{cue.settings}_labels")
        return labels
    return () if cue.label is None else SAME_SIGN.get(cue.label, (cue.label,))


def count(boxes: Sequence[Detections], vehicle: Vehicle, cue: CueSpec) -> int:
    """How many detections with a cue's labels are surer than its setting, if it has one."""
    least = 0.0 if cue.settings is None else getattr(vehicle.cues, f"{cue.settings}_score")
    return count_labels(boxes, labels_of(cue, vehicle), least)


def count_labels(boxes: Sequence[Detections], labels: tuple[str, ...], score: float) -> int:
    """How many detections have one of ``labels`` and more than ``score``."""
    return sum(
        label in labels and bool(s > score)
        for found in boxes
        for label, s in zip(found.labels, found.scores.tolist(), strict=True)
    )
