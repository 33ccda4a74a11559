"""Scores that mean something: the fraction of detections with such a score that are right.

Fitted for each class on held-out pictures by logistic regression on the score's logit (Platt 1999).
A detection is right when it overlaps an object of its class, still free, by three tenths: a cue
asks whether a far sign is there, and a box of ten pixels is easily off by two.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from crosscue.detectors.base import Detections
from crosscue.detectors.boxes import overlaps
from crosscue.detectors.networks.mask_rcnn.checkpoint import Calibration
from crosscue.detectors.rle import area_px

from .annotations import Labelled, LabelledPicture, LabelledSet
from .operating_point import Judged
from .platt import fit_platt
from .scores import MIN_AREA_PX

OVERLAP: Final = 0.3
MIN_ROWS: Final = 20
"""Fewer right or wrong detections of a class than this, and its scores stay as they are."""


def judged(labelled: LabelledSet, found: Sequence[Detections]) -> Mapping[str, Judged]:
    """Every detection as right or wrong, by class, but those of objects that do not count."""
    table: dict[str, Judged] = {}
    for label, name in enumerate(labelled.classes):
        scores: list[float] = []
        right: list[bool] = []
        objects = 0
        for picture, detections in zip(labelled.pictures, found, strict=True):
            truth = [one for one in picture.objects if one.label == label]
            counts = np.array([_counts(one, picture) for one in truth], np.bool_)
            objects += int(counts.sum())
            for score, verdict in _verdicts(detections, name, truth, counts):
                scores.append(score)
                right.append(verdict)
        table[name] = Judged(np.array(scores), np.array(right, np.bool_), objects)
    return table


def _counts(one: Labelled, picture: LabelledPicture) -> bool:
    if one.mask is None:
        x0, y0, x1, y1 = one.box_px
        return not one.is_crowd and (x1 - x0) * (y1 - y0) >= MIN_AREA_PX
    return not one.is_crowd and (
        not isinstance(one.mask, bytes) or area_px(one.mask) >= MIN_AREA_PX
    )


def _verdicts(
    detections: Detections, name: str, truth: list[Labelled], counts: NDArray[np.bool_]
) -> list[tuple[float, bool]]:
    rows = [i for i, label in enumerate(detections.labels) if label == name]
    rows.sort(key=lambda i: -detections.scores[i])
    boxes = np.array([one.box_px for one in truth], np.float64).reshape(-1, 4)
    is_free = np.ones(len(truth), np.bool_)
    verdicts = []
    for i in rows:
        overlap = np.where(is_free, overlaps(detections.boxes_px[i], boxes), 0.0)
        best = int(overlap.argmax()) if len(truth) else -1
        if best < 0 or overlap[best] < OVERLAP:
            verdicts.append((float(detections.scores[i]), False))
            continue
        is_free[best] = False
        if counts[best]:
            verdicts.append((float(detections.scores[i]), True))
    return verdicts


def fitted(rows: Judged) -> Calibration:
    """The calibration of one class."""
    right = int(rows.is_right.sum())
    if min(right, len(rows.is_right) - right) < MIN_ROWS:
        return Calibration()
    found = fit_platt(rows.scores, rows.is_right)
    return Calibration(slope=found.slope, offset=found.offset)
