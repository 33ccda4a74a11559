"""What a run's detectors cannot show its cues, and cues that were not evaluated, with the reasons.

Such a cue differs from one that was never positive.
"""

from __future__ import annotations

import difflib
from collections.abc import Collection, Mapping, Sequence, Set
from types import MappingProxyType
from typing import Final

from crosscue.detectors.base import MIN_SCORE
from crosscue.detectors.cues.observed import DetectorRole, all_labels
from crosscue.eval.runs.manifest import DetectManifest, DetectorRow
from crosscue.replay.vehicle.cue_table import CUES
from crosscue.replay.vehicle.vehicle import Vehicle

NO_LABEL: Final = "no detector can report their labels"
NO_OBJECTS: Final = "no detector of objects"
NO_ROAD: Final = "no detector of road"
NO_MOBILEYE: Final = "no Mobileye, or no range to an intersection"
NO_PLACE: Final = 'no range to an intersection, or not cars.kind = "tracks"'
NOT_WANTED: Final = "not cars.leg_traffic = true, or no range to an intersection"
NO_MAP: Final = "no road_map in the vehicle file, or no intersection of it ahead"
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
        if observed_by == "map":
            return NO_MAP
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
        if has_any and cue in CUES and CUES[cue].group == "leg_traffic":
            return NOT_WANTED
        return NEVER if has_any else NO_OBJECTS

    return {cue: why(cue) for cue in cue_labels if cue not in looked}


def detector_notices(detected: DetectManifest, vehicle: Vehicle) -> list[str]:
    """Return notices about detectors whose results the cues of ``vehicle`` cannot fully use."""
    return [
        *(text for one in detected.detectors for text in _without_threshold(one, vehicle)),
        *(text for one in detected.detectors for text in _without_masks(one, vehicle)),
        *(text for one in detected.detectors for text in _without_cue(one, vehicle)),
        *_not_examined(detected, vehicle),
    ]


def uncounted(labels: Sequence[str] | None, vehicle: Vehicle) -> tuple[str, str] | None:
    """Return the labels, and the setting that counts one, if no cue counts any; else None."""
    counted = {label for wanted in vehicle.cue_labels().values() for label in wanted}
    if vehicle.counts_any_label or not labels or not counted.isdisjoint(labels):
        return None
    shown = f"({', '.join(labels[:3])}{', ...' if len(labels) > 3 else ''})"
    near = difflib.get_close_matches(labels[0].replace("_", " "), counted, n=1, cutoff=0.75)
    shown += f"; did you mean {near[0]!r}?" if near else ""
    return shown, f'[cues.own.NAME] labels = ["{labels[0]}"]'


def _without_cue(one: DetectorRow, vehicle: Vehicle) -> list[str]:
    why = uncounted(one.labels, vehicle)
    if why is None:
        return []
    return [
        f"{one.name}: no cue counts its labels {why[0]}: detections.parquet has its boxes, and "
        f"the belief does not use them; to count them, state in the vehicle file: {why[1]}"
    ]


def _without_threshold(one: DetectorRow, vehicle: Vehicle) -> list[str]:
    cues, cars = vehicle.cues, vehicle.cars
    by_score = [(cars.labels, cars.score)]
    if cues.kind != "tracks":
        by_score.append((cues.stop_sign_labels, cues.stop_sign_score))
        by_score.append((cues.traffic_light_labels, cues.traffic_light_score))
    missing = {label for labels, score in by_score if score is None for label in labels}
    missing &= {*(one.labels or ())} - one.min_scores.keys()
    if not missing:
        return []
    return [
        f"{one.name}: no threshold fitted for {', '.join(sorted(missing))}: they count "
        f"above {MIN_SCORE:.2f}; crosscue fit detector fits one to labelled images"
    ]


def _without_masks(one: DetectorRow, vehicle: Vehicle) -> list[str]:
    cues, labels = vehicle.cues, {*one.boxes_only}
    rules = []
    if labels & {*cues.stop_sign_labels, *cues.traffic_light_labels}:
        rules.append("heights of signs and lights are those of boxes")
    if labels & {*vehicle.cars.labels}:
        rules.append(
            "cross traffic is judged by boxes (eq. 15 uses masks), and its cars do not "
            "count as parked, since only a mask shows where one faces (eq. 16)"
        )
    return [f"{one.name}: no masks: {'; '.join(rules)}"] if rules else []


def _not_examined(detected: DetectManifest, vehicle: Vehicle) -> list[str]:
    """Return a notice about lights and signs whose pixels ``detect`` did not examine."""
    now, then = vehicle.cues, detected.settings.cues
    labels = {*now.traffic_light_labels} - {*then.traffic_light_labels}
    labels |= {*now.stop_sign_labels} - {*then.stop_sign_labels}
    labels &= {label for one in detected.detectors for label in one.labels or labels}
    if not labels:
        return []
    return [
        f"{', '.join(sorted(labels))}: not examined as lights or stop signs when the pictures were "
        "read, so lit lenses and second looks are missing; crosscue replay examines them"
    ]
