"""Torchvision networks and state dicts with random weights."""

from pathlib import Path
from typing import Any

import torch
from torchvision.models import detection

NAMES = ("car", "stop sign", "traffic light")


def network(architecture: str, classes: int = 4, **more: Any) -> Any:
    """A torchvision network with the same random weights in each call."""
    torch.manual_seed(1)
    make = getattr(detection, architecture)
    return make(weights=None, weights_backbone=None, num_classes=classes, **more).eval()


def hollow(architecture: str, classes: int) -> dict[str, torch.Tensor]:
    """A state dict with names and shapes, in which one zero backs each tensor."""
    with torch.device("meta"):
        state = network(architecture, classes).state_dict()
    return {name: torch.zeros(()).expand(value.shape) for name, value in state.items()}


def class_names(folder: Path, names: tuple[str, ...] = NAMES) -> Path:
    """Write a file of class names."""
    path = folder / "names.txt"
    path.write_text("\n".join(names), encoding="utf-8")
    return path
