"""The loop of ``mcap_scan``, compiled; importing this module imports Numba."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray


def _walk(
    buffer: NDArray[np.uint8],
    stop_at: NDArray[np.bool_],
    offsets: NDArray[np.int64],
    opcodes: NDArray[np.uint8],
) -> tuple[int, int]:
    at = 0
    count = 0
    size = len(buffer)
    while at + 9 <= size and count < len(offsets):
        opcode = buffer[at]
        if opcode == 0 or stop_at[opcode]:
            break
        # More than five bytes of length are more than any buffer holds.
        if buffer[at + 6] or buffer[at + 7] or buffer[at + 8]:
            break
        length = 0
        for i in range(5, 0, -1):
            length = length * 256 + buffer[at + i]
        if length > size - at - 9:
            break
        offsets[count] = at
        opcodes[count] = opcode
        count += 1
        at += 9 + length
    return count, at


def _compile() -> object:
    try:
        return numba.njit(cache=True, nogil=True)(_walk)
    except RuntimeError:  # no folder that may be written to for the cache
        return numba.njit(nogil=True)(_walk)


walk = _compile()
