"""Save and load checkpoints: weights as safetensors, with their description in the header.

Pickles are never opened, because a pickle can run any program when it is read.
"""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final

import torch
from pydantic import Field, ValidationError
from torch import Tensor

from crosscue.detectors.settings import Settings
from crosscue.detectors.weights_file import embedded, pack_weights, unpack_weights
from crosscue.replay.errors import VehicleError
from crosscue.replay.files.bounded import read_whole
from crosscue.replay.files.whole_file import write_bytes

from .network import NetworkPlan, build_network

KEY: Final = "crosscue"
VERSION: Final = 1
MAX_BYTES: Final = 2 << 30
# Usual suffixes of pickles.
_PICKLES: Final = frozenset({".pth", ".pt", ".pkl", ".pickle", ".bin", ".ckpt", ".joblib", ".npy"})

Finite = Annotated[float, Field(allow_inf_nan=False)]


class Calibration(Settings):
    """Maps a network's score s to the fraction of such detections that are correct.

    The logit of the fraction is ``slope * logit(s) + offset`` (Platt 1999).
    """

    slope: Annotated[float, Field(gt=0.0, le=100.0)] = 1.0
    offset: Annotated[float, Field(ge=-100.0, le=100.0)] = 0.0


class Facts(Settings):
    """Description of a checkpoint, stored in its file.

    Attributes:
        version: Version of this description.
        plan: Architecture and input of the network.
        calibration: Calibration by class; a class without one keeps its scores.
        measured: Average precisions, precisions and recalls on held-out pictures, by name.
        recipe: Settings of the training and its results.
        has_masks: True if the mask head was trained on these classes; otherwise detections have
            boxes only.
    """

    version: Annotated[int, Field(ge=1, le=VERSION)] = VERSION
    plan: NetworkPlan
    calibration: dict[str, Calibration] = Field(default_factory=dict)
    measured: dict[str, Finite | None] = Field(default_factory=dict)
    recipe: dict[str, str | int | Finite] = Field(default_factory=dict)
    has_masks: bool = True


@dataclass(frozen=True, slots=True, eq=False)
class Checkpoint:
    """A network with its weights.

    Attributes:
        facts: Description of the network.
        network: A torchvision ``MaskRCNN`` in evaluation mode.
        sha256: Hash of the file, hexadecimal.
    """

    facts: Facts
    network: Any
    sha256: str


def save_checkpoint(path: Path, network: Any, facts: Facts) -> None:
    """Write weights, in 16 bits each, and their description.

    Args:
        path: File name, ending in ``.safetensors``.
        network: A torchvision ``MaskRCNN``.
        facts: Description of the network.

    Raises:
        OutputError: The file cannot be written.
    """
    tensors = {name: _stored(value) for name, value in network.state_dict().items()}
    content = pack_weights(tensors, KEY, json.dumps(facts.model_dump(mode="json"), sort_keys=True))
    write_bytes(path, content)


def _stored(value: Tensor) -> Tensor:
    kept = value.detach().cpu().contiguous(memory_format=torch.contiguous_format)
    return kept.half() if kept.dtype == torch.float32 else kept


def embedded_mask_rcnn() -> Path:
    """Path of the checkpoint that is part of crosscue."""
    return embedded("compact_simulated.safetensors")


def load_checkpoint(path: Path) -> Checkpoint:
    """Read weights and build their network.

    Raises:
        VehicleError: The file is missing, a pickle, damaged or not written by crosscue, or its
            description and weights do not match.
    """
    content = _content(path)
    description, tensors = unpack_weights(content, KEY, path)
    facts = _facts(description, path)
    network = build_network(facts.plan)
    fill(network, tensors, path)
    return Checkpoint(facts, network.eval(), hashlib.sha256(content).hexdigest())


def _content(path: Path) -> bytes:
    if path.suffix.lower() in _PICKLES:
        raise VehicleError(
            f"{path}: weights of this kind can run programs when read; expected .safetensors; "
            "for weights of torchvision networks write a card: crosscue model init"
        )
    try:
        return read_whole(path, MAX_BYTES)
    except OSError as error:
        raise VehicleError(f"{path}: {error.strerror}; check the network's file name") from None


def _facts(description: str | None, path: Path) -> Facts:
    if description is None:
        raise VehicleError(
            f"{path}: has no description of classes and size; expected a file written by crosscue "
            "train mask-rcnn; for weights of torchvision networks write a card: crosscue model init"
        )
    try:
        return Facts.model_validate_json(description)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        name = ".".join(str(part) for part in first["loc"])
        raise VehicleError(
            f"{path}: its description is invalid: {name}: {first['msg'].lower()}; train it again"
        ) from None


def fill(network: Any, tensors: Mapping[str, Tensor], path: Path) -> None:
    """Load weights into a network.

    Raises:
        VehicleError: A weight is missing, unknown, of another shape, or not finite.
    """
    wanted: Mapping[str, Tensor] = network.state_dict()
    if missing := sorted(set(wanted) ^ set(tensors)):
        raise VehicleError(
            f"{path}: weights do not fit the network it names: {missing[0]} "
            f"(and {len(missing) - 1} more) in only one of them; use an unmodified file"
        )
    for name, value in sorted(tensors.items()):
        if value.shape != wanted[name].shape:
            raise VehicleError(
                f"{path}: {name}: expected shape {tuple(wanted[name].shape)} for its classes, "
                f"got {tuple(value.shape)}; use an unmodified file"
            )
        if value.is_floating_point() and not bool(value.isfinite().all()):
            raise VehicleError(f"{path}: {name}: holds values that are not finite; train it again")
    network.load_state_dict({name: tensors[name].to(wanted[name].dtype) for name in wanted})
