"""The loops that Numba compiles. Imported only when they are wanted."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.columns import DATA, LENGTH_UNKNOWN

UNSIGNED: Final = 0
SIGNED: Final = 1
WHOLE_UNSIGNED: Final = 2
WHOLE_SIGNED: Final = 3
SINGLE: Final = 4
SINGLE_SCALED: Final = 5
DOUBLE: Final = 6
DOUBLE_SCALED: Final = 7
UNSIGNED_LONG: Final = 8


class Kernels(NamedTuple):
    """The compiled loops."""

    look_up: Callable[..., None]
    put_in_order: Callable[..., None]
    take_out: Callable[..., None]


@cache
def compiled() -> Kernels:
    """Compile, or load what an earlier process compiled."""
    from numba import njit

    loops = (look_up, put_in_order, take_out)
    try:
        return Kernels(*(njit(cache=True, nogil=True)(loop) for loop in loops))
    except RuntimeError:  # no folder to keep compiled code in
        return Kernels(*(njit(nogil=True)(loop) for loop in loops))


def look_up(  # noqa: D103
    arbitration_id: NDArray[np.uint32],
    is_extended: NDArray[np.bool_],
    kind: NDArray[np.uint8],
    length: NDArray[np.uint8],
    is_fd: NDArray[np.bool_],
    width: int,
    standard: NDArray[np.uint16],
    extended_ids: NDArray[np.uint32],
    extended_numbers: NDArray[np.uint16],
    shortest: NDArray[np.int16],
    longest: NDArray[np.int16],
    number: NDArray[np.uint16],
    is_good: NDArray[np.bool_],
    counts: NDArray[np.intp],
) -> None:
    for i in range(len(arbitration_id)):
        identifier = arbitration_id[i]
        if is_extended[i]:
            found = np.uint16(0)
            place = np.searchsorted(extended_ids, identifier)
            if place < len(extended_ids) and extended_ids[place] == identifier:
                found = extended_numbers[place]
        else:
            found = standard[min(int(identifier), len(standard) - 1)]
        number[i] = found
        stated = np.int64(length[i])
        most = np.int64(longest[1, found] if is_fd[i] else longest[0, found])
        # Without shortcuts: a branch that goes either way costs more than both its sides.
        fits = (stated <= most) | ((stated == LENGTH_UNKNOWN) & (most >= 0))
        good = (kind[i] == DATA) & (min(stated, width) >= shortest[found]) & fits
        is_good[i] = good
        counts[found if good else 0] += 1


def put_in_order(  # noqa: D103
    number: NDArray[np.uint16],
    is_good: NDArray[np.bool_],
    starts: NDArray[np.intp],
    words: NDArray[np.uint64],
    order: NDArray[np.intp],
    little: NDArray[np.uint64],
    big: NDArray[np.uint64],
) -> None:
    following = starts.copy()
    width = words.shape[1]
    for i in range(len(number)):
        if not is_good[i]:
            continue
        group = number[i]
        row = following[group]
        following[group] = row + 1
        order[row] = i
        for k in range(width):
            word = words[i, k]
            little[k, row] = word
            swapped = ((word & np.uint64(0x00FF00FF00FF00FF)) << np.uint64(8)) | (
                (word >> np.uint64(8)) & np.uint64(0x00FF00FF00FF00FF)
            )
            swapped = ((swapped & np.uint64(0x0000FFFF0000FFFF)) << np.uint64(16)) | (
                (swapped >> np.uint64(16)) & np.uint64(0x0000FFFF0000FFFF)
            )
            big[k, row] = (swapped << np.uint64(32)) | (swapped >> np.uint64(32))


def take_out(  # noqa: D103
    little: NDArray[np.uint64],
    big: NDArray[np.uint64],
    stops: NDArray[np.intp],
    counts: NDArray[np.intp],
    base: NDArray[np.intp],
    first: NDArray[np.intp],
    is_big: NDArray[np.bool_],
    word: NDArray[np.intp],
    bit: NDArray[np.uint64],
    length: NDArray[np.uint64],
    kind: NDArray[np.uint8],
    scale: NDArray[np.float64],
    offset: NDArray[np.float64],
    whole_scale: NDArray[np.uint64],
    whole_offset: NDArray[np.uint64],
    values: NDArray[np.float64],
    bits: NDArray[np.uint64],
) -> None:
    full = np.uint64(64)
    longest = counts[1:].max() if len(counts) > 1 else 0
    raw = np.empty(longest, np.uint64)  # its bits at the top, then at the bottom
    short = np.empty(longest, np.uint32)
    for group in range(1, len(counts)):
        n = counts[group]
        if n == 0:
            continue
        row = stops[group] - n
        for j in range(first[group], first[group + 1]):
            at = base[group] + (j - first[group]) * n
            k, b, drop = word[j], bit[j], full - length[j]
            a, c = scale[j], offset[j]
            words = big if is_big[j] else little
            if b + length[j] <= full:
                up = b if is_big[j] else drop - b
                for r in range(n):
                    raw[r] = words[k, row + r] << up
            elif is_big[j]:
                for r in range(n):
                    raw[r] = (words[k, row + r] << b) | (words[k + 1, row + r] >> (full - b))
            else:
                for r in range(n):
                    low, high = words[k, row + r] >> b, words[k + 1, row + r] << (full - b)
                    raw[r] = (low | high) << drop
            which = kind[j]
            if which == UNSIGNED:
                for r in range(n):
                    values[at + r] = np.float64(np.int64(raw[r] >> drop)) * a + c
            elif which == UNSIGNED_LONG:
                for r in range(n):
                    values[at + r] = np.float64(raw[r]) * a + c
            elif which == SIGNED:
                for r in range(n):
                    values[at + r] = np.float64(np.int64(raw[r]) >> np.int64(drop)) * a + c
            elif which == WHOLE_UNSIGNED:
                for r in range(n):
                    bits[at + r] = (raw[r] >> drop) * whole_scale[j] + whole_offset[j]
            elif which == WHOLE_SIGNED:
                for r in range(n):
                    number = np.uint64(np.int64(raw[r]) >> np.int64(drop))
                    bits[at + r] = number * whole_scale[j] + whole_offset[j]
            elif which in (SINGLE, SINGLE_SCALED):
                for r in range(n):
                    short[r] = np.uint32(raw[r] >> drop)
                singles = short.view(np.float32)
                for r in range(n):
                    single = np.float64(singles[r])
                    values[at + r] = single if which == SINGLE else single * a + c
            else:
                doubles = raw.view(np.float64)
                for r in range(n):
                    values[at + r] = doubles[r] if which == DOUBLE else doubles[r] * a + c
