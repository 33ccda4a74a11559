"""Detectors that stop the program, as a user or the system does."""

from __future__ import annotations

import signal
from collections.abc import Sequence
from dataclasses import dataclass

from crosscue.detectors.base import Found, Frame, View, nothing_found


@dataclass(frozen=True, slots=True)
class Stopping:
    """Sends its own process a signal at the first frame."""

    number: signal.Signals

    @property
    def view(self) -> View:
        """Grey."""
        return View(is_grey=True)

    @property
    def identity(self) -> str:
        """Of this signal."""
        return f"stopping by {self.number.name}"

    def __call__(self, frames: Sequence[Frame], /) -> Sequence[Found]:
        """Stop. A shell that started the tests in its background had the interrupt ignored."""
        if self.number == signal.SIGINT:
            signal.signal(signal.SIGINT, signal.default_int_handler)
        signal.raise_signal(self.number)
        return [nothing_found(frame) for frame in frames]


def interrupted() -> Stopping:
    """As control-C."""
    return Stopping(signal.SIGINT)


def terminated() -> Stopping:
    """As ``kill``."""
    return Stopping(signal.SIGTERM)
