"""YOLO-NAS's raw export: recognised from its shapes, its boxes exact in wide and tall inputs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import crosscue
from crosscue.detectors.base import Detections, Frame
from crosscue.detectors.decoders.base import cell_count
from crosscue.detectors.networks.model_detector import build
from support.onnx_models import constant_model

CLASSES = ["person", "car", "stop sign"]
# Two boxes in pixels of the network's input, for a car and a stop sign.
BOXES = np.array([[16.0, 40.0, 80.0, 100.0], [100.0, 20.0, 125.0, 90.0]])


@pytest.mark.parametrize("is_swapped", [False, True], ids=["boxes first", "scores first"])
@pytest.mark.parametrize("size", [(320, 128), (128, 320)], ids=["wide", "tall"])
def test_boxes_are_exact(tmp_path: Path, size: tuple[int, int], *, is_swapped: bool) -> None:
    width, height = size
    cells = cell_count(size, (8, 16, 32))
    boxes = np.zeros((1, cells, 4), np.float32)
    scores = np.full((1, cells, 3), 0.01, np.float32)
    boxes[0, [5, 700]], scores[0, 5, 1], scores[0, 700, 2] = BOXES, 0.75, 0.5
    outputs = {"913": scores, "904": boxes} if is_swapped else {"904": boxes, "913": scores}
    (tmp_path / "nas.onnx").write_bytes(constant_model((1, 3, height, width), outputs))

    card = crosscue.draft_card(tmp_path / "nas.onnx", class_names=CLASSES)
    # The picture is twice the input, so that it has no margin.
    pixels = np.zeros((2 * height, 2 * width, 3), np.uint8)
    (found,) = build(card=str(card.path))([Frame(0, "", pixels, (2 * width, 2 * height))])

    assert card.draft.kind == "yolo-nas"
    assert isinstance(found, Detections)
    np.testing.assert_allclose(found.boxes_px, 2.0 * BOXES, atol=1e-9)
    np.testing.assert_allclose(found.scores, [0.75, 0.5])
    assert found.labels == ("car", "stop sign")
