"""Non-maximum suppression of a picture's proposals on a CPU.

The result is that of torchvision's ``RegionProposalNetwork.filter_proposals``, which compares every
box of a level with all that follow it. This implementation stops at the requested number of boxes.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray
from torch import Tensor

Boxes = NDArray[np.float32]
# Number of boxes up to which torchvision separates levels by offsets, with other rounding.
FEW: Final = 1000


def likeliest_apart(
    rpn: Any, boxes: Tensor, logits: Tensor, levels: NDArray[np.int64], size_px: tuple[int, int]
) -> Tensor:
    """Select the proposals of one picture, best first, shape (M, 4).

    Args:
        rpn: Region proposal network, whose limits are used.
        boxes: Shape (N, 4), in pixels; clipped to the picture here.
        logits: Shape (N,): objectness.
        levels: Shape (N,): boxes of different levels do not suppress each other.
        size_px: Height and width of the picture.
    """
    from torchvision.ops import boxes as box_ops

    inside = box_ops.clip_boxes_to_image(boxes, size_px).float().numpy()
    likely = torch.sigmoid(logits.float()).numpy()
    sides = inside[:, 2:] - inside[:, :2]
    usable = np.flatnonzero((sides >= rpn.min_size).all(1) & (likely >= rpn.score_thresh))
    order = usable[np.argsort(-likely[usable], kind="stable")]
    ordered = inside[order]
    return torch.from_numpy(
        ordered[_apart(ordered, levels[order], float(rpn.nms_thresh), rpn.post_nms_top_n())]
    )


@njit(cache=True)
def _apart(
    boxes: Boxes, levels: NDArray[np.int64], overlap: float, max_kept: int
) -> NDArray[np.int64]:
    """Rows of sorted boxes that overlap no better box of their level by more than ``overlap``."""
    kept = np.empty(min(max_kept, len(boxes)), np.int64)
    areas = (boxes[:, 2] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 1])
    count = 0
    for i in range(len(boxes)):
        if count == kept.size:
            break
        is_free = True
        for j in kept[:count]:
            if levels[j] != levels[i]:
                continue
            width = min(boxes[i, 2], boxes[j, 2]) - max(boxes[i, 0], boxes[j, 0])
            height = min(boxes[i, 3], boxes[j, 3]) - max(boxes[i, 1], boxes[j, 1])
            if width <= 0.0 or height <= 0.0:
                continue
            common = width * height
            if common / (areas[i] + areas[j] - common) > overlap:
                is_free = False
                break
        if is_free:
            kept[count] = i
            count += 1
    return kept[:count]
