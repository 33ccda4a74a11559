"""One object found by several detectors counts once.

Two detections of different detectors in one frame are the same object if they mean the same to the
cues and their boxes overlap by more than half (intersection over union). The one with the better
score is kept: a calibrated score, which is a probability, before one that is not; else the higher.
A kept detection stands for at most one of each other detector, so that two cars in a row stay two.
Detections of the same detector are not compared.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from crosscue.detectors.base import Detections
from crosscue.detectors.ranging.object_tracks import iou
from crosscue.replay.vehicle.vehicle import Vehicle

MIN_IOU: Final = 0.5
KEPT: Final = -1


def meanings(vehicle: Vehicle) -> dict[str, str]:
    """From a label to what it means: labels that one cue counts mean the same."""
    found: dict[str, str] = {}
    for labels in vehicle.cue_labels().values():
        for label in labels:
            found.setdefault(label, labels[0])
    return found


def same_objects(
    found: Sequence[Detections], meaning: Mapping[str, str], is_calibrated: Sequence[bool]
) -> tuple[NDArray[np.int64], ...]:
    """Which detections are another detector's object again.

    Args:
        found: One result for each detector.
        meaning: From a label to what it means; a label that is not in it means itself.
        is_calibrated: Whether the scores of each detector are probabilities.

    Returns:
        For each detector shape (N,): the number of the detector whose detection is kept instead,
        or ``KEPT``.
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
    """The kept detection that overlaps most with one, of those that may stand for it."""
    label = found[k].labels[i]
    wanted = meaning.get(label, label)
    best, largest = None, MIN_IOU
    for (other, j), taken in stands_for.items():
        name = found[other].labels[j]
        if k in taken or meaning.get(name, name) != wanted:
            continue
        overlap = iou(found[k].boxes_px[i], found[other].boxes_px[j])
        if overlap > largest:
            best, largest = (other, j), overlap
    return best
