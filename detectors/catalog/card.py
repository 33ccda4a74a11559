"""Model cards: the input that a network expects and what its numbers mean, as a TOML file.

version = 1
weights = "yolox_nano.onnx"      # next to the card; .onnx, .xml (OpenVINO), .tflite, or tensors
sha256 = "..."                   # of the weights; for OpenVINO also sha256_bin

[input]
width_px = 416
height_px = 416
fit = "letterbox"                # or "stretch"

[output]
kind = "yolox"                   # or another of detectors/decoders, or "segmentation"
classes = ["person", "bicycle", "car"]

[network]                        # for tensors alone (.pth, .pt, .safetensors)
architecture = "maskrcnn_resnet50_fpn"
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Annotated, Any, Final, Literal, Self

from pydantic import Field, ValidationError, model_validator

from crosscue.detectors.decoders.table import AnyBoxOutput
from crosscue.detectors.networks.weights import Weights
from crosscue.detectors.settings import Proportion, Settings
from crosscue.replay.base import MIB, VehicleError, read_at_most, toml_tree
from crosscue.replay.vehicle.section import tuples
from crosscue.replay.vehicle.validation_errors import explain

from .architectures import WEIGHTS_SUFFIXES, ArchitectureName
from .class_scores import ClassScores

MAX_BYTES: Final = 2048 * MIB
"""Largest weights read."""
MAX_CARD_BYTES: Final = 1 * MIB
Side = Annotated[int, Field(gt=0, le=8192)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Colour = tuple[Finite, Finite, Finite]
Hash = Annotated[str, Field(pattern="^[0-9a-f]{64}$")]


class Input(Settings):
    """From pixels to the network's input: (pixel - mean) * scale, both in ``colour`` order."""

    width_px: Side
    height_px: Side
    colour: Literal["bgr", "rgb"] = "bgr"
    mean: Colour = (0.0, 0.0, 0.0)
    scale: Colour = (1.0, 1.0, 1.0)
    fit: Literal["stretch", "letterbox", "letterbox-center", "crop", "network"] = "stretch"
    """Letterbox: proportions kept, at the top left or in the center, the rest filled with ``pad``;
    crop: proportions kept, the middle of the picture; network: it scales the picture itself, the
    shorter side to the smaller of width and height, the longer one to at most the larger, as
    torchvision's do."""
    pad: Annotated[int, Field(ge=0, le=255)] = 114
    decode: Literal["reduced", "full"] = "reduced"
    """Reduced: a JPEG is decoded no finer than the input needs, which averages pixels and saves
    time. Full: at its own size and then interpolated, as most published scripts do; where the
    picture is more than twice as wide as the input, interpolation skips most pixels."""
    layout: Literal["nchw", "nhwc", "chw"] = "nchw"
    """``chw`` has no batch axis, as torchvision exports its detectors."""
    dtype: Literal["float32", "uint8"] = "float32"
    is_resizable: bool = False
    """A network without fully connected layers runs at other sizes than its file declares, and
    then returns as many candidates more."""
    max_batch: Annotated[int, Field(gt=0, le=64)] = 1
    """Pictures given to the network at once, where its batch axis is free."""


class Tiles(Settings):
    """Besides the whole picture, tiles of the input's size at the picture's own resolution."""

    top: Proportion = 0.3
    """Upper edge of the band covered, as a fraction of the picture's height."""
    bottom: Proportion = 0.7
    """Its lower edge."""
    overlap: Annotated[float, Field(ge=0.0, lt=0.9)] = 0.2
    """Of neighbouring tiles, as a fraction of their size."""


class SegmentationOutput(Settings):
    """One class for each pixel: scores (C, H, W), or class numbers (H, W)."""

    kind: Literal["segmentation"]
    name: str | None = None
    classes: tuple[str, ...]
    road: tuple[str, ...] = ("road",)
    """Names of the classes that one can drive on."""


class TorchNetwork(Settings):
    """What to build for weights that are tensors alone, by torchvision."""

    architecture: ArchitectureName
    norm_epsilon: Annotated[float, Field(ge=0.0, le=0.1)] | None = None
    """Added to the variances of its normalisation; left out, as torchvision builds it. 0 for
    networks trained further from torchvision's COCO weights of the first versions, whose
    normalisation is frozen."""


class WeightFile(Settings):
    """A file that the publisher offers, for ``crosscue model fetch``."""

    name: Annotated[str, Field(pattern=r"^[\w.-]+$")]
    url: Annotated[str, Field(pattern="^https?://")]
    size_bytes: Annotated[int, Field(gt=0, le=MAX_BYTES)]
    sha256: Hash


class Evidence(Settings):
    """One measurement of the network: on which pictures, with which result."""

    pictures: str
    """Which, how many, by whom labelled."""
    boxes: Annotated[int, Field(ge=0)] | None = None
    """Labelled objects, or boxes found, that were counted."""
    input: str = ""
    """At which size of the network's input, where it runs at several."""
    metric: str
    value: Finite
    low: Finite | None = None
    """Lower end of the 95 % interval."""
    high: Finite | None = None
    measured: str = ""
    """When, with which version: a date and a commit."""
    note: str = ""


class ModelCard(Settings):
    """A whole card."""

    version: Literal[1]
    about: str = ""
    """What the network is, in a line."""
    weights: str
    sha256: Hash
    sha256_bin: Hash | None = None
    """Of the .bin file next to an OpenVINO .xml."""
    licence: str = ""
    source: str = ""
    input: Input
    output: Annotated[AnyBoxOutput | SegmentationOutput, Field(discriminator="kind")]
    network: TorchNetwork | None = None
    """For weights that are tensors alone: .pth, .pt and .safetensors."""
    labels: dict[str, str] = Field(default_factory=dict)
    """What a class means to crosscue, where its own name says something else: the cues count
    "stop sign", "traffic light", "car", "truck", "bus", "one way left" and so on."""
    scores: dict[str, ClassScores] = Field(default_factory=dict)
    """By label, that is by the class's meaning: thresholds and calibrations, as fitted."""
    is_calibrated: bool = False
    """Its scores are probabilities: so often a detection is right. Of an object that two detectors
    found, a calibrated score is kept before one that is not."""
    tiles: Tiles | None = None
    """Left out: the whole picture only."""
    files: tuple[WeightFile, ...] = ()
    """Where the weights can be had; the first is ``weights``."""
    evidence: tuple[Evidence, ...] = ()
    """What was measured, for ``crosscue model show``."""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        """Refuse labels of classes that are not listed, no classes, and one class twice."""
        classes = self.output.classes
        if not classes:
            raise ValueError("output.classes is empty; list the network's classes in their order")
        unknown = [name for name in self.labels if name not in classes]
        if unknown:
            raise ValueError(f"labels: {unknown[0]!r} is not one of output.classes")
        meanings = set(map(self.meaning, range(len(classes))))
        others = [name for name in self.scores if name not in meanings]
        if others:
            raise ValueError(f"scores: {others[0]!r} is not a label of its classes")
        return self

    @model_validator(mode="after")
    def _of_one_kind(self) -> Self:
        """Refuse tensors without a network, and a network whose pictures the card scales."""
        is_tensors = self.weights.lower().endswith(WEIGHTS_SUFFIXES)
        if is_tensors != (self.network is not None):
            raise ValueError(
                "network.architecture is for tensors alone (.pth, .pt, .safetensors), and they "
                "need it"
            )
        given = self.input
        if is_tensors != (given.fit == "network"):
            raise ValueError('input.fit = "network" goes with [network], and only with it')
        if is_tensors and (
            (given.colour, given.layout, given.dtype) != ("rgb", "chw", "uint8")
            or self.output.kind != "torchvision"
        ):
            raise ValueError(
                'networks of torchvision need colour = "rgb", layout = "chw", dtype = "uint8" in '
                '[input], and kind = "torchvision" in [output]'
            )
        return self

    def meaning(self, number: int) -> str:
        """The label that a detection of a class gets."""
        name = self.output.classes[number]
        return self.labels.get(name, name)


def read_card(path: Path) -> ModelCard:
    """Read and check a card.

    Raises:
        VehicleError: Not there, not TOML, or a key or value that does not fit; with the line.
    """
    try:
        content = read_at_most(path, MAX_CARD_BYTES)
        if content is None:
            raise VehicleError(
                f"{path}: over {MAX_CARD_BYTES // MIB} MiB; this is not a model card"
            )
        text = content.decode("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        why = error.strerror if isinstance(error, OSError) else "not UTF-8 text"
        raise VehicleError(f"{path}: {why}; give a model card") from None
    try:
        tree: dict[str, Any] = tuples(toml_tree(text))
        return ModelCard.model_validate(tree)
    except ValidationError as error:
        raise VehicleError(explain(error, text, str(path), ModelCard)) from None
    except ValueError as error:
        raise VehicleError(f"{path}: not TOML: {error}; correct that line") from None


def read_weights(card: ModelCard, folder: Path) -> Weights:
    """The card's weights, their hashes compared.

    Raises:
        VehicleError: Not there, too large, or not the file that the card was written for.
    """
    path = folder / card.weights
    content = _verified(path, card.sha256, "sha256")
    if path.suffix != ".xml":
        return Weights(name=str(path), content=content)
    if card.sha256_bin is None:
        raise VehicleError(f"{path}: the card lacks sha256_bin, the hash of its .bin file; add it")
    second = _verified(path.with_suffix(".bin"), card.sha256_bin, "sha256_bin")
    return Weights(name=str(path), content=content, second=second)


def _verified(path: Path, want: str, key: str) -> bytes:
    try:
        content = read_at_most(path, MAX_BYTES)
        if content is None:
            raise VehicleError(f"{path}: over {MAX_BYTES // MIB} MiB; not read")
    except OSError as error:
        raise VehicleError(f"{path}: {error.strerror}; put the weights next to the card") from None
    found = hashlib.sha256(content).hexdigest()
    if found != want:
        raise VehicleError(
            f"{path}: SHA-256 {found}, the card's {key} says {want}; fetch the weights again, or "
            "write a card for these"
        )
    return content
