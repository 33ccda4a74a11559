"""The loop over records of ``records``, compiled; importing this module imports Numba."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray


def _walk(
    buffer: NDArray[np.uint8],
    id_bytes: int,
    ids: NDArray[np.uint64],
    order: NDArray[np.int64],
    sizes: NDArray[np.int64],
    groups: NDArray[np.int64],
    starts: NDArray[np.int64],
) -> tuple[int, int, bool]:
    at = 0
    count = 0
    end = len(buffer)
    while at + id_bytes <= end and count < len(groups):
        identifier = np.uint64(0)
        for i in range(id_bytes - 1, -1, -1):
            identifier = (identifier << np.uint64(8)) | np.uint64(buffer[at + i])
        low = np.searchsorted(ids, identifier)
        if low == len(ids) or ids[low] != identifier:
            return count, at, True
        group = order[low]
        start = at + id_bytes
        size = sizes[group]
        if size < 0:
            if start + 4 > end:
                break
            size = 0
            for i in range(3, -1, -1):
                size = size * 256 + np.int64(buffer[start + i])
            start += 4
        if size > end - start:
            break
        groups[count] = group
        starts[count] = start
        count += 1
        at = start + size
    return count, at, False


def _compile() -> object:
    try:
        return numba.njit(cache=True, nogil=True)(_walk)
    except RuntimeError:  # no writable cache folder
        return numba.njit(nogil=True)(_walk)


walk = _compile()
