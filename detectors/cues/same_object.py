"""Merge detections of the same object by several detectors, so that it counts once.

Two detections of different detectors in one frame are the same object if their labels are
equivalent to the cues and their boxes overlap by more than half (intersection over union). The
detection with the better score is kept. A calibrated score, which is a probability, is preferred to
an uncalibrated one; otherwise the higher score is better. A kept detection replaces at most one of
each other detector, so that two cars in a row remain two. Detections of the same detector are not
compared.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from crosscue.detectors.base import Detections
from crosscue.detectors.boxes import box_ious
from crosscue.replay.vehicle.vehicle import Vehicle

MIN_IOU: Final = 0.5
KEPT: Final = -1


def label_meanings(vehicle: Vehicle) -> dict[str, str]:
    """Map each label to a common meaning: all labels that one cue counts share one."""
    found: dict[str, str] = {}
    for labels in vehicle.cue_labels().values():
        for label in labels:
            found.setdefault(label, labels[0])
    return found


def same_objects(
    found: Sequence[Detections], meaning: Mapping[str, str], is_calibrated: Sequence[bool]
) -> tuple[NDArray[np.int64], ...]:
    """Find the detections of objects that another detector found with a better score.

    Args:
        found: One result for each detector.
        meaning: Meaning of each label; labels that are missing have a meaning of their own.
        is_calibrated: For each detector, True if its scores are probabilities.

    Returns:
        For each detector an array of shape (N,): the index of the detector whose detection is kept
        instead, or ``KEPT``.
    """
    again = tuple(np.full(len(one), KEPT, np.int64) for one in found)
    if sum(len(one) > 0 for one in found) < 2:
        return again
    order = sorted(
        ((k, i) for k, one in enumerate(found) for i in range(len(one))),
        key=lambda at: (not is_calibrated[at[0]], -found[at[0]].scores[at[1]], at),
    )
    stands_for: dict[tuple[int, int], set[int]] = {}
    for k, i in order:
        best = _best_kept(found, meaning, stands_for, k, i)
        if best is None:
            stands_for[k, i] = {k}
        else:
            stands_for[best].add(k)
            again[k][i] = best[0]
    return again


def _best_kept(
    found: Sequence[Detections],
    meaning: Mapping[str, str],
    stands_for: Mapping[tuple[int, int], set[int]],
    k: int,
    i: int,
) -> tuple[int, int] | None:
    """Find the kept detection that overlaps a detection most and can replace it."""
    label = found[k].labels[i]
    wanted = meaning.get(label, label)
    kept = [
        (other, j)
        for (other, j), taken in stands_for.items()
        for name in (found[other].labels[j],)
        if k not in taken and meaning.get(name, name) == wanted
    ]
    if not kept:
        return None
    boxes_px = np.array([found[other].boxes_px[j] for other, j in kept])
    overlaps = box_ious(found[k].boxes_px[i], boxes_px)
    best = int(overlaps.argmax())
    return kept[best] if overlaps[best] > MIN_IOU else None
