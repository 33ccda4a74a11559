"""Train road networks on pictures with the fraction of road in each pixel.

Pixels near the road's edge have more weight, because most of the road is near and soon learnt.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import Final

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from crosscue.detectors.networks.road.network import RoadNetwork, logits_of
from crosscue.replay.columns import Bytes

from .loop import Learner, Schedule

EDGE_WEIGHT: Final = 6.0
EDGE_PX: Final = 9

# Defaults of a road network's schedule.
RoadSchedule: Final = partial(Schedule, batch=12, rate=4e-3, warm_up=60, decay=0.01)


class RoadTraining(Learner):
    """A road network in training; ``steps`` trains, ``save`` and ``resume`` keep its state."""

    def __init__(self, schedule: Schedule, device: torch.device) -> None:
        """Start with random weights."""
        torch.manual_seed(schedule.seed)
        network = RoadNetwork().to(device).to(memory_format=torch.channels_last)
        groups = [{"params": [*network.parameters()], "weight_decay": schedule.decay}]
        super().__init__(network, groups, schedule, device)

    def steps(self, pixels: Bytes, road: Bytes) -> Iterator[tuple[int, float]]:
        """Train, and yield number and loss of each step.

        Args:
            pixels: Shape (N, H, W, 3), uint8, blue, green, red.
            road: Shape (N, H, W), uint8: fraction of road; 255 is 1.
        """
        self.network.train()
        while self.done < self.schedule.steps:
            rng = np.random.default_rng([self.schedule.seed, 0xD0, self.done])
            picked = rng.integers(0, len(pixels), self.schedule.batch)
            pairs = [varied(pixels[i], road[i], rng) for i in picked]
            some, wanted = (np.stack(column) for column in zip(*pairs, strict=True))
            loss = self.learn(partial(self._loss, some, wanted))
            yield self.done, loss

    def _loss(self, pixels: Bytes, road: Bytes) -> Tensor:
        wanted = torch.from_numpy(road).to(self.device).float() / 255.0
        logits = logits_of(self.network, torch.from_numpy(pixels).to(self.device))
        losses = functional.binary_cross_entropy_with_logits(logits, wanted, reduction="none")
        weight = edge_weight(wanted)
        return (losses * weight).sum() / weight.sum()


def edge_weight(wanted: Tensor) -> Tensor:
    """Weight of each pixel: 1 far from the road's edge, up to ``EDGE_WEIGHT`` more at the edge."""
    around = functional.avg_pool2d(
        wanted[:, None], EDGE_PX, 1, EDGE_PX // 2, count_include_pad=False
    )[:, 0]
    return 1.0 + EDGE_WEIGHT * 2.0 * (wanted - around).abs()


def varied(pixels: Bytes, road: Bytes, rng: np.random.Generator) -> tuple[Bytes, Bytes]:
    """Augment a picture: mirror, zoom, shift, change brightness and add noise."""
    high, wide = road.shape
    zoom = float(rng.uniform(0.92, 1.12))
    shift = rng.uniform(-1.0, 1.0, 2) * (0.03 * wide, 0.035 * high)
    onto = np.array(
        [
            [zoom, 0.0, (1 - zoom) * wide / 2 + shift[0]],
            [0.0, zoom, (1 - zoom) * high / 2 + shift[1]],
        ]
    )
    picture = cv2.warpAffine(pixels, onto, (wide, high), borderMode=cv2.BORDER_REPLICATE)
    mask = cv2.warpAffine(road, onto, (wide, high), borderMode=cv2.BORDER_REPLICATE)
    if rng.random() < 0.5:
        picture, mask = picture[:, ::-1], mask[:, ::-1]
    light = 255.0 * (np.arange(256) / 255.0) ** float(np.exp(rng.uniform(-0.35, 0.35)))
    gain = float(np.exp(rng.uniform(-0.35, 0.3))) * np.exp(rng.uniform(-0.07, 0.07, 3))
    table = np.clip(light[:, None] * gain, 0, 255).astype(np.uint8)
    changed = cv2.LUT(np.ascontiguousarray(picture), table[None])
    noise = rng.normal(0.0, rng.uniform(0.0, 6.0), (high, wide, 1))
    noisy = np.clip(changed + noise, 0, 255).astype(np.uint8)
    return noisy, np.ascontiguousarray(mask)


@dataclass(frozen=True, slots=True)
class RoadScore:
    """Score of a road network over all pixels; partly covered pixels are left out.

    Attributes:
        iou: Intersection over union of predicted and true road.
        precision: Fraction of predicted road that is road.
        recall: Fraction of road that is predicted.
        pictures: Number of pictures.
    """

    iou: float
    precision: float
    recall: float
    pictures: int


def road_score(network: RoadNetwork, pixels: Bytes, road: Bytes, device: torch.device) -> RoadScore:
    """Score a network on held-out pictures."""
    network.eval()
    right = called = there = 0
    with torch.inference_mode():
        for begin in range(0, len(pixels), 8):
            batch = torch.from_numpy(pixels[begin : begin + 8]).to(device)
            found = (logits_of(network, batch) > 0.0).cpu().numpy()
            truth = road[begin : begin + 8]
            clear = np.abs(truth.astype(np.int16) - 127) > 60
            is_road = truth > 127
            right += int((found & is_road & clear).sum())
            called += int((found & clear).sum())
            there += int((is_road & clear).sum())
    network.train()
    either = called + there - right
    return RoadScore(
        right / max(either, 1), right / max(called, 1), right / max(there, 1), len(pixels)
    )
