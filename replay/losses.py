"""Losses as Python warnings, for passes without a ledger: a second pass for images, or a fit.

As warnings, they reach the command without a ledger in every signature. The command prints them
and exits with status 3.
"""

import inspect
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

from .errors import LossWarning

T = TypeVar("T")
R = TypeVar("R")


def with_losses(work: Callable[[T], R], one: T) -> tuple[R, tuple[str, ...]]:
    """Return ``work(one)`` and its losses, for a worker process, whose warnings would be lost.

    The parent process issues them with ``warn_again``.
    """
    with losses_heard() as heard:
        result = work(one)
    return result, tuple(heard)


def warn_again(losses: Iterable[str]) -> None:
    """Issue warnings for losses that were collected in another process."""
    for loss in losses:
        warn_of_loss(loss)


def warn_of_loss(loss: str) -> None:
    """Issue a ``LossWarning`` at the line outside crosscue that led to it."""
    level, frame = 1, inspect.currentframe()
    while frame is not None and frame.f_globals.get("__name__", "").startswith("crosscue."):
        level, frame = level + 1, frame.f_back
    warnings.warn(loss, LossWarning, stacklevel=level)


@contextmanager
def losses_heard() -> Iterator[list[str]]:
    """Collect the loss warnings of the ``with`` block, each once, instead of printing them."""
    heard: list[str] = []
    with warnings.catch_warnings():
        warnings.simplefilter("always", LossWarning)
        before = warnings.showwarning

        def show(message: Warning | str, category: type[Warning], *rest: Any, **more: Any) -> None:
            if not isinstance(message, LossWarning):
                before(message, category, *rest, **more)
            elif str(message) not in heard:
                heard.append(str(message))

        warnings.showwarning = show
        yield heard
