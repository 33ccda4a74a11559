"""Make training reproducible bit for bit, for one seed on one machine.

On a CPU, every operation used has a deterministic implementation, which torch is set to use; sums
depend on the number of threads. On a GPU, some operations have none, such as the gradient of RoI
Align, which adds in any order. The checkpoint records all that affects the bits, so that a
difference between two checkpoints can be explained.
"""

from __future__ import annotations

import os
import platform
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

import torch

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
