"""Rows of many drives laid together."""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.columns import Int64s


def cluster_numbers(drives: Sequence[str], approaches: Sequence[Int64s]) -> Int64s:
    """One number for each approach of each drive, row by row over all drives.

    Args:
        drives: Names.
        approaches: For each drive, shape (N,): the approach that each row belongs to.
    """
    names: list[Hashable] = [
        (drive, one)
        for drive, rows in zip(drives, approaches, strict=True)
        for one in rows.tolist()
    ]
    numbers = {name: number for number, name in enumerate(dict.fromkeys(names))}
    return np.array([numbers[name] for name in names], np.int64)


def summed(counts: Iterable[Mapping[str, int]]) -> dict[str, int]:
    """Counts by reason, added up."""
    total: dict[str, int] = {}
    for one in counts:
        for reason, count in one.items():
            total[reason] = total.get(reason, 0) + count
    return total


def first_reasons(
    rows: NDArray[np.bool_], reasons: Mapping[str, NDArray[np.bool_]]
) -> tuple[NDArray[np.bool_], dict[str, int]]:
    """Take rows away for reasons; each row goes for the first reason that holds.

    Args:
        rows: Shape (N,): where to begin.
        reasons: From reason to shape (N,): whether it holds.

    Returns:
        The rows that stay, and how many went for each reason (none: not listed).
    """
    counts: dict[str, int] = {}
    for reason, holds in reasons.items():
        gone = int((rows & holds).sum())
        if gone:
            counts[reason] = gone
        rows = rows & ~holds
    return rows, counts
