"""Where a torch network runs."""

from __future__ import annotations

import torch

from crosscue.replay.errors import VehicleError


def chosen_device(asked: str, who: str) -> torch.device:
    """The device asked for; by itself (``auto``) CUDA, else MPS, else the CPU.

    Args:
        asked: ``auto``, ``cpu``, ``cuda`` or ``mps``.
        who: Asks, for the error.

    Raises:
        VehicleError: It is not there.
    """
    there = {"cuda": torch.cuda.is_available(), "mps": torch.backends.mps.is_available()}
    if asked == "auto":
        asked = next((name for name, is_there in there.items() if is_there), "cpu")
    elif not there.get(asked, True):
        raise VehicleError(
            f"{who}: device {asked}: not there or not in this torch; use auto or cpu"
        )
    return torch.device(asked)
