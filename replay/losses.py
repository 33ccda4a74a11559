"""Losses met where no account is kept: logs read again for their pictures, or for a fit.

Each is a Python warning, so that no caller has to pass a ledger along; a command prints them and
ends with exit status 3.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

from .errors import LossWarning

T = TypeVar("T")
R = TypeVar("R")


def with_losses(work: Callable[[T], R], one: T) -> tuple[R, tuple[str, ...]]:
    """What ``work`` makes of ``one``, and its losses: for another process, whose warnings are lost.

    The process that asked passes them on with ``warn_again``.
    """
    with losses_heard() as heard:
        result = work(one)
    return result, tuple(heard)


def warn_again(losses: Iterable[str]) -> None:
    """Warn here of losses met in another process."""
    for loss in losses:
        warnings.warn(loss, LossWarning, stacklevel=3)


@contextmanager
def losses_heard() -> Iterator[list[str]]:
    """The losses that are warned of within the ``with`` block, each once, instead of on stderr."""
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
