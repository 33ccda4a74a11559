"""Check of a SQLite write-ahead log, because SQLite silently ignores data after a damaged frame.

A frame consists of a header of 24 bytes and a page. Its checksum continues that of the previous
frame, so SQLite stops at the first frame that does not match. Section 4 of SQLite's file format
description defines the layout and the checksum.
"""

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

_HEADER: Final = struct.Struct(">8I")
_FRAME: Final = struct.Struct(">6I")
_MAGIC: Final = 0x377F0682
_MASK: Final = 0xFFFF_FFFF


@dataclass(frozen=True, slots=True)
class WalState:
    """The state of a write-ahead log.

    Attributes:
        frames: Number of complete frames of the current generation.
        sound: Number of frames before the first one that does not match its checksum.
        has_lost_commit: True if a transaction was committed at or after that frame.
    """

    frames: int
    sound: int
    has_lost_commit: bool


def check_wal(path: Path) -> WalState | None:
    """Check the frames of a write-ahead log; None if its header is damaged."""
    with path.open("rb") as file:
        head = file.read(_HEADER.size)
        if len(head) < _HEADER.size:
            return None
        magic, _, page_bytes, _, salt_1, salt_2, sum_1, sum_2 = _HEADER.unpack(head)
        if magic | 1 != _MAGIC | 1 or page_bytes < 512 or page_bytes > 65536 or page_bytes % 8:
            return None
        order = ">u4" if magic & 1 else "<u4"
        if _Checksum(3).after((0, 0), np.frombuffer(head[:24], dtype=order)) != (sum_1, sum_2):
            return None
        checksum = _Checksum((8 + page_bytes) // 8)
        state, frames, sound, has_lost_commit = (sum_1, sum_2), 0, 0, False
        while len(frame := file.read(_FRAME.size + page_bytes)) == _FRAME.size + page_bytes:
            page, commit, own_1, own_2, sum_1, sum_2 = _FRAME.unpack_from(frame)
            if (own_1, own_2) != (salt_1, salt_2):
                continue
            frames += 1
            if sound + 1 == frames and page:
                words = np.frombuffer(frame[:8] + frame[_FRAME.size :], dtype=order)
                state = checksum.after(state, words)
                if state == (sum_1, sum_2):
                    sound += 1
                    continue
            has_lost_commit |= commit != 0
    return WalState(frames, sound, has_lost_commit)


class _Checksum:
    """Vectorised running checksum over ``steps`` pairs of words.

    A pair (x, y) maps (s, t) to (s + t + x, s + 2 t + x + y) modulo 2^32. The map is linear, so the
    pairs contribute with powers of the matrix ((1, 1), (1, 2)).
    """

    def __init__(self, steps: int) -> None:
        powers = [(1, 0, 0, 1)]
        for _ in range(steps):
            a, b, c, d = powers[-1]
            powers.append(
                ((a + b) & _MASK, (a + 2 * b) & _MASK, (c + d) & _MASK, (c + 2 * d) & _MASK)
            )
        self._last = powers.pop()
        weights = np.array(powers[::-1], dtype=np.uint32).T
        self._weights: tuple[NDArray[np.uint32], ...] = tuple(weights)

    def after(self, state: tuple[int, int], words: NDArray[np.uint32]) -> tuple[int, int]:
        """Return the checksum after ``words``, starting from ``state``."""
        x = words[0::2].astype(np.uint32)
        xy = x + words[1::2].astype(np.uint32)
        a, b, c, d = self._weights
        first = int((a * x + b * xy).sum(dtype=np.uint32))
        second = int((c * x + d * xy).sum(dtype=np.uint32))
        (p, q, r, s), (u, v) = self._last, state
        return (p * u + q * v + first) & _MASK, (r * u + s * v + second) & _MASK
