"""Pool the rows of many drives."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.columns import Floats

# Edges of the bins of true range.
BINS_M: Final = (0.0, 10.0, 20.0, 30.0, 40.0, 60.0, 80.0, 120.0)


def sum_counts(counts: Iterable[Mapping[str, int]]) -> dict[str, int]:
    """Return the sums of counts by reason."""
    return dict(sum(map(Counter, counts), Counter[str]()))


def first_reasons(
    rows: NDArray[np.bool_], reasons: Mapping[str, NDArray[np.bool_]]
) -> tuple[NDArray[np.bool_], dict[str, int]]:
    """Remove rows for reasons; each row is counted for the first reason that applies.

    Args:
        rows: Shape (N,): the initial rows.
        reasons: Mask by reason, shape (N,): rows that it applies to.

    Returns:
        The remaining rows, and the numbers of rows removed by reason, if not zero.
    """
    counts: dict[str, int] = {}
    for reason, holds in reasons.items():
        gone = int((rows & holds).sum())
        if gone:
            counts[reason] = gone
        rows = rows & ~holds
    return rows, counts


def distance_bins(distance_m: Floats, borders_m: Sequence[float]) -> dict[str, NDArray[np.bool_]]:
    """Return the rows of each half-open bin, as masks; every row is in exactly one bin."""
    found = {f"under {borders_m[0]:g}": distance_m < borders_m[0]}
    for low, high in pairwise(borders_m):
        found[f"{low:g}-{high:g}"] = (distance_m >= low) & (distance_m < high)
    found[f"over {borders_m[-1]:g}"] = distance_m >= borders_m[-1]
    found["unknown"] = np.isnan(distance_m)
    return found
