"""Table of all box layouts."""

from typing import Final, TypeAlias, get_args

from .base import BoxOutput
from .darknet import DarknetOutput
from .detr import DetrOutput
from .end_to_end import EndToEndOutput
from .fastestdet import FastestDetOutput
from .nanodet import NanodetOutput
from .nms_tables import EfficientNmsOutput, MmdeployOutput, YoloV7NmsOutput
from .paddle import PaddleNmsOutput, PpYoloeOutput
from .picodet import PicodetOutput
from .ssd import DetectionOutput, SsdScoresOutput, TensorflowSsdOutput
from .torchvision_export import TorchvisionOutput
from .yolo import YoloV5Output, YoloV8Output, YoloV8SegOutput
from .yolo_fastestv2 import YoloFastestV2Output
from .yolo_nas import YoloNasOutput
from .yolox import YoloxOutput

AnyBoxOutput: TypeAlias = (
    YoloxOutput
    | YoloV5Output
    | YoloV8Output
    | YoloV8SegOutput
    | EndToEndOutput
    | DetrOutput
    | YoloNasOutput
    | TorchvisionOutput
    | PicodetOutput
    | NanodetOutput
    | FastestDetOutput
    | YoloFastestV2Output
    | PpYoloeOutput
    | PaddleNmsOutput
    | YoloV7NmsOutput
    | MmdeployOutput
    | EfficientNmsOutput
    | DarknetOutput
    | TensorflowSsdOutput
    | DetectionOutput
    | SsdScoresOutput
)

# Decoders, in the order in which ``crosscue model init`` lists candidates.
DECODERS: Final[tuple[type[BoxOutput], ...]] = get_args(AnyBoxOutput)
