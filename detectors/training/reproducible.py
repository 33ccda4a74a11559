"""Training twice with one seed gives one result, bit for bit, on one machine.

On a CPU every operation used has a deterministic form, which torch is asked to take; sums depend
on the number of threads. On a GPU some have none (the gradient of RoI Align adds in any order):
there torch takes what there is. What decides the bits is written into the checkpoint, so that two
that differ say why.
"""

from __future__ import annotations

import os
import platform
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

import torch

from crosscue.replay.base import installed

LIBRARIES: Final = ("torch", "torchvision", "numpy", "opencv-python-headless")
CUBLAS_VARIABLE: Final = "CUBLAS_WORKSPACE_CONFIG"


@contextmanager
def reproducible(device: torch.device) -> Iterator[None]:
    """Within the ``with`` block, torch takes deterministic operations.

    Args:
        device: Where the training runs. Operations without a deterministic form raise
            ``RuntimeError`` on a CPU (none exist in our networks) and are taken on others.
    """
    # cuBLAS reads it when it is first used, and is not deterministic without.
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
    """What two trainings must have in common to give the same bits, for a checkpoint's recipe."""
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
    """The processor's own name where Linux reports it."""
    try:
        with Path("/proc/cpuinfo").open(encoding="utf-8", errors="replace") as file:
            lines = (line.partition(":") for line in file)
            return next(value.strip() for key, _, value in lines if key.strip() == "model name")
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()
