"""Cues that a run did not evaluate, and why; they differ from cues that were never positive."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence, Set
from types import MappingProxyType
from typing import Final

from crosscue.detectors.cues.observed import DetectorRole, all_labels
from crosscue.eval.runs.manifest import DetectorRow
from crosscue.replay.vehicle.cue_table import CUES

NO_LABEL: Final = "no detector can report their labels"
NO_OBJECTS: Final = "no detector of objects"
NO_ROAD: Final = "no detector of road"
NO_MOBILEYE: Final = "no Mobileye, or no range to an intersection"
NO_PLACE: Final = 'no range to an intersection, or not cars.kind = "tracks"'
NO_MASKS: Final = "only masks show which way a parked car faces (eq. 16), and all cars are boxes"
NEVER: Final = "no frame in which they could be computed"


def needing_masks(detectors: Sequence[DetectorRow], car_labels: Sequence[str]) -> frozenset[str]:
    """Return the cues that need masks, if no car of the run has one.

    Their absence would otherwise count as evidence that a road does not exist.

    Args:
        detectors: The manifest's rows of the detectors.
        car_labels: Labels of cars.
    """
    cars = {*car_labels}
    has_boxes = any(cars & {*one.boxes_only} for one in detectors)
    has_masks = any(cars & {*one.with_mask} for one in detectors)
    if has_masks or not has_boxes:
        return frozenset()
    return frozenset(cue.name for cue in CUES.values() if cue.needs_masks)


def not_looked_for(
    looked: Collection[str],
    detectors: Sequence[DetectorRow],
    cue_labels: Mapping[str, Sequence[str]],
    not_followed: Mapping[str, int] = MappingProxyType({}),
    without: Set[str] = frozenset(),
) -> dict[str, str]:
    """Return the reason why a cue has no rows, by cue, including user-defined cues.

    Args:
        looked: Cues that have rows.
        detectors: The manifest's rows of the detectors.
        cue_labels: All cues with the labels that they use.
        not_followed: Number of frames in which cars could not be followed, by reason.
        without: Cues that ``needing_masks`` returned.
    """
    roles = {one.role for one in detectors}
    finders = [one for one in detectors if one.role in (DetectorRole.OBJECTS, DetectorRole.SIGNS)]
    labels = all_labels(one.labels for one in finders)

    def why(cue: str) -> str:
        observed_by = CUES[cue].observed_by if cue in CUES else "objects"
        if observed_by == "mobileye":
            return NO_MOBILEYE
        if observed_by == "road":
            return NEVER if DetectorRole.ROAD in roles else NO_ROAD
        if cue in without:
            return NO_MASKS
        wanted = cue_labels[cue]
        if labels is not None and finders and wanted and labels.isdisjoint(wanted):
            return NO_LABEL
        can_be_signs = observed_by == "signs" or cue not in CUES
        has_any = bool(finders) if can_be_signs else DetectorRole.OBJECTS in roles
        if has_any and observed_by == "car pairs" and not_followed:
            return max(not_followed, key=lambda why: not_followed[why])
        if has_any and cue in CUES and CUES[cue].group == "cars_past":
            return NO_PLACE
        return NEVER if has_any else NO_OBJECTS

    return {cue: why(cue) for cue in cue_labels if cue not in looked}
