"""Network outputs of every layout that encode one known box in an input that is not square."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from crosscue.detectors.decoders.base import Array

SIZE = (640, 320)
BOX = np.array([100.0, 40.0, 220.0, 140.0])
CLASSES = ("person", "car", "stop sign")
SCORE = 0.75
CLASS = 2


@dataclass(frozen=True)
class Sample:
    """Outputs that encode ``BOX`` of class ``CLASS`` with ``SCORE``; all other scores are lower."""

    settings: dict[str, Any]
    outputs: dict[str, Array]
    is_masked: bool = False
    input_shape: tuple[int, ...] = (1, 3, SIZE[1], SIZE[0])


def _centered(unit: bool = False) -> list[float]:
    x0, y0, x1, y1 = BOX / (np.tile(SIZE, 2) if unit else 1.0)
    return [(x0 + x1) / 2, (y0 + y1) / 2, x1 - x0, y1 - y0]


def _scores() -> list[float]:
    return [0.1, 0.2, SCORE]


def _logit(p: float) -> float:
    return float(np.log(p / (1 - p)))


def _yolox() -> Sample:
    strides = (8, 16, 32)
    rows = np.zeros((1, sum(SIZE[0] * SIZE[1] // s**2 for s in strides), 8))
    # The cell of stride 16 in column 10 and row 5, after 40 * 80 cells of stride 8.
    cell = 80 * 40 + 5 * 40 + 10
    x, y, w, h = _centered()
    rows[0, cell] = [x / 16 - 10, y / 16 - 5, np.log(w / 16), np.log(h / 16), 1.0, *_scores()]
    return Sample({"kind": "yolox"}, {"output": rows})


def _yolov5() -> Sample:
    # Three anchors in each cell of strides 8, 16 and 32.
    rows = np.zeros((1, 3 * (80 * 40 + 40 * 20 + 20 * 10), 8))
    rows[0, 7] = [*_centered(), 0.5, 0.0, 0.1, SCORE * 2]
    return Sample({"kind": "yolov5", "name": "output0"}, {"output0": rows})


def _yolov8() -> Sample:
    columns = np.zeros((1, 7, 50))
    columns[0, :, 30] = [*_centered(), *_scores()]
    return Sample({"kind": "yolov8", "name": "output0"}, {"output0": columns})


def _prototypes() -> Array:
    """32 masks at a quarter of the input's size; the first covers the box's left half."""
    masks = np.full((1, 32, SIZE[1] // 4, SIZE[0] // 4), -9.0)
    masks[0, 0, :, : int(BOX[[0, 2]].mean()) // 4] = 9.0
    return masks


def _yolov8_seg() -> Sample:
    columns = np.zeros((1, 7 + 32, 50))
    columns[0, :8, 30] = [*_centered(), *_scores(), 1.0]
    return Sample(
        {"kind": "yolov8-seg", "name": "output0", "prototypes": "output1"},
        {"output0": columns, "output1": _prototypes()},
        is_masked=True,
    )


def _end_to_end() -> Sample:
    rows = np.zeros((1, 300, 6))
    rows[0, 0] = [*BOX, SCORE, CLASS]
    return Sample({"kind": "end-to-end", "name": "output0"}, {"output0": rows})


def _detr() -> Sample:
    boxes, logits = np.zeros((1, 100, 4)), np.full((1, 100, 3), -9.0)
    boxes[0, 3] = _centered(unit=True)
    logits[0, 3] = [_logit(p) for p in _scores()]
    return Sample(
        {"kind": "detr", "boxes": "dets", "logits": "labels"}, {"dets": boxes, "labels": logits}
    )


def _yolo_nas() -> Sample:
    cells = sum(SIZE[0] * SIZE[1] // s**2 for s in (8, 16, 32))
    boxes, scores = np.zeros((1, cells, 4)), np.zeros((1, cells, 3))
    boxes[0, 3], scores[0, 3] = BOX, _scores()
    return Sample(
        {"kind": "yolo-nas", "boxes": "904", "scores": "913"}, {"904": boxes, "913": scores}
    )


def _torchvision() -> Sample:
    masks = np.zeros((2, 1, SIZE[1], SIZE[0]))
    masks[0, 0, :, : int(BOX[[0, 2]].mean())] = 0.9
    return Sample(
        {"kind": "torchvision", "masks": "masks"},
        {
            "boxes": np.array([BOX, BOX + 1]),
            "labels": np.array([CLASS + 1, 1]),
            "scores": np.array([SCORE, 0.05]),
            "masks": masks,
        },
        is_masked=True,
        input_shape=(3, SIZE[1], SIZE[0]),
    )


def _picodet() -> Sample:
    strides, outputs = (8, 16, 32, 64), {}
    for i, s in enumerate(strides):
        count = -(-SIZE[0] // s) * -(-SIZE[1] // s)
        outputs[f"s{i}"] = np.zeros((1, count, 3))
        outputs[f"d{i}"] = np.zeros((1, count, 32))
    # Cell (7, 4) of stride 16 has its middle at (120, 72): 20, 32, 100 and 68 px to the sides.
    cell = 4 * 40 + 7
    outputs["s1"][0, cell] = _scores()
    distances = np.array([20.0, 32.0, 100.0, 68.0]) / 16
    for side, distance in enumerate(distances):
        low = int(distance)
        weights = np.full(8, 1e-12)
        weights[low], weights[low + 1] = low + 1 - distance, max(distance - low, 1e-12)
        outputs["d1"][0, cell, 8 * side : 8 * side + 8] = np.log(weights)
    names = [f"{kind}{i}" for kind in "sd" for i in range(4)]
    return Sample(
        {"kind": "picodet", "scores": tuple(names[:4]), "distances": tuple(names[4:])},
        {name: outputs[name] for name in names},
    )


def _ssd_tensorflow() -> Sample:
    x0, y0, x1, y1 = BOX / np.tile(SIZE, 2)
    return Sample(
        {"kind": "ssd-tensorflow"},
        {
            "detection_boxes": np.array([[[y0, x0, y1, x1], [0.0, 0.0, 0.0, 0.0]]]),
            "detection_classes": np.array([[CLASS + 1.0, 0.0]]),
            "detection_scores": np.array([[SCORE, 0.0]]),
        },
    )


def _ssd() -> Sample:
    rows = np.full((1, 1, 200, 7), -1.0)
    rows[0, 0, 0] = [0, CLASS + 1, SCORE, *(BOX / np.tile(SIZE, 2))]
    return Sample({"kind": "ssd", "name": "detection_out"}, {"detection_out": rows})


SAMPLES = {
    "yolox": _yolox,
    "yolov5": _yolov5,
    "yolov8": _yolov8,
    "yolov8-seg": _yolov8_seg,
    "end-to-end": _end_to_end,
    "detr": _detr,
    "yolo-nas": _yolo_nas,
    "torchvision": _torchvision,
    "picodet": _picodet,
    "ssd-tensorflow": _ssd_tensorflow,
    "ssd": _ssd,
}
