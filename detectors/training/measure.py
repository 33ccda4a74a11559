"""Measure a Mask R-CNN on annotated pictures: average precision, and rates at the cues' scores.

Average precision uses the network's own scores, rates use calibrated ones. A calibrated score is
the fraction of detections with such a score that are correct. The calibration is fitted for each
class on held-out pictures by logistic regression on the score's logit (Platt 1999). A detection is
correct if it overlaps a not yet matched object of its class by 0.3. The bound is low because a cue
depends on the presence of a distant sign, and a box of ten pixels is easily off by two.
"""

import contextlib
import io
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import torch

from crosscue.detectors.base import Detections, Frame
from crosscue.detectors.boxes import box_ious
from crosscue.detectors.networks.mask_rcnn.checkpoint import Calibration, Checkpoint, Facts
from crosscue.detectors.networks.mask_rcnn.detector import MaskRcnnSettings, calibrated, detector_of
from crosscue.detectors.networks.mask_rcnn.network import NetworkPlan
from crosscue.detectors.rle import area_px, encode_mask
from crosscue.replay.columns import Floats

from .annotations import LabelledPicture, LabelledSet, TrainingObject, mask_of
from .operating_point import (
    DetectionCounts,
    Verdicts,
    concatenate_verdicts,
    fit_platt,
    match_boxes,
    rates_at,
)
from .samples import read_bgr

# Area below which true objects are ignored: found or not, they do not count.
MIN_AREA_PX: Final = 24
HALF: Final = 0.5
# COCO's sizes: small below 32 x 32 pixels, large above 96 x 96.
SIZES: Final = ("all", "small", "medium", "large")


def detections_on(
    labelled: LabelledSet, detect: Callable[[Sequence[Frame]], Sequence[Any]]
) -> Iterator[Detections]:
    """Yield a detector's results, picture by picture.

    Raises:
        LogError: A picture cannot be read.
    """
    for number, picture in enumerate(labelled.pictures):
        frame = Frame(number, "", read_bgr(picture), picture.size_px)
        (found,) = detect([frame])
        yield found


def average_precisions(
    labelled: LabelledSet, found: Sequence[Detections]
) -> dict[str, float | None]:
    """Compute AP by COCO's rules, of boxes and masks, by class and by size; in percent.

    Names are ``box``, ``box50`` (overlap of 0.5), ``box car``, ``box small``, ``box50 car``,
    ``box car small``, and likewise ``mask``. A value is None if the truth has no such object, or if
    no mask was detected or annotated. For masks, objects without a mask are left out, and so are
    detections of their class whose boxes overlap theirs by 0.5.
    """
    from pycocotools.coco import COCO
    from pycocotools.cocoeval import COCOeval

    has_masks = labelled.masks and all(one.masks[0] for one in found if len(one))
    scores: dict[str, float | None] = {}
    with contextlib.redirect_stdout(io.StringIO()):
        for kind, name in (("bbox", "box"), ("segm", "mask")):
            if kind == "segm" and not has_masks:
                scores |= dict.fromkeys((name, f"{name}50"), None)
                continue
            answers = _answers(labelled, found, of_masks=kind == "segm")
            if not answers:
                scores |= dict.fromkeys((name, f"{name}50"), 0.0)
                continue
            truth = COCO()
            truth.dataset = _truth(labelled, of_masks=kind == "segm")
            truth.createIndex()
            judge = COCOeval(truth, truth.loadRes(answers), kind)
            judge.evaluate()
            judge.accumulate()
            scores |= _named(name, judge.eval["precision"], labelled.classes)
    return scores


def _named(kind: str, precision: Any, classes: Sequence[str]) -> dict[str, float | None]:
    """Name the results of COCO's table (overlap, recall, class, size, max. detections)."""
    table = np.asarray(precision)[..., -1]
    scores = {kind: _mean(table[:, :, :, 0]), f"{kind}50": _mean(table[0, :, :, 0])}
    for i, size in enumerate(SIZES[1:], 1):
        scores[f"{kind} {size}"] = _mean(table[:, :, :, i])
    for k, name in enumerate(classes):
        scores[f"{kind} {name}"] = _mean(table[:, :, k, 0])
        scores[f"{kind}50 {name}"] = _mean(table[0, :, k, 0])
        for i, size in enumerate(SIZES[1:], 1):
            scores[f"{kind} {name} {size}"] = _mean(table[:, :, k, i])
    return scores


def _mean(values: Any) -> float | None:
    known = values[values > -1]
    return round(100.0 * float(known.mean()), 2) if known.size else None


def _truth(labelled: LabelledSet, *, of_masks: bool) -> dict[str, Any]:
    annotations: list[dict[str, Any]] = []
    for number, picture in enumerate(labelled.pictures):
        for one in picture.objects:
            if of_masks and one.mask is None:
                continue
            text = _runs(one.mask, picture, one)
            area = area_px(text)
            x0, y0, x1, y1 = one.box_px
            annotations.append(
                {
                    "id": len(annotations) + 1,
                    "image_id": number,
                    "category_id": one.label,
                    "bbox": [x0, y0, x1 - x0, y1 - y0],
                    "area": area,
                    "iscrowd": int(one.is_crowd or area < MIN_AREA_PX),
                    "segmentation": {"size": list(picture.size_px[::-1]), "counts": text},
                }
            )
    return {
        "images": [
            {"id": i, "width": p.size_px[0], "height": p.size_px[1]}
            for i, p in enumerate(labelled.pictures)
        ],
        "annotations": annotations,
        "categories": [{"id": i, "name": name} for i, name in enumerate(labelled.classes)],
    }


def _runs(mask: Any, picture: LabelledPicture, one: Any) -> bytes:
    if isinstance(mask, bytes):
        return mask
    return encode_mask(mask_of(one, picture.size_px), (0, 0), picture.size_px)


def _answers(
    labelled: LabelledSet, found: Sequence[Detections], *, of_masks: bool
) -> list[dict[str, Any]]:
    numbers = {name: i for i, name in enumerate(labelled.classes)}
    return [
        {
            "image_id": i,
            "category_id": numbers[label],
            "score": float(score),
            "bbox": [float(box[0]), float(box[1]), float(box[2] - box[0]), float(box[3] - box[1])],
            "segmentation": {"size": [one.size_px[1], one.size_px[0]], "counts": mask},
        }
        for i, one in enumerate(found)
        for box, score, label, mask in zip(
            one.boxes_px, one.scores, one.labels, one.masks, strict=True
        )
        if label in numbers
        and not (of_masks and _is_unmasked(labelled.pictures[i], numbers[label], box))
    ]


def _is_unmasked(picture: LabelledPicture, label: int, box_px: Floats) -> bool:
    """Whether a detection is on an object of its class without an annotated mask."""
    bare = [one.box_px for one in picture.objects if one.label == label and one.mask is None]
    return bool(bare) and bool((box_ious(box_px, np.array(bare)) >= HALF).any())


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
    return {
        name: concatenate_verdicts(
            [
                _judged_in(picture, detections, label, name)
                for picture, detections in zip(labelled.pictures, found, strict=True)
            ]
        )
        for label, name in enumerate(labelled.classes)
    }


def _judged_in(picture: LabelledPicture, found: Detections, label: int, name: str) -> Verdicts:
    truth = [one for one in picture.objects if one.label == label]
    counts = np.array([_counts(one) for one in truth], np.bool_)
    boxes_px = np.array([one.box_px for one in truth], np.float64).reshape(-1, 4)
    rows = np.flatnonzero(np.array(found.labels) == name)
    rows = rows[np.argsort(-found.scores[rows], kind="stable")]
    return match_boxes(found.boxes_px[rows], found.scores[rows], boxes_px, OVERLAP, counts)


def _counts(one: TrainingObject) -> bool:
    if one.mask is None:
        x0, y0, x1, y1 = one.box_px
        return not one.is_crowd and (x1 - x0) * (y1 - y0) >= MIN_AREA_PX
    return not one.is_crowd and (
        not isinstance(one.mask, bytes) or area_px(one.mask) >= MIN_AREA_PX
    )


def fitted(rows: Verdicts) -> Calibration:
    """Fit the calibration of one class."""
    right = int(rows.is_right.sum())
    if min(right, len(rows.is_right) - right) < MIN_ROWS:
        return Calibration()
    found = fit_platt(rows.scores, rows.is_right)
    return Calibration(slope=found.slope, offset=found.offset)
