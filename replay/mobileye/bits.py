"""Extract integers from the bits of many payloads at once, and write them.

A payload of up to 8 bytes is one 64-bit word, whose bit 0 is the lowest bit of byte 0.
"""

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

# Payloads, shape (N,).
Words: TypeAlias = NDArray[np.uint64]


def leading_words(payloads: NDArray[np.uint8]) -> Words:
    """Return the first 8 bytes of each row of ``payloads``, shape (N, W), as words."""
    first = np.ascontiguousarray(payloads[:, :8])
    return first.view("<u8").ravel().astype(np.uint64, copy=False)


def payloads_of(words: Words) -> NDArray[np.uint8]:
    """Return the words as bytes, shape (N, 8)."""
    return words.astype("<u8").view(np.uint8).reshape(-1, 8)


def extract(
    words: Words, start: int, bits: int, is_signed: bool, is_big_endian: bool
) -> NDArray[np.int64]:
    """Return bits ``start`` to ``start + bits - 1`` of each word.

    Big-endian numbers must consist of complete bytes; ``start`` is then the first bit of the first
    byte.
    """
    if is_big_endian:
        left = np.uint64(start)
        raised = words.byteswap() << left
    else:
        raised = words << np.uint64(64 - start - bits)
    drop = 64 - bits
    if is_signed:
        return raised.view(np.int64) >> np.int64(drop)
    return (raised >> np.uint64(drop)).view(np.int64)


def place_bits(raw: NDArray[np.int64], start: int, bits: int, is_big_endian: bool) -> Words:
    """Return words that hold the low ``bits`` bits of ``raw`` at ``start``; other bits are 0."""
    low = raw.view(np.uint64) & np.uint64((1 << bits) - 1)
    if is_big_endian:
        return (low << np.uint64(64 - start - bits)).byteswap()
    return low << np.uint64(start)
