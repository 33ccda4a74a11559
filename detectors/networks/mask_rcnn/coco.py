"""Torchvision's Mask R-CNN networks with COCO weights, which torchvision fetches on first use.

The file is verified against the hash in its name and read with ``weights_only=True``, which
rejects everything but tensors.
"""

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final
from urllib.error import URLError

import torch
from torch import nn

from crosscue.replay.errors import VehicleError, one_line

from .checkpoint import Checkpoint, Facts
from .network import NetworkPlan, build_network

# Names of networks and of torchvision's weights for them.
COCO_NETWORKS: Final[Mapping[str, str]] = {
    "resnet50": "MaskRCNN_ResNet50_FPN_Weights",
    "resnet50-v2": "MaskRCNN_ResNet50_FPN_V2_Weights",
}
# Networks that run with epsilon 0 in normalisation, because they were trained with it.
NO_EPSILON: Final = frozenset({"resnet50"})
# Width to which torchvision scales a 16:9 picture.
WIDTH_PX: Final = 1333


def load_coco(name: str) -> Checkpoint:
    """Load one of ``COCO_NETWORKS``; its weights are fetched if necessary.

    Raises:
        VehicleError: The weights cannot be fetched, or their hash is wrong.
    """
    from torchvision.models import detection

    weights = getattr(detection, COCO_NETWORKS[name]).DEFAULT
    place = Path(torch.hub.get_dir()) / "checkpoints" / weights.url.rsplit("/", 1)[-1]
    try:
        if place.exists():
            _verify_hash(place)
        tensors = weights.get_state_dict(progress=False, check_hash=True, weights_only=True)
    except (URLError, TimeoutError, ConnectionError) as error:
        raise VehicleError(
            f"detector mask-rcnn: {name}: cannot fetch {weights.url} ({error}); fetch it elsewhere "
            f'and copy it to {place}, or use network = "embedded"'
        ) from None
    except (OSError, RuntimeError, ValueError) as error:
        why = one_line(error, 160)
        raise VehicleError(
            f"detector mask-rcnn: {name}: {place} is not usable ({why}); delete it and run again"
        ) from None
    return coco_checkpoint(name, weights, tensors)


def _verify_hash(path: Path) -> None:
    """Verify a file's hash; torchvision does so only for a file that it has just fetched.

    Raises:
        ValueError: The hash is not the one in the file's name.
        OSError: The file cannot be read.
    """
    wanted = path.stem.rsplit("-", 1)[-1]
    with path.open("rb") as file:
        found = hashlib.file_digest(file, "sha256").hexdigest()
    if not found.startswith(wanted):
        raise ValueError(f"damaged: sha256 {found[:8]}, expected {wanted}")


def coco_checkpoint(name: str, weights: Any, tensors: Mapping[str, Any]) -> Checkpoint:
    """Load torchvision's weights into their network, with the names of COCO's classes."""
    classes = tuple(None if c == "N/A" else str(c) for c in weights.meta["categories"][1:])
    plan = NetworkPlan.model_validate(
        {"architecture": name, "classes": classes, "width_px": WIDTH_PX}
    )
    network = build_network(plan)
    network.load_state_dict(tensors)
    if name in NO_EPSILON:
        for module in network.modules():
            if isinstance(module, nn.BatchNorm2d):
                module.eps = 0.0
    # The file's name contains the start of its hash, which has been verified.
    digest = hashlib.sha256(weights.url.encode()).hexdigest()
    return Checkpoint(Facts(plan=plan), network.eval(), digest)
