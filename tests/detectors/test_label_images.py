"""Tests that the detectors of label images recover the drawn objects and road."""

import numpy as np
import pytest

from crosscue.detectors import rle
from crosscue.detectors.base import Detections, Frame
from crosscue.detectors.label_images import CLASSES, LabelledObject, label_image, objects

SIZE_PX = (40, 30)


def frame(image: np.ndarray) -> Frame:
    return Frame(7, "camera", np.ascontiguousarray(image[..., ::-1]), SIZE_PX)


def found(*drawn: LabelledObject) -> Detections:
    (one,) = objects()([frame(label_image(np.zeros((30, 40), np.bool_), drawn))])
    assert isinstance(one, Detections)
    return one


@pytest.mark.parametrize("label", CLASSES)
def test_drawn_object_is_recovered_with_box_mask_and_score(label: str) -> None:
    mask = np.array([[True, False], [True, True], [True, True]])

    back = found(LabelledObject(label, 0.8, (10, 5), mask))

    assert back.labels == (label,)
    assert back.scores[0] == pytest.approx(0.8, abs=1 / 255)
    np.testing.assert_array_equal(back.boxes_px, [[10, 5, 12, 8]])
    np.testing.assert_array_equal(rle.decode_mask(back.masks[0], SIZE_PX)[5:8, 10:12], mask)


def test_black_image_has_no_objects() -> None:
    assert len(found()) == 0
