"""Select the device and the number of threads of a torch network."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch

from crosscue.replay.errors import VehicleError


def chosen_device(asked: str, who: str) -> torch.device:
    """Return the requested device; ``auto`` is CUDA, else MPS, else the CPU.

    Args:
        asked: ``auto``, ``cpu``, ``cuda`` or ``mps``.
        who: Name of the caller, for the error.

    Raises:
        VehicleError: The device is not available.
    """
    there = {"cuda": torch.cuda.is_available(), "mps": torch.backends.mps.is_available()}
    if asked == "auto":
        asked = next((name for name, is_there in there.items() if is_there), "cpu")
    elif not there.get(asked, True):
        raise VehicleError(
            f"{who}: device {asked}: not available to the installed torch; use auto or cpu"
        )
    return torch.device(asked)


@contextmanager
def threads_of(count: int, device: torch.device) -> Iterator[None]:
    """Limit torch to ``count`` threads on a CPU; more than the free cores are far slower."""
    before = torch.get_num_threads()
    if device.type == "cpu" and before != count:
        torch.set_num_threads(count)
    try:
        yield
    finally:
        if torch.get_num_threads() != before:
            torch.set_num_threads(before)
