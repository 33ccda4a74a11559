"""Model cards: what a network wants to be given and what its numbers mean, as a TOML file.

version = 1
weights = "yolox_nano.onnx"      # next to the card; .onnx, .xml (OpenVINO) or .tflite
sha256 = "..."                   # of the weights; for OpenVINO also sha256_bin

[input]
width_px = 416
height_px = 416
fit = "letterbox"                # or "stretch"

[output]
kind = "yolox"                   # or "segmentation"
classes = ["person", "bicycle", "car"]
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from pydantic import Field, ValidationError

from crosscue.detectors.settings import Settings, Share
from crosscue.replay.errors import VehicleError
from crosscue.replay.files.bounded import read_at_most
from crosscue.replay.files.tree_text import toml_tree
from crosscue.replay.limits import MIB
from crosscue.replay.vehicle.validation_errors import explain
from crosscue.replay.vehicle.vehicle import tuples

MOST_BYTES: Final = 2048 * MIB
"""Largest weights read."""
MOST_CARD_BYTES: Final = 1 * MIB
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
    fit: Literal["stretch", "letterbox"] = "stretch"
    """Letterbox: at the top left, proportions kept, the rest grey 114."""
    layout: Literal["nchw", "nhwc"] = "nchw"
    dtype: Literal["float32", "uint8"] = "float32"


class YoloxOutput(Settings):
    """Boxes of the YOLOX kind: rows (x, y, w, h, objectness, classes...) over grids of strides."""

    kind: Literal["yolox"]
    name: str | None = None
    """Which of the outputs; the only one, if left out."""
    strides: tuple[Side, ...] = (8, 16, 32)
    classes: tuple[str, ...]
    score: Share = 0.3
    """Boxes below are dropped."""
    overlap: Share = 0.45
    """Of two boxes of one class that overlap more (intersection over union), the better stays."""


class SegmentationOutput(Settings):
    """One class for each pixel: scores (C, H, W), or class numbers (H, W)."""

    kind: Literal["segmentation"]
    name: str | None = None
    classes: tuple[str, ...]
    road: tuple[str, ...] = ("road",)
    """Names of the classes that one can drive on."""


class ModelCard(Settings):
    """A whole card."""

    version: Literal[1]
    weights: str
    sha256: Hash
    sha256_bin: Hash | None = None
    """Of the .bin file next to an OpenVINO .xml."""
    licence: str = ""
    source: str = ""
    input: Input
    output: Annotated[YoloxOutput | SegmentationOutput, Field(discriminator="kind")]


class Weights(Settings):
    """Weights as read and verified.

    Attributes:
        name: Of the file, for errors.
        content: Its bytes.
        second: Bytes of an OpenVINO ``.bin``, else empty.
    """

    name: str
    content: bytes
    second: bytes = b""


def read_card(path: Path) -> ModelCard:
    """Read and check a card.

    Raises:
        VehicleError: Not there, not TOML, or a key or value that does not fit; with the line.
    """
    try:
        content = read_at_most(path, MOST_CARD_BYTES)
        if content is None:
            raise VehicleError(f"{path}: over {MOST_CARD_BYTES // MIB} MiB; this is no model card")
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
        raise VehicleError(f"{path}: not TOML: {error}; mend that line") from None


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
        content = read_at_most(path, MOST_BYTES)
        if content is None:
            raise VehicleError(f"{path}: over {MOST_BYTES // MIB} MiB; not read")
    except OSError as error:
        raise VehicleError(f"{path}: {error.strerror}; put the weights next to the card") from None
    found = hashlib.sha256(content).hexdigest()
    if found != want:
        raise VehicleError(
            f"{path}: SHA-256 {found}, the card's {key} says {want}; fetch the weights again, or "
            "write a card for these"
        )
    return content
