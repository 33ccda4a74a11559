"""Run the layers of a Mask R-CNN in OpenVINO, converted from torch when a detector is built.

The body is compiled for one picture of a fixed size, where OpenVINO is fastest. The heads accept
any number of boxes. All compute in 32 bits, because OpenVINO would use 16 on some processors.
"""

import warnings
from collections import OrderedDict
from importlib import import_module
from typing import Any, Final

import numpy as np
import torch
from torch import Tensor, nn

from crosscue.detectors.networks.backends import Array
from crosscue.detectors.networks.openvino import import_openvino
from crosscue.replay.columns import Bytes
from crosscue.replay.errors import VehicleError, one_line

from .network import MEAN, SPREAD, STRIDE
from .parts import Body

# Maximum number of compiled bodies; a camera has one size, and a drive has few cameras.
KEPT_SIZES: Final = 4


class OpenVinoParts:
    """All parts in OpenVINO on a CPU."""

    def __init__(self, network: Any, threads: int) -> None:
        """Convert a network; the body is compiled when a size first occurs.

        Raises:
            VehicleError: OpenVINO is not installed, or cannot convert this network.
        """
        try:
            self._openvino: Final = import_openvino()
        except ImportError as error:
            raise VehicleError(
                f"detector mask-rcnn: backend openvino: not installed or incomplete ({error}); "
                'pip install openvino, or set backend = "torch"'
            ) from None
        self._core: Final = self._openvino.Core()
        self._asked: Final = {
            "INFERENCE_NUM_THREADS": threads,
            "INFERENCE_PRECISION_HINT": "f32",
            "NUM_STREAMS": 1,
        }
        example = torch.zeros(1, 3, 2 * STRIDE, 2 * STRIDE)
        self._any_size: Final = self._converted(_WholeBody(network), example, [1, 3, -1, -1])
        heads = network.roi_heads
        channels = network.backbone.out_channels
        self._boxes: Final = self._head(
            nn.Sequential(heads.box_head, heads.box_predictor), channels, heads.box_roi_pool
        )
        self._masks: Final = self._head(
            nn.Sequential(heads.mask_head, heads.mask_predictor), channels, heads.mask_roi_pool
        )
        self._bodies: Final[OrderedDict[tuple[int, int], Any]] = OrderedDict()

    def body(self, pictures: Bytes, /) -> Body:
        """As ``Parts``."""
        height, width = pictures.shape[1:3]
        run = self._bodies.pop((height, width), None) or self._body(height, width)
        self._bodies[height, width] = run
        if len(self._bodies) > KEPT_SIZES:
            self._bodies.popitem(last=False)
        each = [_tensors(run, picture[None]) for picture in pictures]
        together = [
            torch.cat(of_all) if len(of_all) > 1 else of_all[0]
            for of_all in zip(*each, strict=True)
        ]
        third = len(together) // 3
        return Body(together[:third], together[third : 2 * third], together[2 * third :])

    def boxes(self, pooled: Tensor, /) -> tuple[Tensor, Tensor]:
        """As ``Parts``."""
        logits, shifts = _tensors(self._boxes, pooled.numpy())
        return logits, shifts

    def masks(self, pooled: Tensor, /) -> Tensor:
        """As ``Parts``."""
        (logits,) = _tensors(self._masks, pooled.numpy())
        return logits

    def _body(self, height: int, width: int) -> Any:
        """Compile the body for one picture, bytes (1, height, width, 3), blue, green, red."""
        ov = self._openvino
        model = self._any_size.clone()
        model.reshape([1, 3, height, width])
        steps: Any = import_module("openvino.preprocess")
        before = steps.PrePostProcessor(model)
        before.input().tensor().set_element_type(ov.Type.u8).set_layout(ov.Layout("NHWC"))
        before.input().tensor().set_color_format(steps.ColorFormat.BGR)
        before.input().model().set_layout(ov.Layout("NCHW"))
        scaled = before.input().preprocess().convert_element_type(ov.Type.f32)
        scaled = scaled.convert_color(steps.ColorFormat.RGB)
        scaled.mean([255.0 * v for v in MEAN]).scale([255.0 * v for v in SPREAD])
        return self._compiled(before.build())

    def _head(self, layers: nn.Module, channels: int, pool: Any) -> Any:
        side = int(pool.output_size[0])
        example = torch.zeros(2, channels, side, side)
        return self._compiled(self._converted(layers, example, [-1, channels, side, side]))

    def _converted(self, layers: nn.Module, example: Tensor, shape: list[int]) -> Any:
        ov = self._openvino
        try:
            with warnings.catch_warnings(), torch.inference_mode():
                # OpenVINO traces with torch.jit, which warns of its deprecation.
                warnings.simplefilter("ignore")
                return ov.convert_model(
                    layers.eval(), example_input=example, input=[ov.PartialShape(shape)]
                )
        except Exception as error:
            why = one_line(error, 200)
            raise VehicleError(
                f"detector mask-rcnn: backend openvino: openvino {ov.__version__} cannot run this "
                f'network ({why}); set backend = "torch"'
            ) from None

    def _compiled(self, model: Any) -> Any:
        return self._core.compile_model(model, "CPU", self._asked).create_infer_request()


class _WholeBody(nn.Module):
    """Backbone, pyramid and region proposal layers as one module."""

    def __init__(self, network: Any) -> None:
        super().__init__()
        self.backbone = network.backbone
        self.head = network.rpn.head

    def forward(self, pictures: Tensor) -> tuple[Tensor, ...]:
        levels = list(self.backbone(pictures).values())
        objectness, shifts = self.head(levels)
        return (*levels, *objectness, *shifts)


def _tensors(request: Any, given: Array) -> list[Tensor]:
    """Run and copy the outputs, in order, so that the next run does not overwrite them."""
    found = request.infer([np.ascontiguousarray(given)], share_inputs=True)
    return [torch.from_numpy(found[i]) for i in range(len(found))]
