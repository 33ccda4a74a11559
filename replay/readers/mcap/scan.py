"""From one record to the next through a buffer, without an object per record.

A record says only where the next one begins, so this cannot be done on whole columns. A plain loop
serves small buffers; once ``PATIENCE`` records went through it, the loop compiled by Numba takes
over, whose import alone costs as much as some hundred thousand records.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, cast

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.columns import Bytes, Int64s

from .records import PREFIX

PATIENCE: Final = 300_000
"""Records that the plain loop may take before Numba is worth its import."""


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """The records of a buffer.

    Attributes:
        offset: Shape (N,), int64: where each record begins.
        opcode: Shape (N,), uint8.
        end: Where the last one ends: the buffer's size if they tile it, else where the first record
            begins that is not whole, has operation code 0, is one to stop at, or is one too many.
    """

    offset: Int64s
    opcode: NDArray[np.uint8]
    end: int


class Scanner:
    """Scans buffers; remembers how much the plain loop has done."""

    def __init__(self) -> None:
        self._done = 0

    def __call__(self, buffer: Bytes, stop_at: NDArray[np.bool_], most: int) -> Scan:
        """The records of ``buffer`` from its beginning.

        Args:
            buffer: Shape (B,).
            stop_at: Shape (256,), bool: operation codes before which to stop.
            most: Records after which to stop.
        """
        if "numba" in sys.modules or self._done + len(buffer) // 100 > PATIENCE:
            return _scan_compiled(buffer, stop_at, most)
        scan = _scan_plainly(buffer, stop_at, min(most, PATIENCE))
        self._done += len(scan.offset)
        if len(scan.offset) == PATIENCE < most:
            return _scan_compiled(buffer, stop_at, most)
        return scan


def _scan_plainly(buffer: Bytes, stop_at: NDArray[np.bool_], most: int) -> Scan:
    view, unpack = buffer.data, PREFIX.unpack_from
    stops = frozenset(np.flatnonzero(stop_at).tolist()) | {0}
    at, size, last = 0, len(buffer), len(buffer) - PREFIX.size
    offsets: list[int] = []
    opcodes = bytearray()
    while at <= last and len(offsets) < most:
        opcode, length = unpack(view, at)
        after = at + PREFIX.size + length
        if after > size or opcode in stops:
            break
        offsets.append(at)
        opcodes.append(opcode)
        at = after
    return Scan(np.array(offsets, dtype=np.int64), np.frombuffer(opcodes, dtype=np.uint8), at)


def _scan_compiled(buffer: Bytes, stop_at: NDArray[np.bool_], most: int) -> Scan:
    room = min(most, len(buffer) // PREFIX.size)
    offsets, opcodes = np.empty(room, dtype=np.int64), np.empty(room, dtype=np.uint8)
    count, end = _compiled()(buffer, stop_at, offsets, opcodes)
    return Scan(offsets[:count].copy(), opcodes[:count].copy(), end)


_Walk = Callable[[Bytes, NDArray[np.bool_], Int64s, NDArray[np.uint8]], tuple[int, int]]
_walk: _Walk | None = None


def _compiled() -> _Walk:
    global _walk
    if _walk is None:
        from .scan_numba import walk

        _walk = cast("_Walk", walk)
    return _walk
