"""Boxes: suppression, choice of proposals, pooling and drawn labels."""

import copy
from collections import OrderedDict

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor
from torchvision.ops import MultiScaleRoIAlign

from crosscue.detectors import rle
from crosscue.detectors.base import Detections, Frame
from crosscue.detectors.boxes import box_ious, non_maximum_suppression
from crosscue.detectors.label_images import CLASSES, LabelledObject, label_image, objects
from crosscue.detectors.networks.mask_rcnn.network import build_network
from crosscue.detectors.networks.mask_rcnn.parts import Pooler, likeliest_apart
from support.mask_rcnn import plan_of


def test_suppression_keeps_the_best_of_overlapping_boxes() -> None:
    rng = np.random.default_rng(5)
    corners = rng.uniform(0.0, 60.0, (700, 2))
    boxes = np.hstack([corners, corners + rng.uniform(5.0, 30.0, (700, 2))])
    scores, groups = rng.uniform(0.0, 1.0, 700), rng.integers(0, 3, 700)

    expected: list[int] = []
    for i in np.argsort(-scores):
        rivals = [k for k in expected if groups[k] == groups[i]]
        if scores[i] >= 0.2 and not (box_ious(boxes[i], boxes[rivals]) > 0.45).any():
            expected.append(int(i))

    assert non_maximum_suppression(boxes, scores, groups, 0.2, 0.45).tolist() == expected
    assert not len(non_maximum_suppression(boxes, scores, groups, 2.0, 0.45))


SIZE_PX = (96, 128)
RPN = build_network(plan_of()).eval().rpn


@given(
    st.lists(st.integers(0, 500), min_size=1, max_size=4),
    st.integers(1, 1000),
    st.sampled_from([0.0, 0.3, 0.9]),
    st.integers(0, 1000),
    st.floats(5.0, 60.0),
)
def test_selected_boxes_and_their_order_match_torchvision(
    counts: list[int], max_count: int, floor: float, seed: int, spread_px: float
) -> None:
    rng = np.random.default_rng(seed)
    total = sum(counts)
    middles = rng.uniform(-20.0, 150.0, (total, 2))
    halves = rng.exponential(spread_px / 2.0, (total, 2)) * (rng.random((total, 1)) > 0.1)
    boxes = torch.from_numpy(np.hstack([middles - halves, middles + halves]).astype(np.float32))
    logits = torch.from_numpy(rng.normal(0.0, 2.0, total).astype(np.float32))
    rpn = copy.deepcopy(RPN)
    rpn._pre_nms_top_n["testing"], rpn._post_nms_top_n["testing"] = 1000, max_count
    rpn.score_thresh = floor

    ours = likeliest_apart(rpn, boxes, logits, np.repeat(np.arange(len(counts)), counts), SIZE_PX)
    theirs, _ = rpn.filter_proposals(boxes[None], logits[None], [SIZE_PX], counts)

    assert torch.equal(ours, theirs[0])


HEIGHT_PX, WIDTH_PX = 128, 192


def _levels(strides: tuple[int, ...], pictures: int, channels: int = 3) -> list[Tensor]:
    torch.manual_seed(len(strides))
    return [torch.randn(pictures, channels, HEIGHT_PX // s, WIDTH_PX // s) for s in strides]


Side = st.floats(0.0, 400.0, width=32)
Corner = st.tuples(st.floats(-60.0, 250.0, width=32), st.floats(-60.0, 250.0, width=32))
Boxes = st.lists(st.tuples(Corner, Side, Side), max_size=6)


def _tensor(boxes: list[tuple[tuple[float, float], float, float]]) -> Tensor:
    corners = [(x, y, x + width, y + height) for (x, y), width, height in boxes]
    return torch.tensor(corners, dtype=torch.float32).reshape(-1, 4)


@given(st.sampled_from([(4, 8, 16, 32), (8, 16, 32)]), st.sampled_from([7, 14]), Boxes, Boxes)
def test_pooled_features_match_torchvision(
    strides: tuple[int, ...],
    side: int,
    first: list[tuple[tuple[float, float], float, float]],
    second: list[tuple[tuple[float, float], float, float]],
) -> None:
    levels = _levels(strides, pictures=2)
    names = [str(i) for i in range(len(strides))]
    pool = MultiScaleRoIAlign(names, side, 2)
    boxes = [_tensor(first), _tensor(second)]

    theirs = pool(OrderedDict(zip(names, levels, strict=True)), boxes, [(HEIGHT_PX, WIDTH_PX)] * 2)
    ours = Pooler(levels, HEIGHT_PX)(pool, boxes)

    assert ours.shape == (len(first) + len(second), 3, side, side)
    np.testing.assert_allclose(ours.numpy(), theirs.numpy(), atol=2e-6)


SIZE_PX_IMAGES = (40, 30)


def frame(image: np.ndarray) -> Frame:
    return Frame(7, "camera", np.ascontiguousarray(image[..., ::-1]), SIZE_PX_IMAGES)


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
    np.testing.assert_array_equal(rle.decode_mask(back.masks[0], SIZE_PX_IMAGES)[5:8, 10:12], mask)


def test_black_image_has_no_objects() -> None:
    assert len(found()) == 0
