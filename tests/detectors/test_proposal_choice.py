"""Tests of the selection of proposals against torchvision's."""

from __future__ import annotations

import numpy as np
import torch
from hypothesis import given
from hypothesis import strategies as st

from crosscue.detectors.networks.mask_rcnn.network import build_network
from crosscue.detectors.networks.mask_rcnn.nms import likeliest_apart
from support.mask_rcnn import plan_of

SIZE_PX = (96, 128)


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
    rpn = build_network(plan_of()).eval().rpn
    rpn._pre_nms_top_n["testing"], rpn._post_nms_top_n["testing"] = 1000, max_count
    rpn.score_thresh = floor

    ours = likeliest_apart(rpn, boxes, logits, np.repeat(np.arange(len(counts)), counts), SIZE_PX)
    theirs, _ = rpn.filter_proposals(boxes[None], logits[None], [SIZE_PX], counts)

    assert torch.equal(ours, theirs[0])
