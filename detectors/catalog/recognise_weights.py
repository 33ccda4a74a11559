"""Recognise the torchvision network of a file of tensors by their names and shapes."""

from pathlib import Path
from typing import Final, get_args

from crosscue.detectors.decoders.base import Guess, Interface
from crosscue.detectors.networks.torchvision_weights import (
    StateDict,
    class_count,
    read_state_dict,
    shapes_of,
    tensor_difference,
)
from crosscue.replay.errors import UsageError

from .architectures import ARCHITECTURES, ArchitectureName
from .card import model_bytes

_NAMES: Final[tuple[ArchitectureName, ...]] = get_args(ArchitectureName)
_OURS: Final = b'"crosscue"'
_HEADER_BYTES: Final = 65_536


def recognise_weights(
    path: Path, kind: str | None, size_px: tuple[int, int] | None = None
) -> tuple[Interface, Guess]:
    """Find the network whose tensors have exactly these names and shapes.

    Args:
        path: A ``state_dict`` (.pth, .pt) or safetensors.
        kind: The architecture, where several have the same tensors.
        size_px: Longest and shortest side to which pictures are scaled; torchvision's by default.

    Raises:
        UsageError: The file cannot be read, or its tensors match no network or several.
        VehicleError: The file holds more than tensors, or is damaged.
    """
    content = model_bytes(path)
    if path.suffix == ".safetensors" and _OURS in content[:_HEADER_BYTES]:
        raise UsageError(
            f"{path}: written by crosscue train, so it needs no card; set network = {path.name!r} "
            "in the settings of the detector mask-rcnn"
        )
    state = read_state_dict(content, str(path))
    counts = {name: class_count(state.tensors, name) for name in _NAMES}
    possible = {name: count for name, count in counts.items() if count is not None}
    differing = {
        name: tensor_difference(shapes_of(name, count), state.tensors)
        for name, count in possible.items()
    }
    fitting = [name for name, (count, _) in differing.items() if not count]
    chosen = [name for name in fitting if kind in (None, name)]
    if len(chosen) > 1:
        raise UsageError(
            f"{path}: {' and '.join(chosen)} have the same tensors; choose one with --kind"
        )
    if chosen:
        return Interface((), (), {}), _guess(path, chosen[0], possible[chosen[0]], state, size_px)
    raise UsageError(f"{path}: {_why_not(differing, fitting, kind)}")


def _why_not(
    differing: dict[ArchitectureName, tuple[int, str]],
    fitting: list[ArchitectureName],
    kind: str | None,
) -> str:
    if kind is not None and fitting:
        return f"its tensors are those of {', '.join(fitting)}, not of {kind}; leave --kind out"
    if not differing:
        return (
            f"no tensors of a known network ({', '.join(_NAMES)}); export it to ONNX, or write a "
            "detector (docs: Write a detector)"
        )
    nearest = min(differing, key=lambda name: differing[name][0])
    count, first = differing[nearest]
    return (
        f"no known network has these tensors; the nearest is {nearest}, from which {count} differ: "
        f"{first}; export it to ONNX"
    )


def _guess(
    path: Path,
    name: ArchitectureName,
    count: int,
    state: StateDict,
    size_px: tuple[int, int] | None,
) -> Guess:
    shape = ARCHITECTURES[name]
    width, height = size_px or shape.size_px
    if shape.is_stretched and (width, height) != shape.size_px:
        own = f"{shape.size_px[0]}x{shape.size_px[1]}"
        raise UsageError(f"{path}: {name} accepts pictures of {own} only; leave --size out")
    classes = count - shape.first_class
    background = " and the background" if shape.first_class else ""
    certain = [
        *state.notes,
        f"all {len(state.tensors)} tensors have the names and shapes of {name}",
        f"its head has {classes} classes{background}",
    ]
    assumed = []
    network: dict[str, object] = {"architecture": name}
    if shape.is_stretched:
        certain.append(f"pictures are stretched to {width} x {height}")
    elif size_px is None:
        assumed.append(
            f"pictures are scaled as torchvision does: shorter side {height}, longer at most "
            f"{width} (--size {width}x{height})"
        )
    if shape.is_frozen and state.is_frozen:
        network["norm_epsilon"] = 0.0
        assumed.append(
            "its normalisation was frozen: fine-tuned from torchvision's COCO weights, so "
            "norm_epsilon is 0; remove it if only the backbone was pretrained"
        )
    if not shape.first_class:
        assumed.append("class numbers begin at 0")
    settings: dict[str, object] = {"kind": "torchvision", "overlap": 1.0}
    settings["first_class"] = shape.first_class
    if shape.is_masked:
        settings["masks"] = "masks"
    given = {
        "width_px": width,
        "height_px": height,
        "colour": "rgb",
        "fit": "network",
        "layout": "chw",
        "dtype": "uint8",
    }
    return Guess(settings, classes, tuple(certain), tuple(assumed), given, network)
