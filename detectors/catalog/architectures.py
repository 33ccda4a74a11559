"""Table of torchvision's detection networks: properties that a weights file does not record."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, Literal

# Names of functions of ``torchvision.models.detection``.
ArchitectureName = Literal[
    "maskrcnn_resnet50_fpn",
    "maskrcnn_resnet50_fpn_v2",
    "fasterrcnn_resnet50_fpn",
    "fasterrcnn_resnet50_fpn_v2",
    "fasterrcnn_mobilenet_v3_large_fpn",
    "fasterrcnn_mobilenet_v3_large_320_fpn",
    "retinanet_resnet50_fpn",
    "retinanet_resnet50_fpn_v2",
    "fcos_resnet50_fpn",
    "ssd300_vgg16",
    "ssdlite320_mobilenet_v3_large",
]
WEIGHTS_SUFFIXES: Final = (".pth", ".pt", ".safetensors")


@dataclass(frozen=True, slots=True)
class Architecture:
    """Properties of an architecture that a weights file does not record.

    Attributes:
        size_px: Longest and shortest side to which the network scales pictures; width and height
            if it stretches them.
        head: Name of the tensor whose first axis counts classes.
        per_class: Number of that tensor's rows per class.
        first_class: Number of the first class that a detection can have; 1 where 0 is the
            background.
        is_masked: True if the network returns masks.
        is_frozen: True if training from torchvision's weights keeps the normalisation frozen.
        is_stretched: True if the network scales pictures to one size, regardless of their
            proportions.
    """

    size_px: tuple[int, int]
    head: str
    per_class: int = 1
    first_class: int = 1
    is_masked: bool = False
    is_frozen: bool = False
    is_stretched: bool = False


_BOX_HEAD: Final = "roi_heads.box_predictor.cls_score.weight"
_DENSE_HEAD: Final = "head.classification_head.cls_logits.weight"
_USUAL: Final = (1333, 800)

ARCHITECTURES: Final[Mapping[ArchitectureName, Architecture]] = {
    "maskrcnn_resnet50_fpn": Architecture(_USUAL, _BOX_HEAD, is_masked=True, is_frozen=True),
    "maskrcnn_resnet50_fpn_v2": Architecture(_USUAL, _BOX_HEAD, is_masked=True),
    "fasterrcnn_resnet50_fpn": Architecture(_USUAL, _BOX_HEAD, is_frozen=True),
    "fasterrcnn_resnet50_fpn_v2": Architecture(_USUAL, _BOX_HEAD),
    "fasterrcnn_mobilenet_v3_large_fpn": Architecture(_USUAL, _BOX_HEAD),
    "fasterrcnn_mobilenet_v3_large_320_fpn": Architecture((640, 320), _BOX_HEAD),
    "retinanet_resnet50_fpn": Architecture(
        _USUAL, _DENSE_HEAD, per_class=9, first_class=0, is_frozen=True
    ),
    "retinanet_resnet50_fpn_v2": Architecture(_USUAL, _DENSE_HEAD, per_class=9, first_class=0),
    "fcos_resnet50_fpn": Architecture(_USUAL, _DENSE_HEAD, first_class=0),
    "ssd300_vgg16": Architecture(
        (300, 300), "head.classification_head.module_list.0.weight", per_class=4, is_stretched=True
    ),
    "ssdlite320_mobilenet_v3_large": Architecture(
        (320, 320),
        "head.classification_head.module_list.0.1.weight",
        per_class=6,
        is_stretched=True,
    ),
}
