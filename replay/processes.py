"""Apply a function to many items in parallel, with results in order.

Batches of drives use ``eval/batch`` instead, because it survives the death of a worker process.
"""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from typing import TypeVar

from .losses import warn_again, with_losses

T = TypeVar("T")
R = TypeVar("R")


def in_processes(work: Callable[[T], R], things: Sequence[T], workers: int) -> Iterator[R]:
    """Yield ``work(thing)`` for each of ``things``, in order, as results become available.

    Loss warnings of the worker processes are issued again in this process.

    Args:
        work: An importable function, or a ``partial`` of one.
        things: Picklable arguments.
        workers: Number of processes; with 1, or for a single item, this process does the work.
    """
    if workers == 1 or len(things) <= 1:
        yield from map(work, things)
        return
    # A fork would copy locks held by threads of libraries.
    fresh = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(workers, len(things)), mp_context=fresh) as pool:
        for result, losses in pool.map(partial(with_losses, work), things):
            warn_again(losses)
            yield result
