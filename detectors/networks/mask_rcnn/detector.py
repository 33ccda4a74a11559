"""The detector ``mask-rcnn``: boxes, scores and masks of cars, stop signs and traffic lights.

Settings: ``network`` (``embedded``, ``resnet50``, ``resnet50-v2``, or a ``.safetensors`` file),
``score``, ``proposals``, ``objectness``, ``batch``, ``device``, ``backend``, ``threads``.

It is faster than torchvision's own loop and has equal results. Masks are computed only for boxes
above the minimum score, and only inside their box. On a CPU, convolutions use the Winograd
algorithm (module ``cpu``) or OpenVINO (module ``openvino``), and a large number of proposals is
screened first. Fewer proposals save more time. The complete network exported as ONNX returns the
same detections in 1.2 to 1.5 times the CPU time (``benchmarks/mask_rcnn.py --onnx``).

Screening runs an approximate box head on all proposals, and the exact one on the rest. About fifty
of a thousand proposals contain an object, but the box head costs the same for each. Most of that is
its first layer, which the product of two thin matrices approximates (truncated SVD; Girshick 2015,
section 3.1). Approximate scores only reject proposals; every detection has exact scores.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from torch import Tensor, nn
from torch.nn import functional

from crosscue.detectors import rle
from crosscue.detectors.base import Detections, Detector, Found, Frame, View
from crosscue.detectors.networks.devices import chosen_device, threads_of
from crosscue.detectors.settings import Proportion, Settings, identity_of, settings_of
from crosscue.replay.columns import Bytes, Floats
from crosscue.replay.errors import CrosscueError, VehicleError

from .checkpoint import Calibration, Checkpoint, embedded_mask_rcnn, load_checkpoint
from .coco import COCO_NETWORKS, load_coco
from .cpu import for_cpu
from .network import MEAN, STRIDE, NetworkPlan, set_limits
from .openvino import OpenVinoParts
from .parts import MaskRcnnLayers, TorchParts, detected

# Number of proposals above which screening saves time.
MIN_PROPOSALS: Final = 200
# Rank of the approximation, as a fraction of the layer's outputs.
RANK: Final = 3 / 16
# Maximum error of an approximate score, in log-odds, that does not lose a detection.
MARGIN: Final = 2.5
# Interval of proposals that always get exact scores, to measure the approximation's error.
CHECKED: Final = 40


def can_screen(network: Any) -> bool:
    """Whether a network's box head is torchvision's of two layers, with scores from a third."""
    from torchvision.models.detection.faster_rcnn import TwoMLPHead

    heads = network.roi_heads
    scores = getattr(heads.box_predictor, "cls_score", None)
    return isinstance(heads.box_head, TwoMLPHead) and isinstance(scores, nn.Linear)


class ScreenedParts(TorchParts):
    """All parts in torch on a CPU, with approximate logits for proposals of low score."""

    def __init__(self, network: Any) -> None:
        """Approximate the first layer of a network that ``can_screen``.

        The network's minimum score must be set before.
        """
        super().__init__(network, torch.device("cpu"))
        self._heads: Final = network.roi_heads
        self._min_logit: Final = float(torch.logit(torch.tensor(float(self._heads.score_thresh))))
        first = self._heads.box_head.fc6
        with torch.inference_mode():
            # The left singular vectors, from a matrix whose size is independent of the inputs.
            _, left = torch.linalg.eigh(first.weight @ first.weight.T)
            rank = max(round(RANK * first.out_features), 1)
            self._wide: Final = left[:, -rank:].contiguous()
            # Pooled boxes have their channels last, so that these rows have too.
            thin = self._wide.T @ first.weight
            thin = thin.unflatten(1, (network.backbone.out_channels, -1))
            self._narrow: Final = thin.transpose(1, 2).flatten(1).contiguous()

    def boxes(self, pooled: Tensor, /) -> tuple[Tensor, Tensor]:
        """As ``Parts``; offsets are 0 where logits are approximate."""
        logits = self._rough(pooled)
        rough = _log_odds(logits)
        is_close = rough >= self._min_logit - MARGIN
        is_close[::CHECKED] = True
        rows = is_close.nonzero()[:, 0]
        close, close_shifts = super().boxes(pooled[rows])
        exact = _log_odds(close)
        counts = exact >= self._min_logit - MARGIN
        if bool((counts & (exact - rough[rows] > MARGIN / 2.0)).any()):
            return super().boxes(pooled)
        logits[rows] = close
        shifts = close_shifts.new_zeros((len(pooled), close_shifts.shape[1]))
        shifts[rows] = close_shifts
        return logits, shifts

    def _rough(self, pooled: Tensor) -> Tensor:
        head, first = self._heads.box_head, self._heads.box_head.fc6
        thin = functional.linear(pooled.permute(0, 2, 3, 1).flatten(1), self._narrow)
        hidden = functional.relu(functional.linear(thin, self._wide, first.bias))
        logits: Tensor = self._heads.box_predictor.cls_score(functional.relu(head.fc7(hidden)))
        return logits


def _log_odds(logits: Tensor) -> Tensor:
    """Log-odds of each row's most probable class other than the background."""
    return torch.logit(functional.softmax(logits, 1)[:, 1:].amax(1))


# Incremented when the same pixels, weights and settings yield different numbers than before.
VERSION: Final = 3
EMBEDDED: Final = "embedded"
GPU_BATCH: Final = 8
PROPOSALS: Final = 100
_PAD: Final = np.rint(np.array(MEAN[::-1]) * 255.0).astype(np.uint8)


class MaskRcnnSettings(Settings):
    """Settings of the detector ``mask-rcnn``."""

    network: str = EMBEDDED
    """``embedded``, ``resnet50``, ``resnet50-v2``, or the file name of a checkpoint."""
    score: Proportion = 0.5
    """Minimum score of a detection; cues have their own, higher thresholds."""
    proposals: Annotated[int, Field(ge=1, le=2000)] = PROPOSALS
    """Maximum number of proposals that the box head examines; torchvision's default is 1000."""
    objectness: Proportion = 0.0
    """Minimum objectness of a proposal, a probability; torchvision's default is 0."""
    batch: Annotated[int, Field(ge=1, le=256)] | None = None
    """Number of pictures per batch; by default 1 on a CPU and 8 on a GPU."""
    device: Literal["auto", "cpu", "cuda", "mps"] = "auto"
    backend: Literal["torch", "openvino"] = "torch"
    """Back end that runs the layers; ``openvino`` works on a CPU only."""
    threads: Annotated[int, Field(ge=1, le=256)] = 1
    """Number of threads on a CPU."""
    halve: bool = True
    """True to compute in 16 bits on a GPU, where that is safe."""


def build(**given: Any) -> Detector:
    """Build the detector.

    Raises:
        VehicleError: Settings, checkpoint, device or back end are invalid, or weights cannot be
            fetched.
    """
    settings = settings_of(MaskRcnnSettings, given, "detector mask-rcnn")
    device = _device_of(settings)
    return detector_of(checkpoint_named(settings.network), settings, device)


# Thresholds of the dissertation. They apply to its network, which is torchvision's for COCO, and to
# the embedded network, which replaces it. Scores of other networks are not comparable.
SOURCE_SCORES: Final = {"stop sign": 0.9, "traffic light": 0.9, "car": 0.95}


def checkpoint_named(name: str) -> Checkpoint:
    """Load the embedded checkpoint, one that torchvision fetches, or one from a file.

    Raises:
        VehicleError: As ``build``.
    """
    if name == EMBEDDED:
        return load_checkpoint(embedded_mask_rcnn())
    if name in COCO_NETWORKS:
        return load_coco(name)
    if "." not in Path(name).name:
        names = ", ".join((EMBEDDED, *COCO_NETWORKS))
        raise VehicleError(
            f"detector mask-rcnn: network: expected one of {names} or a .safetensors file, got "
            f"{name!r}"
        )
    return load_checkpoint(Path(name))


def _device_of(settings: MaskRcnnSettings) -> torch.device:
    if settings.backend == "torch":
        return chosen_device(settings.device, "detector mask-rcnn")
    if settings.device not in ("auto", "cpu"):
        raise VehicleError(
            f"detector mask-rcnn: backend {settings.backend} runs on a cpu only, got device "
            f'{settings.device}; set device = "cpu", or backend = "torch"'
        )
    return torch.device("cpu")


def detector_of(
    checkpoint: Checkpoint, settings: MaskRcnnSettings, device: torch.device
) -> MaskRcnnDetector:
    """Build a detector from a loaded network."""
    network = checkpoint.network.to(device).eval()
    lowest = min(
        raw_score(settings.score, checkpoint.facts.calibration.get(name or "", Calibration()))
        for name in checkpoint.facts.plan.classes
    )
    set_limits(network, settings.proposals, lowest, settings.objectness)
    batch = settings.batch or (1 if device.type == "cpu" else GPU_BATCH)
    with threads_of(settings.threads, device):
        parts = _parts(network, settings, device)
    return MaskRcnnDetector(checkpoint, settings, device, parts, _Batch(batch))


def _parts(network: Any, settings: MaskRcnnSettings, device: torch.device) -> MaskRcnnLayers:
    if settings.backend == "openvino":
        return OpenVinoParts(network, settings.threads)
    if device.type == "cpu":
        own = for_cpu(network)
        if settings.proposals >= MIN_PROPOSALS and can_screen(own):
            return ScreenedParts(own)
        return TorchParts(own, device)
    return TorchParts(network.to(memory_format=torch.channels_last), device)


@dataclass(slots=True)
class _Batch:
    """Batch size, which is reduced when memory runs out."""

    size: int


@dataclass(frozen=True, slots=True)
class MaskRcnnDetector:
    """Detector of boxes and masks."""

    checkpoint: Checkpoint
    settings: MaskRcnnSettings
    device: torch.device
    parts: MaskRcnnLayers
    _batch: _Batch = field(repr=False)

    @property
    def labels(self) -> tuple[str, ...]:
        """The checkpoint's classes."""
        return tuple(name for name in self.checkpoint.facts.plan.classes if name)

    @property
    def min_scores(self) -> dict[str, float]:
        """The dissertation's thresholds, for its network only."""
        is_source = self.settings.network in (EMBEDDED, *COCO_NETWORKS)
        return dict(SOURCE_SCORES) if is_source else {}

    @property
    def view(self) -> View:
        """The resolution of the network's input."""
        return View(min_width_px=self.checkpoint.facts.plan.width_px)

    @property
    def identity(self) -> str:
        """Text that changes with weights, settings, kind of device and version of torch."""
        asked = self.settings.model_dump(
            include={"score", "proposals", "objectness", "halve", "backend"}
        )
        return identity_of(
            "mask-rcnn",
            VERSION,
            self.checkpoint.sha256,
            asked,
            self.device.type,
            str(torch.__version__),
        )

    def __call__(self, frames: Sequence[Frame], /) -> Sequence[Found]:
        """Return the detections in each frame.

        Raises:
            CrosscueError: A single picture does not fit into memory.
        """
        found: list[Found] = []
        while len(found) < len(frames):
            part = _of_one_size(frames[len(found) : len(found) + self._batch.size])
            try:
                found += self._detect(part)
            except (torch.OutOfMemoryError, MemoryError):
                self._shrink(len(part))
        return found

    def _shrink(self, tried: int) -> None:
        if tried == 1:
            width = self.checkpoint.facts.plan.width_px
            raise CrosscueError(
                f"detector mask-rcnn: no memory on {self.device} for one picture {width} pixels "
                'wide; close other programs, set device = "cpu", or use a smaller network'
            ) from None
        self._batch.size = max(tried // 2, 1)
        if self.device.type == "cuda":
            torch.cuda.empty_cache()

    def _detect(self, frames: Sequence[Frame]) -> list[Found]:
        plan = self.checkpoint.facts.plan
        placed = [place_picture(frame.pixels, plan) for frame in frames]
        with torch.inference_mode(), threads_of(self.settings.threads, self.device):
            pictures = np.stack([one.pixels for one in placed])
            is_halved = self.settings.halve and self.device.type == "cuda"
            with torch.autocast(self.device.type, enabled=is_halved):
                raw = detected(self.checkpoint.network, self.parts, pictures)
            return [
                self._detections(frame, one, tensors)
                for frame, one, tensors in zip(frames, placed, raw, strict=True)
            ]

    def _detections(
        self, frame: Frame, placed: PlacedPicture, raw: dict[str, Tensor]
    ) -> Detections:
        facts = self.checkpoint.facts
        names = [facts.plan.classes[int(label) - 1] for label in raw["labels"].tolist()]
        boxes, raw_scores, masks = (
            raw[key].float().cpu().numpy() for key in ("boxes", "scores", "masks")
        )
        scores = np.array(
            [
                calibrated(s, facts.calibration.get(name or "", Calibration()))
                for s, name in zip(raw_scores.tolist(), names, strict=True)
            ],
            np.float64,
        )
        width, height = frame.size_px
        boxes_px = (
            (boxes.astype(np.float64) + np.tile(placed.corner_px, 2))
            / np.tile(placed.scale, 2)
            * np.tile(frame.scale, 2)
        )
        boxes_px = np.clip(boxes_px, 0.0, [width, height, width, height])
        keep = [i for i, name in enumerate(names) if name and scores[i] >= self.settings.score]
        return Detections(
            frame.t_ns,
            frame.size_px,
            boxes_px[keep],
            scores[keep],
            tuple(str(names[i]) for i in keep),
            tuple(
                laid_in(masks[i, 0], boxes_px[i], frame.size_px) if facts.has_masks else b""
                for i in keep
            ),
        )


def _of_one_size(frames: Sequence[Frame]) -> Sequence[Frame]:
    """Leading frames that have the size of the first."""
    shape = frames[0].pixels.shape
    count = next((i for i, f in enumerate(frames) if f.pixels.shape != shape), len(frames))
    return frames[:count]


@dataclass(frozen=True, slots=True, eq=False)
class PlacedPicture:
    """A picture as the network's input.

    Attributes:
        pixels: Shape (H, W, 3), uint8, blue, green, red; scaled, cropped and padded.
        scale: Factors from original to scaled pixels, along x and y.
        corner_px: Column and row of the input's first pixel in the scaled picture.
    """

    pixels: Bytes
    scale: tuple[float, float]
    corner_px: tuple[int, int]


def place_picture(pixels: Bytes, plan: NetworkPlan) -> PlacedPicture:
    """Scale a picture to the plan's width, crop top and bottom, and pad to the stride."""
    if pixels.ndim == 2:
        pixels = np.asarray(cv2.cvtColor(pixels, cv2.COLOR_GRAY2BGR), np.uint8)
    height, width = pixels.shape[:2]
    first = min(round(plan.top * height), height - 1)
    last = max(round((1.0 - plan.bottom) * height), first + 1)
    size = (plan.width_px, max(round((last - first) * plan.width_px / width), 1))
    scaled = np.asarray(pixels[first:last], np.uint8)
    if size != (width, last - first):
        scaled = np.asarray(cv2.resize(scaled, size, interpolation=cv2.INTER_LINEAR), np.uint8)
    scale = (size[0] / width, size[1] / (last - first))
    padded = np.empty((_padded(size[1]), _padded(size[0]), 3), np.uint8)
    padded[: size[1], : size[0]] = scaled
    padded[size[1] :] = padded[: size[1], size[0] :] = _PAD
    return PlacedPicture(padded, scale, (0, round(first * scale[1])))


def _padded(side: int) -> int:
    return -(-side // STRIDE) * STRIDE


def calibrated(score: float, by: Calibration) -> float:
    """Convert a network's score to the fraction of such detections that are correct."""
    if by == Calibration():
        return score
    kept = min(max(score, 1e-9), 1.0 - 1e-9)
    logit = by.slope * float(np.log(kept / (1.0 - kept))) + by.offset
    return float(1.0 / (1.0 + np.exp(-logit)))


def raw_score(score: float, by: Calibration) -> float:
    """Convert a calibrated score back to the network's; the inverse of ``calibrated``."""
    kept = min(max(score, 1e-9), 1.0 - 1e-9)
    if by == Calibration():
        return score
    logit = (float(np.log(kept / (1.0 - kept))) - by.offset) / by.slope
    return float(1.0 / (1.0 + np.exp(-logit)))


def laid_in(mask: NDArray[np.float32], box_px: Floats, size_px: tuple[int, int]) -> bytes:
    """Encode the pixels of a box's mask whose probability exceeds 0.5, as runs over the picture.

    Args:
        mask: Shape (28, 28): probabilities over the box.
        box_px: x0, y0, x1, y1.
        size_px: Width and height of the picture.
    """
    width, height = size_px
    x0, y0 = (
        min(max(int(np.floor(v)), 0), side - 1) for v, side in zip(box_px, size_px, strict=False)
    )
    x1, y1 = (
        min(max(int(np.ceil(v)), low + 1), side)
        for v, low, side in zip(box_px[2:], (x0, y0), size_px, strict=True)
    )
    rim = np.pad(mask, 1)
    step = np.maximum(box_px[2:] - box_px[:2], 1e-6) / mask.shape[::-1]
    # Pixel centres in the mask's grid, whose first centre is at 1 because of the padding.
    columns = (np.arange(x0, x1) + 0.5 - box_px[0]) / step[0] + 0.5
    rows = (np.arange(y0, y1) + 0.5 - box_px[1]) / step[1] + 0.5
    grid = np.meshgrid(columns.astype(np.float32), rows.astype(np.float32))
    fine = cv2.remap(rim, grid[0], grid[1], cv2.INTER_LINEAR)
    return rle.encode_mask(np.asarray(fine) > 0.5, (x0, y0), (width, height))
