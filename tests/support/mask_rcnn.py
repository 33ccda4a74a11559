"""Small Mask R-CNN networks, and torchvision's files of weights."""

import json
from functools import cache
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
import torch
from torchvision.models import detection

from crosscue.detectors.base import Frame
from crosscue.detectors.networks.mask_rcnn.checkpoint import Checkpoint, Facts
from crosscue.detectors.networks.mask_rcnn.network import NetworkPlan, build_network
from crosscue.replay.columns import Bytes

CLASSES: Final = ("car", "stop sign", "traffic light")
CPU: Final = torch.device("cpu")


def plan_of(width_px: int = 128, **changes: Any) -> NetworkPlan:
    plan = {"architecture": "compact", "classes": CLASSES, "width_px": width_px}
    return NetworkPlan.model_validate({**plan, **changes})


@cache
def random_checkpoint(seed: int = 0) -> Checkpoint:
    """An untrained network whose scores vary over the picture."""
    torch.manual_seed(seed)
    network = build_network(plan_of())
    with torch.no_grad():
        network.roi_heads.box_predictor.cls_score.weight.mul_(30.0)
        network.roi_heads.mask_predictor.mask_fcn_logits.weight.mul_(30.0)
    return Checkpoint(Facts(plan=plan_of()), network.eval(), f"random {seed}")


def noise_frame(seed: int = 0, width: int = 128, height: int = 96, t_ns: int = 5) -> Frame:
    rng = np.random.default_rng(seed)
    coarse = rng.integers(0, 256, (height // 8, width // 8, 3), np.uint8)
    pixels = np.asarray(cv2.resize(coarse, (width, height)), np.uint8)
    return Frame(t_ns, "cam", pixels, (width, height))


def bars(seed: int) -> tuple[Bytes, list[tuple[int, int, int, int]]]:
    """A grey 128 x 96 picture with two bright bars, and their boxes as x, y, width, height."""
    rng = np.random.default_rng(seed)
    pixels = rng.integers(60, 90, (96, 128, 3), np.uint8)
    boxes = []
    for left in (4, 68):
        x, y = left + int(rng.integers(10)), int(rng.integers(10, 60))
        width, height = int(rng.integers(24, 44)), int(rng.integers(12, 22))
        pixels[y : y + height, x : x + width] = (40, 220, 250)
        boxes.append((x, y, width, height))
    return pixels, boxes


def write_bars(folder: Path, count: int) -> Path:
    """Write a COCO file of such pictures in ``folder/images``, with the bars labelled as cars."""
    (folder / "images").mkdir(parents=True)
    images: list[dict[str, Any]] = []
    annotations: list[dict[str, Any]] = []
    for i in range(count):
        pixels, boxes = bars(i)
        cv2.imwrite(str(folder / "images" / f"{i}.png"), pixels)
        images.append({"id": i, "file_name": f"{i}.png", "width": 128, "height": 96})
        for x, y, width, height in boxes:
            corners = [x, y, x + width, y, x + width, y + height, x, y + height]
            annotations.append(
                {
                    "id": len(annotations),
                    "image_id": i,
                    "category_id": 3,
                    "iscrowd": 0,
                    "bbox": [x, y, width, height],
                    "segmentation": [corners],
                }
            )
    tree = {
        "images": images,
        "annotations": annotations,
        "categories": [{"id": 3, "name": "car"}, {"id": 9, "name": "boat"}],
    }
    path = folder / "coco.json"
    path.write_text(json.dumps(tree), encoding="utf-8")
    return path


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
