"""The training loop of all networks; an interrupted training resumes with the same result.

It uses AdamW with a warm-up and a cosine schedule. The result of a Mask R-CNN is a running average
of the weights (Loshchilov and Hutter 2019; Polyak and Juditsky 1992).

A training is reproducible bit for bit, for one seed on one machine. On a CPU, every operation used
has a deterministic implementation, which torch is set to use; sums depend on the number of threads.
On a GPU, some operations have none, such as the gradient of RoI Align, which adds in any order. The
checkpoint records all that affects the bits, so that a difference between two can be explained.
"""

import json
import math
import os
import platform
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import torch
from torch import Tensor, nn

from crosscue.detectors.weights_file import serialised
from crosscue.replay.errors import CrosscueError, SchemaError, one_line
from crosscue.replay.files.made_of import NOTHING, refuse_another
from crosscue.replay.files.tree_text import json_tree
from crosscue.replay.files.whole_file import write_bytes
from crosscue.replay.versions import installed

LIBRARIES: Final = ("torch", "torchvision", "numpy", "opencv-python-headless")
CUBLAS_VARIABLE: Final = "CUBLAS_WORKSPACE_CONFIG"


@contextmanager
def reproducible(device: torch.device) -> Iterator[None]:
    """Use torch's deterministic operations within the ``with`` block.

    Args:
        device: Device of the training. Operations without a deterministic implementation raise
            ``RuntimeError`` on a CPU (crosscue's networks have none) and are permitted elsewhere.
    """
    # cuBLAS reads this on first use, and is not deterministic without it.
    os.environ.setdefault(CUBLAS_VARIABLE, ":4096:8")
    before = torch.are_deterministic_algorithms_enabled()
    warned = torch.is_deterministic_algorithms_warn_only_enabled()
    benchmark = torch.backends.cudnn.benchmark
    torch.use_deterministic_algorithms(True, warn_only=device.type != "cpu")
    torch.backends.cudnn.benchmark = False
    try:
        yield
    finally:
        torch.use_deterministic_algorithms(before, warn_only=warned)
        torch.backends.cudnn.benchmark = benchmark


def decides_bits(device: torch.device) -> dict[str, str | int | float]:
    """Properties that two trainings must share for identical bits, for a checkpoint's recipe."""
    found: dict[str, str | int | float] = {f"on.{name}": installed(name) for name in LIBRARIES}
    found["on.device"] = device.type
    found["on.threads"] = torch.get_num_threads()
    found["on.cpu"] = f"{_cpu_name()}, {torch.backends.cpu.get_cpu_capability()}"
    if device.type == "cuda":
        found["on.gpu"] = torch.cuda.get_device_name(device)
        found["on.cuda"] = str(torch.version.cuda)
    found["on.is_reproducible"] = (
        "bit for bit" if device.type == "cpu" else "no: RoI Align's gradient adds in any order"
    )
    return found


def _cpu_name() -> str:
    """Name of the processor, where Linux reports it."""
    try:
        with Path("/proc/cpuinfo").open(encoding="utf-8", errors="replace") as file:
            lines = (line.partition(":") for line in file)
            return next(value.strip() for key, _, value in lines if key.strip() == "model name")
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


STATE_KEY: Final = "crosscue_training"
GRADIENT_LIMIT: Final = 5.0
# Number of consecutive losses that are not finite after which training stops.
BAD_STEPS: Final = 20


@dataclass(frozen=True, slots=True)
class Schedule:
    """Number of steps, learning rates and related settings.

    Attributes:
        steps: Total number of batches.
        batch: Number of samples per batch.
        rate: Maximum learning rate.
        warm_up: Number of steps until the maximum rate is reached.
        decay: Weight decay of AdamW.
        average: Decay of the running average per step, after its initial phase.
        seed: Seed of all random numbers.
    """

    steps: int
    batch: int = 8
    rate: float = 1e-3
    warm_up: int = 100
    decay: float = 0.05
    average: float = 0.998
    seed: int = 0

    def rate_at(self, step: int) -> float:
        """The learning rate of a step."""
        if step < self.warm_up:
            return self.rate * (step + 1) / self.warm_up
        fraction = (step - self.warm_up) / max(self.steps - self.warm_up, 1)
        return self.rate * (0.01 + 0.99 * 0.5 * (1.0 + math.cos(math.pi * min(fraction, 1.0))))


class Learner:
    """A network in training: its optimizer, its average, and its state on disk.

    Attributes:
        network: The network in training.
        averaged: Running average of the network, in evaluation mode; None without one.
        done: Number of steps done.
    """

    def __init__(
        self,
        network: Any,
        groups: Sequence[dict[str, Any]],
        schedule: Schedule,
        device: torch.device,
        averaged: Any = None,
    ) -> None:
        """Begin with given weights.

        Args:
            network: The network, on its device.
            groups: Its parameters, as the optimizer takes them.
            schedule: Number of steps and learning rates.
            device: Device of the training.
            averaged: A copy of the network for its average.
        """
        self.network, self.averaged = network, averaged
        self.schedule, self.device = schedule, device
        self.done = 0
        self._bad = 0
        self._optimizer = torch.optim.AdamW(groups, schedule.rate, foreach=True)

    def learn(self, loss_of: Callable[[], Tensor]) -> float:
        """Do one step, and return its loss.

        Raises:
            CrosscueError: The losses are no longer finite.
        """
        schedule = self.schedule
        # The losses sample regions at random, which must not depend on where training resumed.
        torch.manual_seed(schedule.seed * 1_000_003 + self.done)
        for group in self._optimizer.param_groups:
            group["lr"] = schedule.rate_at(self.done)
        loss = loss_of()
        value = float(loss.detach())
        self.done += 1
        if not math.isfinite(value):
            self._note_bad()
            self._optimizer.zero_grad(set_to_none=True)
            return value
        self._bad = 0
        loss.backward()  # type: ignore[no-untyped-call]
        nn.utils.clip_grad_norm_(self.network.parameters(), GRADIENT_LIMIT)
        self._optimizer.step()
        self._optimizer.zero_grad(set_to_none=True)
        if self.averaged is not None:
            self._average(self.averaged)
        return value

    def _note_bad(self) -> None:
        self._bad += 1
        if self._bad >= BAD_STEPS:
            raise CrosscueError(
                f"step {self.done}: {BAD_STEPS} losses in a row are not finite; "
                "lower --learning-rate and start over"
            )

    @torch.no_grad()
    def _average(self, averaged: Any) -> None:
        keep = min(self.schedule.average, (1.0 + self.done) / (10.0 + self.done))
        for kept, now in zip(
            averaged.state_dict().values(), self.network.state_dict().values(), strict=True
        ):
            if kept.is_floating_point():
                kept.lerp_(now, 1.0 - keep)
            else:
                kept.copy_(now)

    def save(
        self,
        path: Path,
        said: Mapping[str, Any] = NOTHING,
        *,
        made_of: Mapping[str, Any] = NOTHING,
    ) -> None:
        """Store everything needed to resume, with entries of the caller.

        Raises:
            OutputError: The file cannot be written.
        """
        tensors = {
            f"{group}.{name}": value
            for group, network in self._networks().items()
            for name, value in network.state_dict().items()
        }
        for i, state in self._optimizer.state_dict()["state"].items():
            tensors |= {f"optimizer.{i}.{k}": v for k, v in state.items()}
        kept = {"done": self.done, "schedule": asdict(self.schedule)}
        header = {STATE_KEY: json.dumps(kept | {"said": said, "made_of": made_of})}
        plain = {k: v.detach().cpu().contiguous() for k, v in tensors.items()}
        write_bytes(path, serialised(plain, header))

    def _networks(self) -> dict[str, Any]:
        averaged = {} if self.averaged is None else {"averaged": self.averaged}
        return {"network": self.network, **averaged}

    def resume(self, path: Path, made_of: Mapping[str, Any] = NOTHING) -> Mapping[str, Any]:
        """Restore the state of ``save``; return the caller's entries.

        Raises:
            SchemaError: The file is damaged.
            UsageError: The file is of another training.
        """
        from safetensors import SafetensorError, safe_open

        try:
            with safe_open(path, "pt", device=str(self.device)) as file:
                kept = json_tree((file.metadata() or {}).get(STATE_KEY, "{}"))
                tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        except (SafetensorError, OSError, ValueError) as error:
            raise SchemaError(
                f"{path}: damaged ({error}); delete it and start the training over"
            ) from None
        refuse_another(path, "--resume", kept.get("made_of"), made_of)
        if kept.get("schedule") != asdict(self.schedule):
            raise SchemaError(
                f"{path}: holds a training with other settings; use the same ones, or another -o"
            )
        self._restore(tensors, path)
        self.done = int(kept["done"])
        said: Mapping[str, Any] = kept["said"]
        return said

    def _restore(self, tensors: Mapping[str, Tensor], path: Path) -> None:
        groups: dict[str, dict[str, Tensor]] = {}
        for name, value in tensors.items():
            group, _, rest = name.partition(".")
            groups.setdefault(group, {})[rest] = value
        state: dict[int, dict[str, Tensor]] = {}
        try:
            for name, value in groups.get("optimizer", {}).items():
                number, _, what = name.partition(".")
                state.setdefault(int(number), {})[what] = value
            for group, network in self._networks().items():
                network.load_state_dict(groups[group])
            whole = self._optimizer.state_dict()
            self._optimizer.load_state_dict({**whole, "state": state})
        except (RuntimeError, ValueError, KeyError) as error:
            why = one_line(error, 120)
            raise SchemaError(f"{path}: does not fit this network ({why}); start over") from None
