"""Waiting for a store: a warning when a request takes long, an error when it takes too long."""

import warnings
from collections.abc import Callable
from threading import Thread
from typing import Final, TypeVar

from crosscue.replay.errors import LogError

NOTICE_S: Final = 5.0
# Longest time for one request, of at most 4 MiB: 70 kB/s suffice.
LIMIT_S: Final = 60.0

T = TypeVar("T")


def answered(url: str, ask: Callable[[], T]) -> T:
    """Return ``ask()``, a request to a store, run in a thread because not all have a time limit.

    Raises:
        LogError: There is no result after ``LIMIT_S``.
    """
    results: list[T] = []
    errors: list[BaseException] = []

    def request() -> None:
        try:
            results.append(ask())
        except BaseException as error:
            errors.append(error)

    thread = Thread(target=request, name="crosscue store request", daemon=True)
    thread.start()
    thread.join(NOTICE_S)
    if thread.is_alive():
        waiting = f"no answer to a request for {NOTICE_S:g} s; it ends after {LIMIT_S:g} s"
        warnings.warn(f"{url}: {waiting}", RuntimeWarning, stacklevel=2)
        thread.join(LIMIT_S - NOTICE_S)
    for error in errors:
        raise error
    if not results:
        raise LogError(f"{url}: no answer to a request for {LIMIT_S:g} s; check the connection")
    return results[0]
