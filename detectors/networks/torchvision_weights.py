"""Run torchvision's detection networks with a user's weights.

The weights file contains only tensors: a ``state_dict``, read with ``weights_only=True``, or
safetensors. The card specifies the architecture; torchvision scales and normalises the picture.
"""

from __future__ import annotations

import io
import re
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from torch import Tensor, nn

from crosscue.detectors.catalog.architectures import ARCHITECTURES, ArchitectureName
from crosscue.detectors.catalog.card import MAX_BYTES, ModelCard
from crosscue.detectors.decoders.base import Array
from crosscue.detectors.networks.devices import chosen_device, threads_of
from crosscue.detectors.weights_file import unpack_weights
from crosscue.replay.errors import VehicleError, one_line

from .weights import Weights

# Suffix of training counters: missing if normalisation is frozen, and unused in detection.
_COUNTER: Final = "num_batches_tracked"
_NESTED: Final = ("model", "state_dict", "model_state_dict", "weights")
_PREFIXES: Final = ("module.", "model.", "_orig_mod.")


@dataclass(frozen=True, slots=True, eq=False)
class StateDict:
    """Weights by name.

    Attributes:
        tensors: Tensors by name, without training counters.
        is_frozen: True if the normalisation of the saved network was frozen.
        notes: Outer keys and prefixes that were removed from the names.
    """

    tensors: Mapping[str, Tensor]
    is_frozen: bool
    notes: tuple[str, ...]


def read_state_dict(content: bytes, where: str) -> StateDict:
    """Read tensors by name from a file's bytes, without running code in it.

    Raises:
        VehicleError: The file holds code or objects other than tensors, holds no tensors, or is
            damaged.
    """
    is_safe = where.endswith(".safetensors")
    tree = unpack_weights(content, "", Path(where))[1] if is_safe else _torch(content, where)
    notes = []
    for key in _NESTED:
        if isinstance(tree, Mapping) and isinstance(tree.get(key), Mapping):
            tree = tree[key]
            notes.append(f"its weights are stored under {key!r}")
            break
    if not isinstance(tree, Mapping) or not tree:
        raise VehicleError(f"{where}: {type(tree).__name__}; expected a state dict: {_SAVE}")
    strange = next((k for k, v in tree.items() if not isinstance(v, Tensor)), None)
    if strange is not None:
        raise VehicleError(
            f"{where}: {strange!r} is {type(tree[strange]).__name__}, not a tensor; {_SAVE}"
        )
    named: dict[str, Tensor] = {str(name): value for name, value in tree.items()}
    for prefix in _PREFIXES:
        if all(name.startswith(prefix) for name in named):
            named = {name.removeprefix(prefix): value for name, value in named.items()}
            notes.append(f"its tensor names begin with {prefix!r}")
    kept = {name: value for name, value in named.items() if not name.endswith(_COUNTER)}
    return StateDict(kept, len(kept) == len(named), tuple(notes))


_SAVE: Final = "save tensors only: torch.save(model.state_dict(), FILE)"
_SAVE_OR_EXPORT: Final = f"{_SAVE}, or export the network to ONNX"
_EXPORT: Final = "export the network to ONNX with the project that wrote it"
# Packages of networks that are not torchvision's, so that their tensors alone are of no use.
_PROJECTS: Final = frozenset({"models", "ultralytics", "yolox", "super_gradients", "transformers"})


def _torch(content: bytes, where: str) -> Any:
    try:
        if _is_program(content):
            raise VehicleError(
                f"{where}: a TorchScript archive carries code; {_SAVE}, or export to ONNX"
            )
        return torch.load(io.BytesIO(content), map_location="cpu", weights_only=True)
    except VehicleError:
        raise
    except Exception as error:
        if found := re.search(r"GLOBAL ([\w.]+)", str(error)):
            is_theirs = found[1].partition(".")[0] in _PROJECTS
            raise VehicleError(
                f"{where}: holds code or objects other than tensors ({found[1]}), and reading them "
                f"can run a program; {_EXPORT if is_theirs else _SAVE_OR_EXPORT}"
            ) from None
        why = one_line(error, 120)
        raise VehicleError(f"{where}: not a complete weights file: {why}; {_SAVE}") from None


def _is_program(content: bytes) -> bool:
    """Whether the content is a TorchScript archive.

    Raises:
        ValueError: It unpacks to more than the maximum size.
    """
    if not zipfile.is_zipfile(io.BytesIO(content)):
        return False
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        entries = archive.infolist()
    size = sum(entry.file_size for entry in entries)
    if size > MAX_BYTES:
        raise ValueError(f"unpacks to {size:,} bytes, the limit is {MAX_BYTES:,}")
    return any(entry.filename.endswith("/constants.pkl") for entry in entries)


def shapes_of(architecture: ArchitectureName, class_count: int) -> dict[str, tuple[int, ...]]:
    """Names and shapes of a network's weights, without allocating them.

    Args:
        architecture: Name of the architecture.
        class_count: Number of classes, including the background where the architecture has one.
    """
    with torch.device("meta"):
        network = _empty(architecture, class_count)
    return {
        name: tuple(value.shape)
        for name, value in network.state_dict().items()
        if not name.endswith(_COUNTER)
    }


def _empty(architecture: ArchitectureName, class_count: int) -> Any:
    from torchvision.models import detection

    make = getattr(detection, architecture)
    return make(weights=None, weights_backbone=None, num_classes=class_count)


def load_torchvision(
    card: ModelCard, weights: Weights, score: float, threads: int
) -> TorchvisionNetwork:
    """Build the network that a card names, and load its weights.

    Raises:
        VehicleError: Weights and card do not match, or a weight is not finite.
    """
    if card.network is None:
        raise ValueError(f"{weights.name}: the card has no [network]")
    name = card.network.architecture
    shape = ARCHITECTURES[name]
    state = read_state_dict(weights.content, weights.name)
    listed = len(card.output.classes) + shape.first_class
    _check_classes(state.tensors, name, listed, weights.name)
    network = _empty(name, listed)
    _fill(network, state.tensors, name, weights.name)
    if card.network.norm_epsilon is not None:
        for module in network.modules():
            if isinstance(module, nn.BatchNorm2d):
                module.eps = card.network.norm_epsilon
    size = (card.input.width_px, card.input.height_px)
    if not shape.is_stretched:
        network.transform.min_size, network.transform.max_size = (size[1],), size[0]
    elif size != shape.size_px:
        own = f"{shape.size_px[0]} x {shape.size_px[1]}"
        raise VehicleError(
            f"{weights.name}: {name} accepts pictures of {own}, but the card specifies {size[0]} x "
            f"{size[1]}; correct input.width_px and height_px"
        )
    holder = network.roi_heads if hasattr(network, "roi_heads") else network
    holder.score_thresh = score
    device = chosen_device("auto", f"model {weights.name}")
    return TorchvisionNetwork(network.to(device).eval(), device, threads)


def _check_classes(
    tensors: Mapping[str, Tensor], name: ArchitectureName, listed: int, where: str
) -> None:
    shape = ARCHITECTURES[name]
    found = class_count(tensors, name)
    if found is not None and found != listed:
        background = " and the background" if shape.first_class else ""
        raise VehicleError(
            f"{where}: its head has {found - shape.first_class} classes{background}, the card "
            f"lists {listed - shape.first_class}; correct output.classes"
        )


def class_count(tensors: Mapping[str, Tensor], name: ArchitectureName) -> int | None:
    """Number of classes of the head, as torchvision counts; None if the head is missing."""
    shape = ARCHITECTURES[name]
    head = tensors.get(shape.head)
    if head is None or not head.ndim or len(head) % shape.per_class or len(head) == 0:
        return None
    return len(head) // shape.per_class


def tensor_difference(
    wanted: Mapping[str, tuple[int, ...]], tensors: Mapping[str, Tensor]
) -> tuple[int, str]:
    """Number of tensors that differ from a network's, and a description of the first."""
    missing = [name for name in wanted if name not in tensors]
    unknown = [name for name in tensors if name not in wanted]
    other = [n for n, v in tensors.items() if n in wanted and tuple(v.shape) != wanted[n]]
    first = ""
    if missing:
        first = f"{missing[0]} is missing"
    elif unknown:
        first = f"{unknown[0]} is unknown to it"
    elif other:
        first = (
            f"{other[0]} has shape {tuple(tensors[other[0]].shape)}, expected {wanted[other[0]]}"
        )
    return len(missing) + len(unknown) + len(other), first


def _fill(network: Any, tensors: Mapping[str, Tensor], name: str, where: str) -> None:
    """Load weights into a network.

    Raises:
        VehicleError: The weights are another network's, or not finite.
    """
    wanted = {
        key: value for key, value in network.state_dict().items() if not key.endswith(_COUNTER)
    }
    count, first = tensor_difference({key: tuple(v.shape) for key, v in wanted.items()}, tensors)
    if count:
        raise VehicleError(
            f"{where}: {count} tensors do not fit {name}: {first}; correct network.architecture, "
            "or use weights that were trained with it"
        )
    for key, value in tensors.items():
        if not bool(value.isfinite().all()):
            raise VehicleError(
                f"{where}: {key}: holds values that are not finite; use weights from before "
                "training diverged"
            )
    # Only training counters are missing.
    network.load_state_dict(dict(tensors), strict=False)


@dataclass(frozen=True, slots=True, eq=False)
class TorchvisionNetwork:
    """A torchvision network as a back end; it returns boxes, and masks if it has them."""

    network: Any
    device: torch.device
    threads: int

    @property
    def backend(self) -> str:
        """Version of torch, and the device."""
        return f"torch {torch.__version__} {self.device.type}"

    def __call__(self, picture: Array, /) -> Mapping[str, Array]:
        """Return torchvision's outputs for a picture (3, H, W), red, green, blue, uint8."""
        given = torch.from_numpy(np.asarray(picture, np.uint8)).to(self.device).float() / 255.0
        with torch.inference_mode(), threads_of(self.threads, self.device):
            (found,) = self.network([given])
        return {name: np.asarray(value.cpu().numpy()) for name, value in found.items()}
