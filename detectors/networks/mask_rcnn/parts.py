"""Mask R-CNN in parts: layers run in a back end, the rest in torchvision.

A back end computes the pyramid and proposal scores of the picture, the box head and the mask head.
Proposals, pooling and suppression are common to all back ends: torchvision's functions, or faster
ones on a CPU that return the same boxes.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .network import MEAN, SPREAD
from .nms import FEW, likeliest_apart
from .roi_align import Pooler


class Body(NamedTuple):
    """Outputs of a picture's feature pyramid, one tensor per level, finest first.

    Attributes:
        levels: Features, shape (N, channels, H, W).
        objectness: Logits, shape (N, anchors, H, W).
        shifts: Offsets from anchors to boxes, shape (N, 4 * anchors, H, W).
    """

    levels: Sequence[Tensor]
    objectness: Sequence[Tensor]
    shifts: Sequence[Tensor]


class MaskRcnnLayers(Protocol):
    """The layers of a Mask R-CNN in a back end."""

    def body(self, pictures: NDArray[np.uint8], /) -> Body:
        """Run the pyramid on pictures (N, H, W, 3), blue, green, red, padded to the stride."""
        ...

    def boxes(self, pooled: Tensor, /) -> tuple[Tensor, Tensor]:
        """Return class logits and box offsets of pooled proposals (M, channels, 7, 7)."""
        ...

    def masks(self, pooled: Tensor, /) -> Tensor:
        """Return mask logits (M, classes, 28, 28) of pooled boxes (M, channels, 14, 14)."""
        ...


def detected(
    network: Any, parts: MaskRcnnLayers, pictures: NDArray[np.uint8]
) -> list[dict[str, Tensor]]:
    """Detect objects: boxes in pixels of the input, labels, scores and masks (M, 1, 28, 28).

    Masks cover their box only.

    Args:
        network: A torchvision ``MaskRCNN``; its anchors, limits and poolers are used, not its
            layers.
        parts: The layers.
        pictures: Shape (N, H, W, 3), blue, green, red.
    """
    from torchvision.models.detection.roi_heads import maskrcnn_inference

    heads = network.roi_heads
    sizes = [(int(pictures.shape[1]), int(pictures.shape[2]))] * len(pictures)
    body = parts.body(pictures)
    pooled = _pooler(heads, body, sizes)
    proposals = _proposals(network.rpn, body, sizes)
    logits, shifts = parts.boxes(pooled(heads.box_roi_pool, proposals))
    boxes, scores, labels = heads.postprocess_detections(logits, shifts, proposals, sizes)
    if any(len(of_one) for of_one in boxes):
        masks = maskrcnn_inference(parts.masks(pooled(heads.mask_roi_pool, boxes)), labels)
    else:
        masks = [logits.new_zeros((0, 1, 28, 28))] * len(boxes)
    return [
        {"boxes": of_one, "scores": score, "labels": label, "masks": mask}
        for of_one, score, label, mask in zip(boxes, scores, labels, masks, strict=True)
    ]


def _pooler(
    heads: Any, body: Body, sizes: list[tuple[int, int]]
) -> Callable[[Any, list[Tensor]], Tensor]:
    """Return the function that pools boxes: on a CPU ``roi_align``'s, else torchvision's."""
    names = heads.box_roi_pool.featmap_names
    if body.levels[0].device.type == "cpu":
        return Pooler(body.levels[: len(names)], sizes[0][0])
    levels = OrderedDict(zip([*names, "pool"], body.levels, strict=True))
    return lambda pool, boxes: pool(levels, boxes, sizes)


def _proposals(rpn: Any, body: Body, sizes: list[tuple[int, int]]) -> list[Tensor]:
    """Return the proposals of each picture, as ``RegionProposalNetwork.forward`` does.

    Torchvision decodes all anchors and then selects the best of each level. Here they are selected
    first, which yields the same boxes.
    """
    pictures = len(sizes)
    boxes, scores = [], []
    bases = rpn.anchor_generator.cell_anchors
    for logits, shifts, base in zip(body.objectness, body.shifts, bases, strict=True):
        flat = logits.permute(0, 2, 3, 1).reshape(pictures, -1)
        best, at = flat.topk(min(rpn.pre_nms_top_n(), flat.shape[1]), dim=1)
        chosen = _flat_shifts(shifts, logits.shape[1]).gather(1, at[:, :, None].expand(-1, -1, 4))
        anchors = _anchors(base.to(at.device), at.reshape(-1), logits.shape[2:], sizes[0])
        decoded = rpn.box_coder.decode_single(chosen.reshape(-1, 4), anchors)
        boxes.append(decoded.reshape(pictures, -1, 4))
        scores.append(best)
    counts = [of_level.shape[1] for of_level in scores]
    every, likely = torch.cat(boxes, 1), torch.cat(scores, 1)
    if every.device.type == "cpu" and every.shape[1] > FEW:
        levels = np.repeat(np.arange(len(counts)), counts)
        return [
            likeliest_apart(rpn, every[i], likely[i], levels, size) for i, size in enumerate(sizes)
        ]
    kept: list[Tensor]
    kept, _ = rpn.filter_proposals(every, likely, sizes, counts)
    return kept


def _anchors(base: Tensor, at: Tensor, grid: Sequence[int], size_px: tuple[int, int]) -> Tensor:
    """Anchors (M, 4) of a level, by their indices in the order of torchvision's generator.

    Args:
        base: Shape (anchors, 4): anchors of the first cell.
        at: Shape (M,): indices, (row * columns + column) * anchors + anchor.
        grid: Number of rows and columns of cells.
        size_px: Height and width of the picture.
    """
    place, which = at // len(base), at % len(base)
    x = place % grid[1] * (size_px[1] // grid[1])
    y = place // grid[1] * (size_px[0] // grid[0])
    return torch.stack((x, y, x, y), 1) + base[which]


def _flat_shifts(shifts: Tensor, anchors: int) -> Tensor:
    """Reshape (N, 4 * anchors, H, W) to (N, H * W * anchors, 4), in the anchors' order."""
    pictures, _, height, width = shifts.shape
    apart = shifts.view(pictures, anchors, 4, height, width)
    return apart.permute(0, 3, 4, 1, 2).reshape(pictures, -1, 4)


class TorchParts:
    """All parts in torch, on any device."""

    def __init__(self, network: Any, device: torch.device) -> None:
        """Use the layers of a network that is on the device."""
        self._network = network
        self._device = device

    def body(self, pictures: NDArray[np.uint8], /) -> Body:
        """As ``MaskRcnnLayers``."""
        given = as_input(pictures, self._device)
        levels = list(self._network.backbone(given).values())
        objectness, shifts = self._network.rpn.head(levels)
        return Body(levels, objectness, shifts)

    def boxes(self, pooled: Tensor, /) -> tuple[Tensor, Tensor]:
        """As ``MaskRcnnLayers``."""
        heads = self._network.roi_heads
        found: tuple[Tensor, Tensor] = heads.box_predictor(heads.box_head(pooled))
        return found

    def masks(self, pooled: Tensor, /) -> Tensor:
        """As ``MaskRcnnLayers``."""
        heads = self._network.roi_heads
        logits: Tensor = heads.mask_predictor(heads.mask_head(pooled))
        return logits


def as_input(pictures: NDArray[np.uint8], device: torch.device) -> Tensor:
    """Normalise blue, green, red bytes (N, H, W, 3) to a tensor (N, 3, H, W)."""
    mean, spread = (255.0 * torch.tensor(v, device=device)[:, None] for v in (MEAN, SPREAD))
    if device.type == "cpu":
        table = (torch.arange(256.0)[None] - mean) / spread
        return torch.from_numpy(_looked_up(pictures, table.numpy()))
    given = torch.from_numpy(pictures).to(device).flip(3).permute(0, 3, 1, 2).float()
    normal = (given - mean[:, :, None]) / spread[:, :, None]
    return normal.contiguous(memory_format=torch.channels_last)


def _looked_up(pictures: NDArray[np.uint8], table: NDArray[np.float32]) -> NDArray[np.float32]:
    """Planes of red, green and blue, with each byte replaced by its entry in the colour's row."""
    import cv2

    count, height, width, _ = pictures.shape
    planes = np.empty((count, 3, height, width), np.float32)
    for picture, into in zip(pictures, planes, strict=True):
        for colour, plane in enumerate(reversed(cv2.split(picture))):
            cv2.LUT(plane, table[colour], into[colour])
    return planes
