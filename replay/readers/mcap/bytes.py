"""A file's bytes by position, read (never mapped) so that a shrinking file is a short read."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from sys import getrefcount
from threading import Event, Lock
from typing import Final

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.files.checksum import crc32
from crosscue.replay.remote.ranges import RangedFile
from crosscue.replay.seal.touched import Touched

from .records import BrokenRecordError

WINDOW: Final = 64 << 10
PIECE: Final = 1 << 20
STEP: Final = 256 << 10
KEPT: Final = 8
"""Buffers kept for use again ..."""
KEPT_BYTES: Final = 8 << 20
"""... unless they are larger than this."""


class Buffers:
    """Memory that is used again once nothing refers to it any more.

    Fresh memory costs as much as reading into it. An array handed out is used again when the only
    references to it left are those here: every view of it holds one.
    """

    def __init__(self) -> None:
        self._lock = Lock()
        self._owned: list[NDArray[np.uint8]] = []

    def take(self, size: int) -> NDArray[np.uint8]:
        """An array of shape (size,) with any content; safe from any thread."""
        with self._lock:
            best: int | None = None
            for i in range(len(self._owned)):
                has = len(self._owned[i])
                # Two: the list's reference and the argument's.
                if has < size or getrefcount(self._owned[i]) != 2:
                    continue
                if best is None or has < len(self._owned[best]):
                    best = i
            if best is not None:
                return self._owned[best][:size]
            owner = np.empty(-(-size // STEP) * STEP, dtype=np.uint8)
            if len(self._owned) < KEPT and size <= KEPT_BYTES:
                self._owned.append(owner)
            return owner[:size]


class ByteFile:
    """An open file. ``peek`` is for one thread; ``read`` and ``crc`` are for any."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file = path.open("rb", buffering=0)
        self.touched = Touched()
        self.size = os.fstat(self._file.fileno()).st_size
        self._window = b""
        self._window_at = 0
        self.buffers = Buffers()

    def peek(self, at: int, size: int) -> memoryview:
        """Up to ``size`` bytes at ``at``, from a window that is read ahead; shorter at the end.

        Raises:
            BrokenRecordError: The disk reports an error.
        """
        return self.window(at, size)[:size]

    def window(self, at: int, min_bytes: int) -> memoryview:
        """What is at hand from ``at`` on: at least ``min_bytes`` bytes, less only at the end."""
        begin = at - self._window_at
        if begin < 0 or begin + min_bytes > len(self._window):
            self._window = self._pread(at, max(min_bytes, WINDOW))
            self._window_at, begin = at, 0
        return memoryview(self._window)[begin:]

    def read(self, at: int, size: int) -> NDArray[np.uint8]:
        """Up to ``size`` bytes at ``at``, as an array of its own, shape (size,) or less at the end.

        Raises:
            BrokenRecordError: The disk reports an error.
        """
        return self.read_into(at, self.buffers.take(max(0, min(size, self.size - at))))

    def read_into(self, at: int, array: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The bytes at ``at``, written into ``array``; fewer than it has at the end.

        Raises:
            BrokenRecordError: The disk reports an error.
        """
        size, view, done = len(array), array.data, 0
        while done < size:
            try:
                step = os.preadv(self._file.fileno(), [view[done:]], at + done)
            except OSError as error:
                raise BrokenRecordError(f"the disk says: {error.strerror}") from None
            if not step:
                break
            done += step
        self.touched.add(self._path, at, done)
        return array[:done]

    def crc(self, begin: int, end: int, stop: Event | None = None) -> int | None:
        """CRC-32 of the bytes from ``begin`` to ``end``; None if they cannot all be read."""
        value, at = 0, begin
        while at < end:
            if stop is not None and stop.is_set():
                return None
            try:
                piece = self._pread(at, min(PIECE, end - at))
            except BrokenRecordError:
                return None
            if not piece:
                return None
            value, at = crc32(piece, value), at + len(piece)
        return value

    def expect(self, ranges: Sequence[tuple[int, int]]) -> None:
        """These ranges, sorted, are going to be read: nothing to do for a file on a disk."""

    def close(self) -> None:
        """Release the file; later reads raise ValueError."""
        self._file.close()

    def _pread(self, at: int, size: int) -> bytes:
        if at >= self.size:  # also where a damaged length leads, beyond what a file can hold
            return b""
        try:
            found = os.pread(self._file.fileno(), size, at)
        except OSError as error:
            raise BrokenRecordError(f"the disk says: {error.strerror}") from None
        self.touched.add(self._path, at, len(found))
        return found


class RangedByteFile(ByteFile):
    """The same of a remote object, of which only what is read is fetched."""

    def __init__(self, ranged: RangedFile) -> None:
        self._ranged = ranged
        self.touched = Touched()
        self.size = ranged.size
        self.buffers = Buffers()

    def window(self, at: int, min_bytes: int) -> memoryview:
        """What is at hand from ``at`` on: at least ``min_bytes`` bytes, less only at the end."""
        return self._ranged.at_least(at, min_bytes)

    def read_into(self, at: int, array: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The bytes at ``at``, written into ``array``; fewer than it has at the end."""
        found = self._ranged.at_least(at, len(array))[: len(array)]
        array[: len(found)] = np.frombuffer(found, dtype=np.uint8)
        return array[: len(found)]

    def expect(self, ranges: Sequence[tuple[int, int]]) -> None:
        """These ranges, sorted, are going to be read, and may be fetched in larger pieces."""
        self._ranged.expect(ranges)

    def close(self) -> None:
        """Release the connection."""
        self._ranged.close()

    def _pread(self, at: int, size: int) -> bytes:
        return bytes(self._ranged.at_least(at, size)[:size])
