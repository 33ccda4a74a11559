"""Detectors that stop the program by a signal."""

import signal
from collections.abc import Sequence
from dataclasses import dataclass

from crosscue.detectors.base import Found, Frame, View, nothing_found


@dataclass(frozen=True, slots=True)
class Stopping:
    """A detector that sends a signal to its process at the first frame."""

    number: signal.Signals
    view = View(is_grey=True)

    @property
    def identity(self) -> str:
        """Identity of the signal."""
        return f"stopping by {self.number.name}"

    def __call__(self, frames: Sequence[Frame], /) -> Sequence[Found]:
        """Raise the signal; background jobs of a shell ignore interrupts, so the handler is set."""
        if self.number == signal.SIGINT:
            signal.signal(signal.SIGINT, signal.default_int_handler)
        signal.raise_signal(self.number)
        return [nothing_found(frame) for frame in frames]


def interrupted() -> Stopping:
    return Stopping(signal.SIGINT)


def terminated() -> Stopping:
    return Stopping(signal.SIGTERM)
