"""How good a Mask R-CNN is on labelled pictures: average precision, and rates at the cues' scores.

Average precision is of the network's own scores, rates are of calibrated ones.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import torch

from crosscue.detectors.base import Detections
from crosscue.detectors.networks.mask_rcnn.checkpoint import Calibration, Checkpoint, Facts
from crosscue.detectors.networks.mask_rcnn.detector import MaskRcnnSettings, calibrated, detector_of
from crosscue.detectors.networks.mask_rcnn.network import Plan

from .annotations import LabelledSet
from .calibration import judged
from .operating_point import Judged, Rates, rates_at
from .scores import average_precisions, detections_on

MIN_SCORE: Final = 0.02
"""Detections below it are left out of the average precision."""
AIMS: Final = (0.5, 0.9, 0.95)
"""Scores at which precision and recall are reported; the last two are the cues' own."""


@dataclass(frozen=True, slots=True)
class Measured:
    """What a network reaches on some pictures.

    Attributes:
        ap: As ``average_precisions`` names it, in percent.
        rates: By class and calibrated score.
        cpu_s: CPU seconds a picture, reading it included.
    """

    ap: Mapping[str, float | None]
    rates: Mapping[str, Mapping[float, Rates]]
    cpu_s: float


def measure(
    checkpoint: Checkpoint, labelled: LabelledSet, settings: MaskRcnnSettings, device: torch.device
) -> Measured:
    """Detect in all pictures and compare with their labels.

    Raises:
        LogError: A picture cannot be read.
        CrosscueError: Not even one picture fits into memory.
    """
    facts = checkpoint.facts
    began = time.process_time()
    found = raw_detections(facts.plan, checkpoint.network, labelled, settings, device)
    cpu_s = (time.process_time() - began) / max(len(found), 1)
    rates = {
        name: rates_by_score(rows, facts.calibration.get(name, Calibration()))
        for name, rows in judged(labelled, found).items()
    }
    return Measured(average_precisions(labelled, found), rates, cpu_s)


def raw_detections(
    plan: Plan,
    network: Any,
    labelled: LabelledSet,
    settings: MaskRcnnSettings,
    device: torch.device,
) -> list[Detections]:
    """What a network finds, with its own scores from ``MIN_SCORE``.

    Args:
        plan: Of the network.
        network: A torchvision ``MaskRCNN``.
        labelled: The pictures.
        settings: The score in them is not examined.
        device: Where.

    Raises:
        LogError: A picture cannot be read.
    """
    bare = Checkpoint(Facts(plan=plan), network, "")
    low = settings.model_copy(update={"score": MIN_SCORE})
    return list(detections_on(labelled, detector_of(bare, low, device)))


def rates_by_score(rows: Judged, by: Calibration) -> dict[float, Rates]:
    """How many are found and right at each of ``AIMS``, by calibrated scores."""
    scores = np.array([calibrated(score, by) for score in rows.scores.tolist()])
    return {aim: rates_at(Judged(scores, rows.is_right, rows.signs), aim) for aim in AIMS}
