"""Save and load a road network's weights as safetensors, with a description."""

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final

import torch
from pydantic import Field, ValidationError

from crosscue.detectors.settings import Settings
from crosscue.detectors.weights_file import pack_weights, unpack_weights
from crosscue.replay.errors import VehicleError, one_line
from crosscue.replay.files.bounded import read_whole
from crosscue.replay.files.whole_file import write_bytes

from .network import RoadNetwork

KEY: Final = "crosscue-road"
MAX_BYTES: Final = 64 << 20


class RoadFacts(Settings):
    """Description of a road checkpoint, stored in its file.

    Attributes:
        version: Version of this description.
        width_px: Width to which pictures are resized.
        height_px: Height to which pictures are resized.
        recipe: Settings of the training and its measured results.
    """

    version: Annotated[int, Field(ge=1, le=1)] = 1
    width_px: Annotated[int, Field(ge=32, le=2048)]
    height_px: Annotated[int, Field(ge=32, le=2048)]
    recipe: dict[str, str | int | float] = Field(default_factory=dict)


@dataclass(frozen=True, slots=True, eq=False)
class RoadCheckpoint:
    """A network with its weights, in evaluation mode."""

    facts: RoadFacts
    network: RoadNetwork
    sha256: str


def save_road(path: Path, network: RoadNetwork, facts: RoadFacts) -> None:
    """Write weights, 16 bits each, and their description.

    Raises:
        OutputError: The file cannot be written.
    """
    kept = {
        name: value.detach().cpu().contiguous().half() if value.is_floating_point() else value.cpu()
        for name, value in network.state_dict().items()
    }
    content = pack_weights(kept, KEY, json.dumps(facts.model_dump(mode="json"), sort_keys=True))
    write_bytes(path, content)


def load_road(path: Path) -> RoadCheckpoint:
    """Read weights and load them into a network.

    Raises:
        VehicleError: The file is missing, not safetensors, damaged, or not of a road network.
    """
    if path.suffix != ".safetensors":
        raise VehicleError(f"{path}: expected .safetensors; other files can run programs when read")
    try:
        content = read_whole(path, MAX_BYTES)
    except OSError as error:
        raise VehicleError(f"{path}: {error.strerror}; check the file name") from None
    description, tensors = unpack_weights(content, KEY, path)
    if description is None:
        raise VehicleError(f"{path}: expected a file written by crosscue train road")
    try:
        facts = RoadFacts.model_validate_json(description)
    except ValidationError as error:
        why = one_line(error, 120)
        raise VehicleError(f"{path}: its description is invalid ({why}); train it again") from None
    network = RoadNetwork()
    if not all(bool(value.isfinite().all()) for value in tensors.values()):
        raise VehicleError(f"{path}: holds values that are not finite; train it again")
    try:
        network.load_state_dict(tensors)
    except RuntimeError as error:
        why = one_line(error, 160)
        raise VehicleError(f"{path}: weights do not fit: {why}; train it again") from None
    return RoadCheckpoint(
        facts,
        network.eval().to(memory_format=torch.channels_last),
        hashlib.sha256(content).hexdigest(),
    )
