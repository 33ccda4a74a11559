"""Measure a Mask R-CNN on annotated pictures: average precision, and rates at the cues' scores.

Average precision uses the network's own scores, rates use calibrated ones. A calibrated score is
the fraction of detections with such a score that are correct. The calibration is fitted for each
class on held-out pictures by logistic regression on the score's logit (Platt 1999). A detection is
correct if it overlaps a not yet matched object of its class by 0.3. The bound is low because a cue
depends on the presence of a distant sign, and a box of ten pixels is easily off by two.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray

from crosscue.detectors.base import Detections
from crosscue.detectors.boxes import box_ious
from crosscue.detectors.networks.mask_rcnn.checkpoint import Calibration, Checkpoint, Facts
from crosscue.detectors.networks.mask_rcnn.detector import MaskRcnnSettings, calibrated, detector_of
from crosscue.detectors.networks.mask_rcnn.network import NetworkPlan
from crosscue.detectors.rle import area_px

from .annotations import LabelledPicture, LabelledSet, TrainingObject
from .operating_point import DetectionCounts, Verdicts, rates_at
from .platt import fit_platt
from .scores import MIN_AREA_PX, average_precisions, detections_on

# Score below which detections are left out of the average precision.
MIN_SCORE: Final = 0.02
# Scores at which precision and recall are reported; the last two are thresholds of cues.
AIMS: Final = (0.5, 0.9, 0.95)


@dataclass(frozen=True, slots=True)
class NetworkResults:
    """Results of a network on annotated pictures.

    Attributes:
        ap: Average precision in percent, with the names of ``average_precisions``.
        rates: Rates by class and calibrated score.
        cpu_s: CPU seconds per picture, including reading.
    """

    ap: Mapping[str, float | None]
    rates: Mapping[str, Mapping[float, DetectionCounts]]
    cpu_s: float


def measure_network(
    checkpoint: Checkpoint, labelled: LabelledSet, settings: MaskRcnnSettings, device: torch.device
) -> NetworkResults:
    """Detect in all pictures and compare with their labels.

    Raises:
        LogError: A picture cannot be read.
        CrosscueError: A single picture does not fit into memory.
    """
    facts = checkpoint.facts
    began = time.process_time()
    found = raw_detections(facts.plan, checkpoint.network, labelled, settings, device)
    cpu_s = (time.process_time() - began) / max(len(found), 1)
    rates = {
        name: rates_by_score(rows, facts.calibration.get(name, Calibration()))
        for name, rows in judged(labelled, found).items()
    }
    return NetworkResults(average_precisions(labelled, found), rates, cpu_s)


def raw_detections(
    plan: NetworkPlan,
    network: Any,
    labelled: LabelledSet,
    settings: MaskRcnnSettings,
    device: torch.device,
) -> list[Detections]:
    """Run a network with its uncalibrated scores, from ``MIN_SCORE``.

    Args:
        plan: Architecture and input of the network.
        network: A torchvision ``MaskRCNN``.
        labelled: The pictures.
        settings: Settings of the detector; the minimum score in them is ignored.
        device: Device of the network.

    Raises:
        LogError: A picture cannot be read.
    """
    bare = Checkpoint(Facts(plan=plan), network, "")
    low = settings.model_copy(update={"score": MIN_SCORE})
    return list(detections_on(labelled, detector_of(bare, low, device)))


def rates_by_score(rows: Verdicts, by: Calibration) -> dict[float, DetectionCounts]:
    """Rates at each of ``AIMS``, by calibrated scores."""
    scores = np.array([calibrated(score, by) for score in rows.scores.tolist()])
    return {aim: rates_at(Verdicts(scores, rows.is_right, rows.signs), aim) for aim in AIMS}


OVERLAP: Final = 0.3
# Minimum number of correct and of wrong detections of a class for a calibration.
MIN_ROWS: Final = 20


def judged(labelled: LabelledSet, found: Sequence[Detections]) -> Mapping[str, Verdicts]:
    """Judge every detection as correct or wrong, by class, without those of ignored objects."""
    table: dict[str, Verdicts] = {}
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
        table[name] = Verdicts(np.array(scores), np.array(right, np.bool_), objects)
    return table


def _counts(one: TrainingObject, picture: LabelledPicture) -> bool:
    if one.mask is None:
        x0, y0, x1, y1 = one.box_px
        return not one.is_crowd and (x1 - x0) * (y1 - y0) >= MIN_AREA_PX
    return not one.is_crowd and (
        not isinstance(one.mask, bytes) or area_px(one.mask) >= MIN_AREA_PX
    )


def _verdicts(
    detections: Detections, name: str, truth: list[TrainingObject], counts: NDArray[np.bool_]
) -> list[tuple[float, bool]]:
    rows = [i for i, label in enumerate(detections.labels) if label == name]
    rows.sort(key=lambda i: -detections.scores[i])
    boxes = np.array([one.box_px for one in truth], np.float64).reshape(-1, 4)
    is_free = np.ones(len(truth), np.bool_)
    verdicts = []
    for i in rows:
        overlap = np.where(is_free, box_ious(detections.boxes_px[i], boxes), 0.0)
        best = int(overlap.argmax()) if len(truth) else -1
        if best < 0 or overlap[best] < OVERLAP:
            verdicts.append((float(detections.scores[i]), False))
            continue
        is_free[best] = False
        if counts[best]:
            verdicts.append((float(detections.scores[i]), True))
    return verdicts


def fitted(rows: Verdicts) -> Calibration:
    """Fit the calibration of one class."""
    right = int(rows.is_right.sum())
    if min(right, len(rows.is_right) - right) < MIN_ROWS:
        return Calibration()
    found = fit_platt(rows.scores, rows.is_right)
    return Calibration(slope=found.slope, offset=found.offset)
