"""The loops that Numba compiles. Imported only when they are wanted."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.columns import DATA

SHORT: Final = 9
UNSIGNED: Final = 0
SIGNED: Final = 1
WHOLE_UNSIGNED: Final = 2
WHOLE_SIGNED: Final = 3
SINGLE: Final = 4
SINGLE_SCALED: Final = 5
DOUBLE: Final = 6
DOUBLE_SCALED: Final = 7
UNSIGNED_LONG: Final = 8

EVEN_BYTES: Final = np.uint64(0x00FF_00FF_00FF_00FF)
EVEN_PAIRS: Final = np.uint64(0x0000_FFFF_0000_FFFF)


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
    standard: NDArray[np.uint16],
    extended_ids: NDArray[np.uint32],
    extended_numbers: NDArray[np.uint16],
    fits: NDArray[np.bool_],
    number: NDArray[np.uint16],
    is_good: NDArray[np.bool_],
    counts: NDArray[np.intp],
    seen: NDArray[np.intp],
    unknown: NDArray[np.intp],
    good_rows: NDArray[np.intp],
) -> None:
    # Counting without branches: one that goes either way costs more than both its sides.
    beyond = len(standard) - 1
    kept = 0
    for i in range(len(arbitration_id)):
        identifier = arbitration_id[i]
        if is_extended[i]:
            place, found = beyond, np.uint16(0)
            at = np.searchsorted(extended_ids, identifier)
            if at < len(extended_ids) and extended_ids[at] == identifier:
                found = extended_numbers[at]
        else:
            place = min(int(identifier), beyond)
            found = standard[place]
        is_data = kind[i] == DATA
        good = is_data & fits[int(is_fd[i]), found, length[i]]
        number[i] = found
        is_good[i] = good
        good_rows[kept] = i
        kept += int(good)
        counts[found] += int(good)
        seen[found] += int(is_data)
        unknown[place] += int(is_data & (found == 0))


def put_in_order(  # noqa: D103
    number: NDArray[np.uint16],
    good_rows: NDArray[np.intp],
    starts: NDArray[np.intp],
    words: NDArray[np.uint64],
    order: NDArray[np.intp],
    little: NDArray[np.uint64],
) -> None:
    following = starts.copy()
    width = words.shape[1]
    for i in good_rows:
        group = number[i]
        row = following[group]
        following[group] = row + 1
        order[row] = i
        for k in range(width):
            little[k, row] = words[i, k]


def take_out(  # noqa: D103
    little: NDArray[np.uint64],
    stops: NDArray[np.intp],
    counts: NDArray[np.intp],
    base: NDArray[np.intp],
    first: NDArray[np.intp],
    is_big: NDArray[np.bool_],
    word: NDArray[np.intp],
    bit: NDArray[np.uint64],
    length: NDArray[np.uint64],
    kind: NDArray[np.uint8],
    flip: NDArray[np.uint64],
    bias: NDArray[np.float64],
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
    big = np.empty((little.shape[0], longest), np.uint64)
    for group in range(1, len(counts)):
        n = counts[group]
        if n == 0:
            continue
        row = stops[group] - n
        if is_big[first[group] : first[group + 1]].any():
            for k in range(little.shape[0]):
                for r in range(n):
                    x = little[k, row + r]
                    x = ((x & EVEN_BYTES) << np.uint64(8)) | ((x >> np.uint64(8)) & EVEN_BYTES)
                    x = ((x & EVEN_PAIRS) << np.uint64(16)) | ((x >> np.uint64(16)) & EVEN_PAIRS)
                    big[k, r] = (x << np.uint64(32)) | (x >> np.uint64(32))
        for j in range(first[group], first[group + 1]):
            at = base[group] + (j - first[group]) * n
            k, b, drop = word[j], bit[j], full - length[j]
            a, c = scale[j], offset[j]
            # Rows of one word, so that the loops below run over contiguous memory.
            one = big[k, :n] if is_big[j] else little[k, row : row + n]
            if b + length[j] <= full:
                up = b if is_big[j] else drop - b
                for r in range(n):
                    raw[r] = one[r] << up
            elif is_big[j]:
                two = big[k + 1, :n]
                for r in range(n):
                    raw[r] = (one[r] << b) | (two[r] >> (full - b))
            else:
                two = little[k + 1, row : row + n]
                for r in range(n):
                    raw[r] = ((one[r] >> b) | (two[r] << (full - b))) << drop
            out, whole = values[at : at + n], bits[at : at + n]
            which = kind[j]
            if which == SHORT:
                turn, less = flip[j], bias[j]
                for r in range(n):
                    raw[r] = (raw[r] >> drop) ^ turn
                doubles = raw.view(np.float64)
                for r in range(n):
                    out[r] = (doubles[r] - less) * a + c
            elif which == UNSIGNED:
                for r in range(n):
                    out[r] = np.float64(np.int64(raw[r] >> drop)) * a + c
            elif which == UNSIGNED_LONG:
                for r in range(n):
                    out[r] = np.float64(raw[r]) * a + c
            elif which == SIGNED:
                for r in range(n):
                    out[r] = np.float64(np.int64(raw[r]) >> np.int64(drop)) * a + c
            elif which == WHOLE_UNSIGNED:
                for r in range(n):
                    whole[r] = (raw[r] >> drop) * whole_scale[j] + whole_offset[j]
            elif which == WHOLE_SIGNED:
                for r in range(n):
                    number = np.uint64(np.int64(raw[r]) >> np.int64(drop))
                    whole[r] = number * whole_scale[j] + whole_offset[j]
            elif which in (SINGLE, SINGLE_SCALED):
                for r in range(n):
                    short[r] = np.uint32(raw[r] >> drop)
                singles = short.view(np.float32)
                for r in range(n):
                    single = np.float64(singles[r])
                    out[r] = single if which == SINGLE else single * a + c
            else:
                doubles = raw.view(np.float64)
                for r in range(n):
                    out[r] = doubles[r] if which == DOUBLE else doubles[r] * a + c
