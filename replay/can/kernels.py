"""The loops that Numba compiles. Numba caches the result for later processes where it can write.

Importing this module imports Numba.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, TypeVar, cast

import numpy as np
from numba import njit
from numpy.typing import NDArray

from crosscue.replay.columns import DATA

Loop = TypeVar("Loop", bound=Callable[..., None])

# Conversions of raw bits.
UNSIGNED: Final = 0
SIGNED: Final = 1
WHOLE_UNSIGNED: Final = 2
WHOLE_SIGNED: Final = 3
SINGLE: Final = 4
SINGLE_SCALED: Final = 5
DOUBLE: Final = 6
DOUBLE_SCALED: Final = 7
UNSIGNED_LONG: Final = 8
SHORT: Final = 9

EVEN_BYTES: Final = np.uint64(0x00FF_00FF_00FF_00FF)
EVEN_PAIRS: Final = np.uint64(0x0000_FFFF_0000_FFFF)


def compile_loop(loop: Loop) -> Loop:
    """Compile a loop at its first call, or load what an earlier process compiled."""
    try:
        return cast("Loop", njit(cache=True, nogil=True)(loop))
    except RuntimeError:  # there is no writable folder for compiled code
        return cast("Loop", njit(nogil=True)(loop))


@compile_loop
def look_up(
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
    """Find and check each frame's message, and write the results to the last six arrays."""
    # Counting is branch-free because an unpredictable branch costs more than both its sides.
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


@compile_loop
def put_in_order(
    number: NDArray[np.uint16],
    good_rows: NDArray[np.intp],
    starts: NDArray[np.intp],
    words: NDArray[np.uint64],
    order: NDArray[np.intp],
    little: NDArray[np.uint64],
) -> None:
    """Sort the good frames and their words by message."""
    following = starts.copy()
    width = words.shape[1]
    for i in good_rows:
        group = number[i]
        row = following[group]
        following[group] = row + 1
        order[row] = i
        for k in range(width):
            little[k, row] = words[i, k]


@compile_loop
def swap_bytes(words: NDArray[np.uint64], turned: NDArray[np.uint64]) -> None:
    """Reverse the bytes of each word."""
    for r in range(len(words)):
        x = words[r]
        x = ((x & EVEN_BYTES) << np.uint64(8)) | ((x >> np.uint64(8)) & EVEN_BYTES)
        x = ((x & EVEN_PAIRS) << np.uint64(16)) | ((x >> np.uint64(16)) & EVEN_PAIRS)
        turned[r] = (x << np.uint64(32)) | (x >> np.uint64(32))


@compile_loop
def align_left(
    words: NDArray[np.uint64],
    following: NDArray[np.uint64],
    is_big: bool,
    bit: np.uint64,
    length: np.uint64,
    raw: NDArray[np.uint64],
) -> None:
    """Move a signal's bits to the top of ``raw``; the bits below them are dropped later."""
    full = np.uint64(64)
    drop = full - length
    if bit + length <= full:
        up = bit if is_big else drop - bit
        for r in range(len(words)):
            raw[r] = words[r] << up
    elif is_big:
        for r in range(len(words)):
            raw[r] = (words[r] << bit) | (following[r] >> (full - bit))
    else:
        for r in range(len(words)):
            raw[r] = ((words[r] >> bit) | (following[r] << (full - bit))) << drop


@compile_loop
def to_floats(
    kind: np.uint8,
    raw: NDArray[np.uint64],
    drop: np.uint64,
    turn: np.uint64,
    less: np.float64,
    scale: np.float64,
    offset: np.float64,
    out: NDArray[np.float64],
) -> None:
    """Convert raw bits to physical values; ``raw`` is overwritten."""
    n = len(out)
    doubles = raw.view(np.float64)
    if kind == SHORT:
        for r in range(n):
            raw[r] = (raw[r] >> drop) ^ turn
        for r in range(n):
            out[r] = (doubles[r] - less) * scale + offset
    elif kind == UNSIGNED:
        for r in range(n):
            out[r] = np.float64(np.int64(raw[r] >> drop)) * scale + offset
    elif kind == UNSIGNED_LONG:
        for r in range(n):
            out[r] = np.float64(raw[r]) * scale + offset
    elif kind == SIGNED:
        for r in range(n):
            out[r] = np.float64(np.int64(raw[r]) >> np.int64(drop)) * scale + offset
    elif kind in (SINGLE, SINGLE_SCALED):
        # The bits are in the upper half of each little-endian word.
        singles = raw.view(np.float32)[1::2]
        for r in range(n):
            single = np.float64(singles[r])
            out[r] = single if kind == SINGLE else single * scale + offset
    else:
        for r in range(n):
            out[r] = doubles[r] if kind == DOUBLE else doubles[r] * scale + offset


@compile_loop
def to_whole(
    kind: np.uint8,
    raw: NDArray[np.uint64],
    drop: np.uint64,
    scale: np.uint64,
    offset: np.uint64,
    out: NDArray[np.uint64],
) -> None:
    """Convert raw bits to integers modulo 2**64."""
    if kind == WHOLE_SIGNED:
        for r in range(len(out)):
            out[r] = np.uint64(np.int64(raw[r]) >> np.int64(drop)) * scale + offset
    else:
        for r in range(len(out)):
            out[r] = (raw[r] >> drop) * scale + offset


@compile_loop
def extract_signals(
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
    """Extract all signals of all messages; ``bits`` shares its memory with ``values``."""
    width = little.shape[0]
    longest = counts[1:].max() if len(counts) > 1 else 0
    raw = np.empty(longest, np.uint64)
    big = np.empty((width, longest), np.uint64)
    for group in range(1, len(counts)):
        n = counts[group]
        if n == 0:
            continue
        row = stops[group] - n
        if is_big[first[group] : first[group + 1]].any():
            for k in range(width):
                swap_bytes(little[k, row : row + n], big[k, :n])
        for j in range(first[group], first[group + 1]):
            at = base[group] + (j - first[group]) * n
            k, after = word[j], min(word[j] + 1, width - 1)
            # One row per word, so that the loops run over contiguous memory.
            one = big[k, :n] if is_big[j] else little[k, row : row + n]
            two = big[after, :n] if is_big[j] else little[after, row : row + n]
            align_left(one, two, is_big[j], bit[j], length[j], raw[:n])
            drop = np.uint64(64) - length[j]
            if kind[j] in (WHOLE_UNSIGNED, WHOLE_SIGNED):
                out = bits[at : at + n]
                to_whole(kind[j], raw[:n], drop, whole_scale[j], whole_offset[j], out)
            else:
                real = values[at : at + n]
                turn, less = flip[j], bias[j]
                to_floats(kind[j], raw[:n], drop, turn, less, scale[j], offset[j], real)
