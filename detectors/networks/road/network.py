"""A small road segmentation network: an encoder and decoder of separable convolutions.

The embedded weights were trained on simulated scenes only (``crosscue train road``). The setting
``checkpoint`` selects other weights.
"""

from pathlib import Path
from typing import Any, Final

import torch
from torch import Tensor, nn
from torch.nn import functional

from crosscue.detectors.weights_file import embedded

# Number of channels at 1/2, 1/4, 1/8 and 1/16 of the input's size.
WIDTHS: Final = (16, 32, 64, 96)
DILATIONS: Final = (1, 2, 4, 1)


class _Separable(nn.Module):
    """A separable convolution, residual where its shape permits: 3 x 3 per channel, then a mix."""

    def __init__(self, given: int, made: int, stride: int = 1, dilation: int = 1) -> None:
        super().__init__()
        self.alone = nn.Conv2d(
            given, given, 3, stride, dilation, dilation, groups=given, bias=False
        )
        self.norm_alone = nn.BatchNorm2d(given)
        self.mix = nn.Conv2d(given, made, 1, bias=False)
        self.norm = nn.BatchNorm2d(made)
        self._adds = stride == 1 and given == made

    def forward(self, x: Tensor) -> Tensor:
        """Return features of the same size, or half of it with a stride."""
        y = functional.relu(self.norm_alone(self.alone(x)))
        y = self.norm(self.mix(y))
        return functional.relu(x + y if self._adds else y)


class RoadNetwork(nn.Module):
    """Maps blue, green, red in [0, 1], (N, 3, H, W), to a logit of road per pixel, (N, H, W)."""

    def __init__(self) -> None:
        """Initialise random weights."""
        super().__init__()
        half, quarter, eighth, deep = WIDTHS
        self.stem = nn.Sequential(
            nn.Conv2d(3, half, 3, 2, 1, bias=False), nn.BatchNorm2d(half), nn.ReLU()
        )
        self.quarter = nn.Sequential(_Separable(half, quarter, 2), _Separable(quarter, quarter))
        self.eighth = nn.Sequential(
            _Separable(quarter, eighth, 2), _Separable(eighth, eighth), _Separable(eighth, eighth)
        )
        self.deep = nn.Sequential(
            _Separable(eighth, deep, 2), *(_Separable(deep, deep, 1, d) for d in DILATIONS)
        )
        self.whole = nn.Conv2d(deep, deep, 1)
        self.to_eighth = nn.Conv2d(deep, eighth, 1)
        self.at_eighth = _Separable(eighth, eighth)
        self.to_quarter = nn.Conv2d(eighth, quarter, 1)
        self.at_quarter = _Separable(quarter, quarter)
        self.to_half = nn.Conv2d(quarter, half, 1)
        self.at_half = _Separable(half, half)
        self.last = nn.Conv2d(half, 1, 3, 1, 1)

    def forward(self, pictures: Tensor) -> Tensor:
        """Return logits at the pictures' size."""
        half = self.stem(pictures - 0.45)
        quarter = self.quarter(half)
        eighth = self.eighth(quarter)
        deep = self.deep(eighth)
        # Features of the whole picture, above all its lighting, shift all pixels equally.
        deep = deep + self.whole(deep.mean(dim=(2, 3), keepdim=True))
        eighth = self.at_eighth(eighth + _grown(self.to_eighth(deep), eighth))
        quarter = self.at_quarter(quarter + _grown(self.to_quarter(eighth), quarter))
        half = self.at_half(half + _grown(self.to_half(quarter), half))
        logits: Tensor = _grown(self.last(half), pictures)[:, 0]
        return logits


def _grown(small: Tensor, like: Tensor) -> Tensor:
    return functional.interpolate(small, like.shape[-2:], mode="bilinear", align_corners=False)


def embedded_road() -> Path:
    """Path of the checkpoint that is part of crosscue."""
    return embedded("road.safetensors")


def logits_of(network: Any, pictures: Tensor) -> Tensor:
    """Road logits of (N, H, W, 3) uint8 pictures in blue, green, red."""
    given = pictures.permute(0, 3, 1, 2).to(dtype=torch.float32) / 255.0
    logits: Tensor = network(given.contiguous(memory_format=torch.channels_last))
    return logits
