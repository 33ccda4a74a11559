"""Progress of long work, and parts of its result, for whoever watches it.

Work calls ``emit``; the command line draws a line or prints the part, and ``watching`` passes both
to a function. Without a watcher, nothing happens. No signature contains a callback for it.
"""

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True, slots=True)
class Progress:
    """Progress of the work.

    Attributes:
        doing: The work, as a participle such as "converting".
        done: Amount done.
        total: Amount to do; None or 0 where unknown.
        unit: Unit of both, as a plural noun.
    """

    doing: str
    done: float
    total: float | None
    unit: str


@dataclass(frozen=True, slots=True)
class Notice:
    """A remark on the work, for stderr.

    Attributes:
        text: One sentence.
    """

    text: str


Watcher = Callable[[object], None]
_WATCHER: Final[ContextVar[tuple[int, Watcher] | None]] = ContextVar("watcher", default=None)


def emit(event: object) -> None:
    """Report progress, a finished part of the result, or an error that does not stop the work."""
    found = _WATCHER.get()
    # A forked worker inherits the watcher, but has no terminal of its own.
    if found is not None and found[0] == os.getpid():
        found[1](event)


@contextmanager
def watching(watcher: Watcher) -> Iterator[None]:
    """Call ``watcher`` with everything that work in the ``with`` block emits.

    Args:
        watcher: Called with a ``Progress`` many times, with each part of a result that is finished
            before the rest, and with a ``CrosscueError`` for each part that is left out.
    """
    before = _WATCHER.set((os.getpid(), watcher))
    try:
        yield
    finally:
        _WATCHER.reset(before)
