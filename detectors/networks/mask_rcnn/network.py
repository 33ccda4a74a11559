"""Mask R-CNN networks: torchvision's with a ResNet-50, and a compact one for a CPU.

The compact network has a small residual backbone with three levels (strides 8, 16, 32), 64
channels throughout the pyramid, and small heads. It has 3 million parameters and was trained from
scratch on a CPU.
"""

from __future__ import annotations

from collections import OrderedDict
from typing import Annotated, Any, Final, Literal

import torch
from pydantic import Field, model_validator
from torch import Tensor, nn
from torch.nn import functional

from crosscue.detectors.settings import Proportion, Settings

Architecture = Literal["compact", "resnet50", "resnet50-v2"]
# Number of channels of the compact network's pyramid and heads.
CHANNELS: Final = 64
MEAN: Final = (0.485, 0.456, 0.406)
# Mean and standard deviation of red, green and blue, as torchvision's weights expect them.
SPREAD: Final = (0.229, 0.224, 0.225)
# Multiple to which pictures are padded, as in torchvision.
STRIDE: Final = 32
ANCHORS_PX: Final = ((6, 11), (20, 36), (64, 112), (176, 288))
# Height over width of the anchors: a car from the side, a sign, an upright light.
ASPECTS: Final = (0.45, 1.0, 2.6)
# Number of boxes per level before suppression; torchvision's default.
MAX_BEFORE_SUPPRESSION: Final = 1000


class NetworkPlan(Settings):
    """Architecture and input of a network.

    Attributes:
        architecture: Name of the architecture.
        classes: Names of the classes, without the background; None for unused numbers.
        width_px: Width to which pictures are scaled.
        top: Fraction of the picture's height to crop at the top.
        bottom: Fraction of the picture's height to crop at the bottom.
    """

    architecture: Architecture
    classes: Annotated[tuple[str | None, ...], Field(min_length=1, max_length=1000, strict=False)]
    width_px: Annotated[int, Field(ge=64, le=4096)]
    top: Proportion = 0.0
    bottom: Proportion = 0.0

    @model_validator(mode="after")
    def _something_is_left(self) -> NetworkPlan:
        if self.top + self.bottom > 0.9:
            raise ValueError("top and bottom leave less than a tenth of the picture")
        return self


def build_network(plan: NetworkPlan) -> Any:
    """Build a torchvision ``MaskRCNN`` with random weights.

    Nothing is fetched. ``set_limits`` sets the number of proposals and the minimum score.
    """
    from torchvision.models import detection

    classes = len(plan.classes) + 1
    if plan.architecture == "compact":
        return _compact(classes)
    make = {
        "resnet50": detection.maskrcnn_resnet50_fpn,
        "resnet50-v2": detection.maskrcnn_resnet50_fpn_v2,
    }[plan.architecture]
    return make(weights=None, weights_backbone=None, num_classes=classes)


def set_limits(network: Any, proposals: int, score: float, objectness: float = 0.0) -> None:
    """Set the number of proposals and the minimum score of a detection.

    Boxes below the score do not reach the mask head, so a higher score also saves time.

    Args:
        network: A torchvision ``MaskRCNN``.
        proposals: Maximum number of proposals per picture.
        score: Minimum score of a detection, from 0 to 1.
        objectness: Minimum objectness of a proposal, from 0 to 1. Torchvision's default is 0, so
            that most of its 1000 proposals are background.
    """
    rpn, heads = network.rpn, network.roi_heads
    before = max(proposals, min(3 * proposals, MAX_BEFORE_SUPPRESSION))
    rpn._pre_nms_top_n = {**rpn._pre_nms_top_n, "testing": before}
    rpn._post_nms_top_n = {**rpn._post_nms_top_n, "testing": proposals}
    rpn.score_thresh = objectness
    heads.score_thresh = score


def _compact(classes: int) -> Any:
    from torchvision.models.detection import MaskRCNN
    from torchvision.models.detection.faster_rcnn import TwoMLPHead
    from torchvision.models.detection.mask_rcnn import MaskRCNNHeads, MaskRCNNPredictor
    from torchvision.models.detection.rpn import AnchorGenerator
    from torchvision.ops import MultiScaleRoIAlign

    levels = ["0", "1", "2"]
    return MaskRCNN(
        CompactBackbone(),
        num_classes=None,
        rpn_anchor_generator=AnchorGenerator(ANCHORS_PX, (ASPECTS,) * len(ANCHORS_PX)),
        rpn_pre_nms_top_n_train=400,
        rpn_post_nms_top_n_train=200,
        rpn_pre_nms_top_n_test=300,
        rpn_post_nms_top_n_test=100,
        rpn_batch_size_per_image=128,
        box_roi_pool=MultiScaleRoIAlign(levels, output_size=7, sampling_ratio=2),
        box_head=TwoMLPHead(CHANNELS * 49, 256),
        box_predictor=_BoxPredictor(256, classes),
        box_batch_size_per_image=64,
        mask_roi_pool=MultiScaleRoIAlign(levels, output_size=14, sampling_ratio=2),
        mask_head=MaskRCNNHeads(CHANNELS, (CHANNELS, CHANNELS), 1),
        mask_predictor=MaskRCNNPredictor(CHANNELS, CHANNELS, classes),
    )


class _BoxPredictor(nn.Module):
    """Predicts class scores and one box per class."""

    def __init__(self, inputs: int, classes: int) -> None:
        super().__init__()
        self.cls_score = nn.Linear(inputs, classes)
        self.bbox_pred = nn.Linear(inputs, 4 * classes)

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        return self.cls_score(x), self.bbox_pred(x)


class CompactBackbone(nn.Module):
    """Maps pictures (N, 3, H, W) to levels of 64 channels at strides 8, 16, 32 and 64."""

    def __init__(self) -> None:
        """Random weights."""
        from torchvision.ops import FeaturePyramidNetwork
        from torchvision.ops.feature_pyramid_network import LastLevelMaxPool

        super().__init__()
        self.out_channels = CHANNELS
        self.stem = nn.Sequential(_conv(3, 16, 2), _conv(16, 32, 2), Residual(32, 32, 1))
        self.level0 = nn.Sequential(Residual(32, 64, 2), Residual(64, 64, 1))
        self.level1 = nn.Sequential(Residual(64, 128, 2), Residual(128, 128, 1))
        self.level2 = nn.Sequential(Residual(128, 192, 2), Residual(192, 192, 1))
        self.pyramid = FeaturePyramidNetwork(
            [64, 128, 192], CHANNELS, LastLevelMaxPool(), norm_layer=nn.BatchNorm2d
        )

    def forward(self, pictures: Tensor) -> OrderedDict[str, Tensor]:
        """Return all levels, finest first."""
        fine = self.level0(self.stem(pictures))
        middle = self.level1(fine)
        coarse = self.level2(middle)
        levels: OrderedDict[str, Tensor] = self.pyramid(
            OrderedDict([("0", fine), ("1", middle), ("2", coarse)])
        )
        return levels


class Residual(nn.Module):
    """Two 3 x 3 convolutions with a shortcut connection (He et al. 2016, fig. 2)."""

    def __init__(self, inputs: int, outputs: int, stride: int) -> None:
        """Random weights."""
        super().__init__()
        self.first = _conv(inputs, outputs, stride)
        self.second = nn.Sequential(
            nn.Conv2d(outputs, outputs, 3, padding=1, bias=False), nn.BatchNorm2d(outputs)
        )
        self.short_cut = (
            nn.Identity()
            if stride == 1
            else nn.Sequential(
                nn.AvgPool2d(2, ceil_mode=True),
                nn.Conv2d(inputs, outputs, 1, bias=False),
                nn.BatchNorm2d(outputs),
            )
        )

    def forward(self, x: Tensor) -> Tensor:
        """Return features of the same size, or half of it with a stride."""
        sum_of_both = self.second(self.first(x))
        sum_of_both += self.short_cut(x)
        return functional.relu_(sum_of_both)


def _conv(inputs: int, outputs: int, stride: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False),
        nn.BatchNorm2d(outputs),
        nn.ReLU(inplace=True),
    )


def freeze_masks(network: Any, *, is_frozen: bool) -> None:
    """Exclude the mask head from training, or include it again."""
    for part in (network.roi_heads.mask_head, network.roi_heads.mask_predictor):
        part.requires_grad_(not is_frozen)


def forward_training(network: Any, pictures: Tensor, targets: list[dict[str, Tensor]]) -> Tensor:
    """Compute the sum of all losses of a batch of normalised pictures (N, 3, H, W) of one size.

    Torchvision's own transform is not used, because it would scale the pictures again. Its code for
    regions is repeated here, because its mask loss requires a mask of every object.

    Args:
        network: A torchvision ``MaskRCNN``; there is no mask loss if ``freeze_masks`` froze it.
        pictures: The batch.
        targets: ``boxes``, ``labels``, ``masks`` and ``has_mask`` of each picture.
    """
    from torchvision.models.detection.image_list import ImageList
    from torchvision.models.detection.roi_heads import fastrcnn_loss

    size = (int(pictures.shape[2]), int(pictures.shape[3]))
    sizes = [size] * len(pictures)
    features = network.backbone(pictures)
    proposals, of_proposals = network.rpn(ImageList(pictures, sizes), features, targets)
    heads = network.roi_heads
    proposals, matched, labels, offsets = heads.select_training_samples(proposals, targets)
    regions = heads.box_head(heads.box_roi_pool(features, proposals, sizes))
    losses = [
        *of_proposals.values(),
        *fastrcnn_loss(*heads.box_predictor(regions), labels, offsets),
    ]
    if next(heads.mask_predictor.parameters()).requires_grad:
        losses.append(_mask_loss(heads, features, proposals, matched, labels, sizes, targets))
    return torch.stack(losses).sum()


def _mask_loss(
    heads: Any,
    features: Any,
    proposals: list[Tensor],
    matched: list[Tensor],
    labels: list[Tensor],
    sizes: list[tuple[int, int]],
    targets: list[dict[str, Tensor]],
) -> Tensor:
    """Compute the mask loss over the regions on objects that have a mask."""
    from torchvision.models.detection.roi_heads import maskrcnn_loss

    learnt = [
        # A picture without objects has only background regions and cannot be indexed.
        torch.where((label > 0) & target["has_mask"][index])[0]
        if len(target["has_mask"])
        else torch.where(label > 0)[0]
        for label, index, target in zip(labels, matched, targets, strict=True)
    ]
    regions = [part[rows] for part, rows in zip(proposals, learnt, strict=True)]
    objects = [part[rows] for part, rows in zip(matched, learnt, strict=True)]
    pooled = heads.mask_roi_pool(features, regions, sizes)
    loss: Tensor = maskrcnn_loss(
        heads.mask_predictor(heads.mask_head(pooled)),
        regions,
        [target["masks"] for target in targets],
        [target["labels"] for target in targets],
        objects,
    )
    return loss
