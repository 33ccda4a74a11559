"""Average precision on annotated pictures, by COCO's rules (pycocotools)."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Final

import numpy as np

from crosscue.detectors.base import Detections, Frame
from crosscue.detectors.boxes import box_ious
from crosscue.detectors.rle import area_px, encode_mask
from crosscue.replay.columns import Floats
from crosscue.replay.errors import UsageError

from .annotations import LabelledPicture, LabelledSet, mask_of
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

    Raises:
        UsageError: pycocotools is not installed.
    """
    try:
        from pycocotools.coco import COCO
        from pycocotools.cocoeval import COCOeval
    except ImportError:
        raise UsageError(
            "average precision needs pycocotools, which is not installed: pip install pycocotools"
        ) from None
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
