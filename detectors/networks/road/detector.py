"""The detector ``road``: road pixels by a neural network.

The embedded network was trained on simulated scenes only.

Settings: ``checkpoint``, ``device``, ``probability``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field

from crosscue.detectors import rle
from crosscue.detectors.base import Found, Frame, RoadMask, View
from crosscue.detectors.networks.devices import chosen_device
from crosscue.detectors.settings import Settings, identity_of, settings_of

from .checkpoint import RoadCheckpoint, load_road
from .network import embedded_road, logits_of

# Incremented when the same pixels, weights and settings yield a different mask than before.
VERSION: Final = 1


class RoadSettings(Settings):
    """Settings of the detector ``road``."""

    checkpoint: str | None = None
    """A safetensors file; None for the embedded one."""
    device: Literal["auto", "cpu", "cuda", "mps"] = "auto"
    probability: Annotated[float, Field(gt=0.0, lt=1.0)] = 0.5
    """Probability above which a pixel is road."""


def build(**given: Any) -> RoadNetworkDetector:
    """Build the detector.

    Raises:
        VehicleError: The settings or the checkpoint are invalid.
    """
    settings = settings_of(RoadSettings, given, "detector road")
    path = embedded_road() if settings.checkpoint is None else Path(settings.checkpoint)
    device = chosen_device(settings.device, "detector road")
    checkpoint = load_road(path)
    checkpoint.network.to(device)
    return RoadNetworkDetector(checkpoint, settings, device)


@dataclass(frozen=True, slots=True)
class RoadNetworkDetector:
    """Detector of road pixels, at the network's resolution."""

    checkpoint: RoadCheckpoint
    settings: RoadSettings
    device: torch.device

    @property
    def labels(self) -> tuple[str, ...]:
        """Empty: road is not an object."""
        return ()

    @property
    def view(self) -> View:
        """The resolution of the network's input."""
        return View(min_width_px=self.checkpoint.facts.width_px)

    @property
    def identity(self) -> str:
        """Text that changes with weights, settings and back end."""
        runs = (torch.__version__, self.device.type, self.settings.probability)
        return identity_of("road", VERSION, self.checkpoint.sha256, runs)

    def __call__(self, frames: Sequence[Frame], /) -> Sequence[Found]:
        """Return the road pixels of each frame."""
        if not frames:
            return []
        size = (self.checkpoint.facts.width_px, self.checkpoint.facts.height_px)
        given = np.stack([resize_picture(frame.pixels, size) for frame in frames])
        min_logit = float(np.log(self.settings.probability / (1.0 - self.settings.probability)))
        with torch.inference_mode():
            logits = logits_of(self.checkpoint.network, torch.from_numpy(given).to(self.device))
            road = (logits > min_logit).cpu().numpy()
        return [
            RoadMask(frame.t_ns, frame.size_px, rle.encode_mask(mask, (0, 0), size), size)
            for frame, mask in zip(frames, road, strict=True)
        ]


def resize_picture(pixels: NDArray[np.uint8], size_px: tuple[int, int]) -> NDArray[np.uint8]:
    """Resize a picture to the network's size; grey pictures get three equal channels."""
    coloured = pixels if pixels.ndim == 3 else np.repeat(pixels[..., None], 3, axis=2)
    small = cv2.resize(coloured, size_px, interpolation=cv2.INTER_AREA)
    return np.asarray(small, np.uint8)
