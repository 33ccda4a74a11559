"""Train road networks on pictures with the fraction of road in each pixel.

It uses AdamW with a warm-up and a cosine schedule. Pixels near the road's edge have more weight,
because most of the road is near and soon learnt. The state is stored as safetensors; an interrupted
training resumes with the same result.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from crosscue.detectors.networks.road.network import RoadNetwork, logits_of
from crosscue.detectors.weights_file import serialised
from crosscue.replay.columns import Bytes
from crosscue.replay.errors import SchemaError, UsageError, one_line
from crosscue.replay.files.bounded import read_at_most
from crosscue.replay.files.made_of import NOTHING, refuse_another
from crosscue.replay.files.tree_text import json_tree
from crosscue.replay.files.whole_file import write_bytes
from crosscue.replay.limits import MIB

STATE_KEY: Final = "crosscue_road_training"
# Maximum size of a state file; the network and its moments need a few MB.
MAX_BYTES: Final = 1024 * MIB
EDGE_WEIGHT: Final = 6.0
EDGE_PX: Final = 9
GRADIENT_LIMIT: Final = 5.0


@dataclass(frozen=True, slots=True)
class RoadSchedule:
    """Number of steps, learning rates and related settings.

    Attributes:
        steps: Total number of batches.
        batch: Number of pictures per batch.
        rate: Maximum learning rate.
        warm_up: Number of steps until the maximum rate is reached.
        decay: Weight decay.
        seed: Seed of all random numbers.
    """

    steps: int = 1200
    batch: int = 12
    rate: float = 4e-3
    warm_up: int = 60
    decay: float = 0.01
    seed: int = 0

    def rate_at(self, step: int) -> float:
        """The learning rate of a step."""
        if step < self.warm_up:
            return self.rate * (step + 1) / self.warm_up
        fraction = (step - self.warm_up) / max(self.steps - self.warm_up, 1)
        return self.rate * (0.01 + 0.99 * 0.5 * (1.0 + math.cos(math.pi * min(fraction, 1.0))))


class RoadTraining:
    """A network in training; ``steps`` trains, ``save`` and ``resume`` store and restore its state.

    Attributes:
        network: The network in training.
        done: Number of steps done.
    """

    def __init__(self, schedule: RoadSchedule, device: torch.device) -> None:
        """Start with random weights."""
        torch.manual_seed(schedule.seed)
        self.schedule, self.device = schedule, device
        self.network = RoadNetwork().to(device).to(memory_format=torch.channels_last)
        self.done = 0
        self._optimizer = torch.optim.AdamW(
            self.network.parameters(), schedule.rate, weight_decay=schedule.decay, foreach=True
        )

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
            loss = self._learn(np.stack([p for p, _ in pairs]), np.stack([r for _, r in pairs]))
            yield self.done, loss

    def _learn(self, pixels: Bytes, road: Bytes) -> float:
        for group in self._optimizer.param_groups:
            group["lr"] = self.schedule.rate_at(self.done)
        wanted = torch.from_numpy(road).to(self.device).float() / 255.0
        logits = logits_of(self.network, torch.from_numpy(pixels).to(self.device))
        losses = functional.binary_cross_entropy_with_logits(logits, wanted, reduction="none")
        weight = edge_weight(wanted)
        loss = (losses * weight).sum() / weight.sum()
        self._optimizer.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), GRADIENT_LIMIT)
        self._optimizer.step()
        self.done += 1
        return float(loss.detach())

    def save(self, path: Path, made_of: Mapping[str, Any] = NOTHING) -> None:
        """Store everything that ``resume`` needs.

        Raises:
            OutputError: The file cannot be written.
        """
        tensors = {
            f"network.{k}": v.detach().cpu().contiguous().clone()
            for k, v in self.network.state_dict().items()
        }
        for number, slot in self._optimizer.state_dict()["state"].items():
            for name, value in slot.items():
                tensors[f"optimizer.{number}.{name}"] = value.detach().cpu().contiguous().clone()
        header = {
            STATE_KEY: json.dumps(
                {"done": self.done, "seed": self.schedule.seed, "made_of": made_of}
            )
        }
        write_bytes(path, serialised(tensors, header))

    def resume(self, path: Path, made_of: Mapping[str, Any] = NOTHING) -> None:
        """Restore the state of ``save``.

        Raises:
            SchemaError: The file is not a valid state.
            UsageError: The file is of another training or another seed.
        """
        from safetensors import SafetensorError
        from safetensors.torch import load

        try:
            content = read_at_most(path, MAX_BYTES)
            if content is None:
                raise ValueError(f"over {MAX_BYTES} bytes")
            tensors = load(content)
            size = int.from_bytes(content[:8], "little")
            state = json_tree(json_tree(content[8 : 8 + size])["__metadata__"][STATE_KEY])
            done, seed = int(state["done"]), int(state["seed"])
            refuse_another(path, "--resume", state.get("made_of"), made_of)
            self._fill(tensors)
        except (OSError, SafetensorError, ValueError, KeyError, RuntimeError) as error:
            why = one_line(error, 120)
            raise SchemaError(f"{path}: cannot resume from it ({why}); start over") from None
        if seed != self.schedule.seed:
            raise UsageError(f"{path}: of seed {seed}, not {self.schedule.seed}; use --seed {seed}")
        self.done = done

    def _fill(self, tensors: dict[str, Tensor]) -> None:
        own = {
            k.removeprefix("network."): v for k, v in tensors.items() if k.startswith("network.")
        }
        self.network.load_state_dict(own)
        kept = self._optimizer.state_dict()
        state: dict[int, dict[str, Tensor]] = {}
        for key, value in tensors.items():
            if key.startswith("optimizer."):
                _, number, name = key.split(".")
                state.setdefault(int(number), {})[name] = value
        self._optimizer.load_state_dict({**kept, "state": state})


def edge_weight(wanted: Tensor) -> Tensor:
    """Weight of each pixel: 1 far from the road's edge, up to ``EDGE_WEIGHT`` more at the edge."""
    around = functional.avg_pool2d(
        wanted[:, None], EDGE_PX, 1, EDGE_PX // 2, count_include_pad=False
    )[:, 0]
    return 1.0 + EDGE_WEIGHT * 2.0 * (wanted - around).abs()


def varied(pixels: Bytes, road: Bytes, rng: np.random.Generator) -> tuple[Bytes, Bytes]:
    """Augment a picture: mirror, zoom, shift, change brightness and add noise."""
    import cv2

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
