"""One function for work on many things side by side, in their order.

Batches of drives have ``eval/batch``: it survives the death of a worker, which this does not.
"""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from typing import TypeVar

T = TypeVar("T")
R = TypeVar("R")


def in_processes(work: Callable[[T], R], things: Sequence[T], workers: int) -> Iterator[R]:
    """What ``work`` returns for each of ``things``, in order, as it becomes ready.

    Args:
        work: An importable function, or a ``partial`` of one.
        things: Picklable.
        workers: How many processes; with 1, or for one thing, this one works.
    """
    if workers == 1 or len(things) <= 1:
        yield from map(work, things)
        return
    # A fork would copy the locks of threads that libraries have started.
    fresh = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(workers, len(things)), mp_context=fresh) as pool:
        yield from pool.map(work, things)
