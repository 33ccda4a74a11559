"""Mask R-CNN in parts: layers run in a back end, the rest in torchvision.

A back end computes the pyramid and proposal scores of the picture, the box head and the mask head.
Proposals, pooling and suppression are common to all back ends: torchvision's functions, or faster
ones on a CPU that return the same boxes.

Suppression on a CPU has the result of torchvision's ``RegionProposalNetwork.filter_proposals``,
which compares every box of a level with all that follow it; ours stops at the requested number of
boxes. Pooling (RoIAlign; He et al. 2017) has that of ``MultiScaleRoIAlign``; the channels of a cell
are adjacent in memory and interpolated together, which is several times as fast.
"""

from collections import OrderedDict
from collections.abc import Callable, Sequence
from typing import Any, Final, NamedTuple, Protocol

import cv2
import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray
from torch import Tensor

from .network import MEAN, SPREAD

Grid = NDArray[np.float32]
# Value added to a level before it is rounded down, as in torchvision.
_ROUNDING: Final = 1e-6


class Pooler:
    """Pools boxes of the pictures of one batch."""

    def __init__(self, levels: Sequence[Tensor], height_px: int) -> None:
        """Rearrange the levels in memory.

        Args:
            levels: Features (N, channels, H, W) on a CPU, finest first.
            height_px: Height of the pictures.
        """
        self._levels: Final = [level.permute(0, 2, 3, 1).contiguous().numpy() for level in levels]
        self._halvings: Final = [
            round(float(np.log2(height_px / level.shape[1]))) for level in self._levels
        ]

    def __call__(self, pool: Any, boxes: Sequence[Tensor]) -> Tensor:
        """Pool all boxes, in order of pictures; shape (M, channels, side, side), channels last.

        Args:
            pool: A ``MultiScaleRoIAlign``, whose sizes are used.
            boxes: Boxes of each picture, shape (M, 4), in pixels.
        """
        every = torch.cat(list(boxes))
        pictures = np.repeat(np.arange(len(boxes)), [len(of_one) for of_one in boxes])
        side = int(pool.output_size[0])
        pooled = np.empty((len(every), side, side, self._levels[0].shape[3]), np.float32)
        wanted = self._levels_of(every, pool)
        for number, (level, halvings) in enumerate(zip(self._levels, self._halvings, strict=True)):
            rows = np.flatnonzero(wanted == number)
            if rows.size:
                _pool(
                    level,
                    np.float32(0.5**halvings),
                    every.numpy(),
                    pictures,
                    rows,
                    int(pool.sampling_ratio),
                    pooled,
                )
        return torch.from_numpy(pooled).permute(0, 3, 1, 2)

    def _levels_of(self, boxes: Tensor, pool: Any) -> NDArray[np.int64]:
        """Level of each box; larger boxes use coarser levels (Lin et al. 2017, eq. 1)."""
        width, height = boxes[:, 2] - boxes[:, 0], boxes[:, 3] - boxes[:, 1]
        size = torch.sqrt(width * height) / pool.canonical_scale
        exact = torch.floor(pool.canonical_level + torch.log2(size) + _ROUNDING)
        kept = exact.clamp(self._halvings[0], self._halvings[-1]) - self._halvings[0]
        return np.asarray(kept.nan_to_num(nan=0.0).long().numpy(), np.int64)


@njit(cache=True)
def _places(
    start: np.float32,
    cell: np.float32,
    samples: int,
    size: int,
    low: NDArray[np.int64],
    high: NDArray[np.int64],
    fraction: Grid,
) -> None:
    """Compute each sample's neighbouring cells in a row, and its distance from the lower one.

    The lower cell is -1 if a sample is more than one cell outside.
    """
    for i in range(low.size):
        # Summed in torchvision's order, for the same rounding.
        at = start + np.float32(i // samples) * cell
        at += (np.float32(i % samples) + np.float32(0.5)) * cell / np.float32(samples)
        # Negated so that NaN counts as outside.
        if not (at >= np.float32(-1.0) and at <= np.float32(size)):
            low[i] = -1
            continue
        at = max(at, np.float32(0.0))
        low[i] = min(np.int64(at), np.int64(size - 1))
        high[i] = min(low[i] + 1, np.int64(size - 1))
        fraction[i] = at - np.float32(low[i]) if low[i] < size - 1 else np.float32(0.0)


@njit(cache=True, fastmath={"contract"})
def _add(
    into: Grid,
    corners: tuple[Grid, Grid, Grid, Grid],
    weights: tuple[np.float32, np.float32, np.float32, np.float32],
) -> None:
    a, b, c, d = corners
    of_a, of_b, of_c, of_d = weights
    for i in range(into.size):
        into[i] += of_a * a[i] + of_b * b[i] + of_c * c[i] + of_d * d[i]


@njit(cache=True)
def _pool(
    level: Grid,
    scale: np.float32,
    boxes: Grid,
    pictures: NDArray[np.int64],
    rows: NDArray[np.int64],
    samples: int,
    pooled: Grid,
) -> None:
    _, height, width, channels = level.shape
    side = pooled.shape[1]
    count, one = side * samples, np.float32(1.0)
    left, right, top, bottom = np.empty((4, count), np.int64)
    of_right, of_bottom = np.empty((2, count), np.float32)
    for row in rows:
        box, picture = boxes[row] * scale, level[pictures[row]]
        cell_x = max(box[2] - box[0], one) / np.float32(side)
        cell_y = max(box[3] - box[1], one) / np.float32(side)
        _places(box[0], cell_x, samples, width, left, right, of_right)
        _places(box[1], cell_y, samples, height, top, bottom, of_bottom)
        cells = pooled[row].reshape(side * side, channels)
        cells[:] = np.float32(0.0)
        for y in range(count):
            if top[y] < 0:
                continue
            upper, lower, v = picture[top[y]], picture[bottom[y]], of_bottom[y]
            for x in range(count):
                if left[x] < 0:
                    continue
                u = of_right[x]
                _add(
                    cells[y // samples * side + x // samples],
                    (upper[left[x]], upper[right[x]], lower[left[x]], lower[right[x]]),
                    ((one - v) * (one - u), (one - v) * u, v * (one - u), v * u),
                )
        cells *= one / np.float32(samples * samples)


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
    count, height, width, _ = pictures.shape
    planes = np.empty((count, 3, height, width), np.float32)
    for picture, into in zip(pictures, planes, strict=True):
        for colour, plane in enumerate(reversed(cv2.split(picture))):
            cv2.LUT(plane, table[colour], into[colour])
    return planes
