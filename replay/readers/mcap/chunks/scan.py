"""From one record to the next through a buffer, without an object per record.

A record says only where the next one begins, so this cannot be done on whole columns. A plain loop
takes 0.15 us a record, a quarter of what reading it costs in all; the loop compiled by Numba was
faster from four million records on only, and took 140 MB of memory for its import.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.readers.mcap.records import PREFIX


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """The records of a buffer.

    Attributes:
        offset: Shape (N,), int64: where each record begins.
        opcode: Shape (N,), uint8.
        end: Where the last one ends: the buffer's size if they tile it, else where the first record
            begins that is not whole, has operation code 0, is one to stop at, or is one too many.
    """

    offset: NDArray[np.int64]
    opcode: NDArray[np.uint8]
    end: int


def scan_of(buffer: NDArray[np.uint8], stop_at: NDArray[np.bool_], max_records: int) -> Scan:
    """The records of ``buffer`` from its beginning.

    Args:
        buffer: Shape (B,).
        stop_at: Shape (256,), bool: operation codes before which to stop.
        max_records: Records after which to stop.
    """
    view, unpack = buffer.data, PREFIX.unpack_from
    stops = frozenset(np.flatnonzero(stop_at).tolist()) | {0}
    at, size, last = 0, len(buffer), len(buffer) - PREFIX.size
    offsets: list[int] = []
    opcodes = bytearray()
    while at <= last and len(offsets) < max_records:
        opcode, length = unpack(view, at)
        after = at + PREFIX.size + length
        if after > size or opcode in stops:
            break
        offsets.append(at)
        opcodes.append(opcode)
        at = after
    return Scan(np.array(offsets, dtype=np.int64), np.frombuffer(opcodes, dtype=np.uint8), at)
