"""Tests of RoIAlign against torchvision's, for boxes at any position."""

from __future__ import annotations

from collections import OrderedDict

import numpy as np
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor
from torchvision.ops import MultiScaleRoIAlign

from crosscue.detectors.networks.mask_rcnn.roi_align import Pooler

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
