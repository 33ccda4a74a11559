"""One function for work on many things side by side, in their order.

Batches of drives have ``eval/batch``: it survives the death of a worker, which this does not.
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
    """What ``work`` returns for each of ``things``, in order, as it becomes ready.

    Losses that it warns of in another process are warned of here.

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
        for result, losses in pool.map(partial(with_losses, work), things):
            warn_again(losses)
            yield result
