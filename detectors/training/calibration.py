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
from crosscue.replay.columns import Floats

from .annotations import Labelled, LabelledPicture, LabelledSet
from .operating_point import Judged
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
    from scipy.optimize import minimize

    right = int(rows.is_right.sum())
    if min(right, len(rows.is_right) - right) < MIN_ROWS:
        return Calibration()
    kept = np.clip(rows.scores, 1e-6, 1.0 - 1e-6)
    logit = np.log(kept / (1.0 - kept))
    # Platt's targets: one more right and one more wrong than were seen.
    target = np.where(
        rows.is_right, (right + 1) / (right + 2), 1 / (len(rows.is_right) - right + 2)
    )

    def cost(at: Floats) -> float:
        z = np.exp(at[0]) * logit + at[1]
        return float((np.logaddexp(0.0, z) - target * z).mean())

    best = minimize(cost, np.zeros(2), method="Nelder-Mead").x
    slope, offset = float(np.clip(np.exp(best[0]), 0.05, 20.0)), float(np.clip(best[1], -20, 20))
    return Calibration(slope=round(slope, 5), offset=round(offset, 5))
