"""Model cards: TOML files that describe a network's input and the meaning of its output.

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

import hashlib
from pathlib import Path
from typing import Annotated, Final, Literal, Self

from pydantic import Field, model_validator

from crosscue.detectors.decoders.table import AnyBoxOutput
from crosscue.detectors.networks.weights import Weights
from crosscue.detectors.settings import Proportion, Settings
from crosscue.replay.errors import UsageError, VehicleError
from crosscue.replay.files.bounded import read_whole
from crosscue.replay.limits import MIB
from crosscue.replay.vehicle.validation_errors import read_model

from .architectures import WEIGHTS_SUFFIXES, ArchitectureName
from .class_scores import ClassScores

# Maximum size of a weights file.
MAX_BYTES: Final = 2048 * MIB
Side = Annotated[int, Field(gt=0, le=8192)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Colour = tuple[Finite, Finite, Finite]
Hash = Annotated[str, Field(pattern="^[0-9a-f]{64}$")]


class Input(Settings):
    """The network's input: (pixel - mean) * scale, with both in ``colour`` order."""

    width_px: Side
    height_px: Side
    colour: Literal["bgr", "rgb"] = "bgr"
    mean: Colour = (0.0, 0.0, 0.0)
    scale: Colour = (1.0, 1.0, 1.0)
    fit: Literal["stretch", "letterbox", "letterbox-center", "crop", "network"] = "stretch"
    """Method of fitting a picture into the input. Stretch: scaled without keeping its proportions.
    Letterbox: proportions kept, at the top left or in the center, and the rest filled with
    ``pad``. Crop: proportions kept, the middle of the picture. Network: the network scales the
    picture itself, as torchvision's do: the shorter side to the smaller of width and height, the
    longer side to at most the larger."""
    pad: Annotated[int, Field(ge=0, le=255)] = 114
    decode: Literal["reduced", "full"] = "reduced"
    """Resolution at which a JPEG is decoded. Reduced: no finer than the input needs, which averages
    pixels and saves time. Full: at full size and then interpolated, as most published scripts do;
    if the picture is more than twice as wide as the input, interpolation skips most pixels."""
    layout: Literal["nchw", "nhwc", "chw"] = "nchw"
    """``chw`` has no batch axis, as torchvision exports its detectors."""
    dtype: Literal["float32", "uint8"] = "float32"
    is_resizable: bool = False
    """True for a network without fully connected layers. It runs at other sizes than its file
    declares, and then returns more or fewer candidates accordingly."""
    max_batch: Annotated[int, Field(gt=0, le=64)] = 1
    """Number of pictures per batch, where the network's batch axis is variable."""


class Tiles(Settings):
    """Tiles at the picture's full resolution, examined in addition to the whole picture."""

    top: Proportion = 0.3
    """Upper edge of the covered band, as a fraction of the picture's height."""
    bottom: Proportion = 0.7
    """Lower edge of the covered band."""
    overlap: Annotated[float, Field(ge=0.0, lt=0.9)] = 0.2
    """Overlap of neighbouring tiles, as a fraction of their size."""


class SegmentationOutput(Settings):
    """One class for each pixel: scores (C, H, W), or class numbers (H, W)."""

    kind: Literal["segmentation"]
    name: str | None = None
    classes: tuple[str, ...]
    road: tuple[str, ...] = ("road",)
    """Names of the classes that are drivable."""


class TorchNetwork(Settings):
    """A torchvision network, for weights files that contain only tensors."""

    architecture: ArchitectureName
    norm_epsilon: Annotated[float, Field(ge=0.0, le=0.1)] | None = None
    """Value added to the variances in normalisation; torchvision's value by default. It is 0 for
    networks fine-tuned from torchvision's first COCO weights, whose normalisation is frozen."""


class WeightFile(Settings):
    """A published weights file, for ``crosscue model fetch``."""

    name: Annotated[str, Field(pattern=r"^[\w.-]+$")]
    url: Annotated[str, Field(pattern="^https?://")]
    size_bytes: Annotated[int, Field(gt=0, le=MAX_BYTES)]
    sha256: Hash


class Evidence(Settings):
    """One measurement of the network: its pictures and its result."""

    pictures: str
    """The pictures, their number and their annotators."""
    boxes: Annotated[int, Field(ge=0)] | None = None
    """Number of annotated objects or detected boxes that were counted."""
    input: str = ""
    """Input size of the network, where it runs at several."""
    metric: str
    value: Finite
    low: Finite | None = None
    """Lower bound of the 95 % interval."""
    high: Finite | None = None
    measured: str = ""
    """Date and commit of the measurement."""
    note: str = ""


class ModelCard(Settings):
    """A complete model card."""

    version: Literal[1]
    about: str = ""
    """One-line description of the network."""
    weights: str
    sha256: Hash
    sha256_bin: Hash | None = None
    """SHA-256 of the .bin file next to an OpenVINO .xml."""
    licence: str = ""
    source: str = ""
    input: Input
    output: Annotated[AnyBoxOutput | SegmentationOutput, Field(discriminator="kind")]
    network: TorchNetwork | None = None
    """The architecture, for weights files that contain only tensors: .pth, .pt, .safetensors."""
    labels: dict[str, str] = Field(default_factory=dict)
    """Labels of classes whose names differ from crosscue's. The cues count "stop sign",
    "traffic light", "car", "truck", "bus", "one way left" and so on."""
    scores: dict[str, ClassScores] = Field(default_factory=dict)
    """Fitted thresholds and calibrations, by label."""
    is_calibrated: bool = False
    """True if the scores are probabilities: the fraction of such detections that are correct. If
    two detectors find the same object, a calibrated score is preferred."""
    tiles: Tiles | None = None
    """Tiles to examine; by default only the whole picture is examined."""
    files: tuple[WeightFile, ...] = ()
    """Published files; the first is ``weights``."""
    evidence: tuple[Evidence, ...] = ()
    """Measurements of the network, for ``crosscue model show``."""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        """Reject an empty list of classes, and labels and scores of unlisted classes."""
        classes = self.output.classes
        if not classes:
            raise ValueError("output.classes is empty; list the network's classes in their order")
        unknown = [name for name in self.labels if name not in classes]
        if unknown:
            raise ValueError(f"labels: not in output.classes: {', '.join(map(repr, unknown[:8]))}")
        meanings = set(map(self.meaning, range(len(classes))))
        others = [name for name in self.scores if name not in meanings]
        if others:
            raise ValueError(f"scores: not labels of classes: {', '.join(map(repr, others[:8]))}")
        return self

    @model_validator(mode="after")
    def _of_one_kind(self) -> Self:
        """Reject tensors without [network], and [network] with an input that does not fit it."""
        is_tensors = self.weights.lower().endswith(WEIGHTS_SUFFIXES)
        if is_tensors != (self.network is not None):
            raise ValueError(
                "network.architecture is required for files of tensors (.pth, .pt, .safetensors) "
                "and not allowed for others"
            )
        given = self.input
        if is_tensors != (given.fit == "network"):
            raise ValueError(
                'input.fit = "network" is required with [network] and only allowed there'
            )
        if is_tensors and (
            (given.colour, given.layout, given.dtype) != ("rgb", "chw", "uint8")
            or self.output.kind != "torchvision"
        ):
            raise ValueError(
                'torchvision networks need colour = "rgb", layout = "chw", dtype = "uint8" in '
                '[input], and kind = "torchvision" in [output]'
            )
        return self

    def meaning(self, number: int) -> str:
        """Return the label of a class, by its number."""
        name = self.output.classes[number]
        return self.labels.get(name, name)


def read_card(path: Path) -> ModelCard:
    """Read and check a card.

    Raises:
        VehicleError: The file is missing or not TOML, or a key or value is invalid.
    """
    return read_model(path, ModelCard, VehicleError, "expected a model card")


def read_weights(card: ModelCard, folder: Path) -> Weights:
    """Read the card's weights and compare their hashes.

    Raises:
        UsageError: The weights are missing or too large.
        VehicleError: They do not match the card's hash.
    """
    path = folder / card.weights
    content = _verified(path, card.sha256, "sha256")
    if path.suffix != ".xml":
        return Weights(name=str(path), content=content)
    if card.sha256_bin is None:
        raise VehicleError(f"{path}: the card lacks sha256_bin, the hash of its .bin file; add it")
    second = _verified(path.with_suffix(".bin"), card.sha256_bin, "sha256_bin")
    return Weights(name=str(path), content=content, second=second)


def model_bytes(path: Path) -> bytes:
    """Read a model file or weights.

    Raises:
        UsageError: The file cannot be read, or is too large.
    """
    try:
        return read_whole(path, MAX_BYTES)
    except OSError as error:
        raise UsageError(f"{path}: {error.strerror}; expected a model file or weights") from None


def _verified(path: Path, want: str, key: str) -> bytes:
    content = model_bytes(path)
    found = hashlib.sha256(content).hexdigest()
    if found != want:
        raise VehicleError(
            f"{path}: SHA-256 {found}; the card's {key} is {want}; fetch the weights again, or "
            "write a card for this file"
        )
    return content
