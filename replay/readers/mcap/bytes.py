"""Random access to a file's bytes by reading, so that a shrinking file causes only a short read."""

import os
from collections.abc import Sequence
from pathlib import Path
from sys import getrefcount
from threading import Event, Lock
from typing import Final

import numpy as np
from isal.isal_zlib import crc32
from numpy.typing import NDArray

from crosscue.replay.remote.ranges import RangedFile
from crosscue.replay.seal.touched import Touched

from .records import BrokenRecordError

WINDOW: Final = 64 << 10
PIECE: Final = 1 << 20
STEP: Final = 256 << 10
# Maximum number of buffers kept for reuse.
KEPT: Final = 8
# Maximum size of a buffer that is kept for reuse.
KEPT_BYTES: Final = 17 << 20


class Buffers:
    """A pool of buffers that are reused when nothing else refers to them.

    Allocating memory takes as long as reading into it. A buffer is reused when the pool has the
    only reference to it; every view of the buffer is a reference too.
    """

    def __init__(self) -> None:
        self._lock = Lock()
        self._owned: list[NDArray[np.uint8]] = []

    def take(self, size: int) -> NDArray[np.uint8]:
        """Return an array of shape (size,) with undefined contents; thread-safe."""
        with self._lock:
            best: int | None = None
            for i in range(len(self._owned)):
                has = len(self._owned[i])
                # Two references: the list's and the argument's.
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
    """An open file. ``read`` and ``crc`` are thread-safe; ``peek`` is not."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file = path.open("rb", buffering=0)
        self.touched = Touched()
        self.size = os.fstat(self._file.fileno()).st_size
        self._window = b""
        self._window_at = 0
        self.buffers = Buffers()

    def peek(self, at: int, size: int) -> memoryview:
        """Return up to ``size`` bytes at ``at`` from a read-ahead window; fewer at the end.

        Raises:
            BrokenRecordError: The disk reports an error.
        """
        return self.window(at, size)[:size]

    def window(self, at: int, min_bytes: int, ahead: int = WINDOW) -> memoryview:
        """Return available bytes from ``at`` on: at least ``min_bytes``, fewer only at the end.

        ``ahead`` is how many a local file reads if it has to.
        """
        begin = at - self._window_at
        if begin < 0 or begin + min_bytes > len(self._window):
            self._window = self._pread(at, max(min_bytes, ahead))
            self._window_at, begin = at, 0
        return memoryview(self._window)[begin:]

    def read(self, at: int, size: int) -> NDArray[np.uint8]:
        """Read up to ``size`` bytes at ``at`` into a separate array; shorter at the file's end.

        Raises:
            BrokenRecordError: The disk reports an error.
        """
        return self.read_into(at, self.buffers.take(max(0, min(size, self.size - at))))

    def read_into(self, at: int, array: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Read the bytes at ``at`` into ``array``; fewer than its size at the file's end.

        Raises:
            BrokenRecordError: The disk reports an error.
        """
        size, view, done = len(array), array.data, 0
        while done < size:
            try:
                step = os.preadv(self._file.fileno(), [view[done:]], at + done)
            except OSError as error:
                raise BrokenRecordError(f"reading failed: {error.strerror}") from None
            if not step:
                break
            done += step
        self.touched.add(self._path, at, done)
        return array[:done]

    def crc(self, begin: int, end: int, stop: Event | None = None) -> int | None:
        """Return the CRC-32 of the bytes from ``begin`` to ``end``; None if some are unreadable."""
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
        """Announce sorted ranges that are going to be read; a local file ignores them."""

    def close(self) -> None:
        """Close the file; later reads raise ``ValueError``."""
        self._file.close()

    def _pread(self, at: int, size: int) -> bytes:
        if at >= self.size:  # a damaged length may even lead beyond the maximum file size
            return b""
        try:
            found = os.pread(self._file.fileno(), size, at)
        except OSError as error:
            raise BrokenRecordError(f"reading failed: {error.strerror}") from None
        self.touched.add(self._path, at, len(found))
        return found


class RangedByteFile(ByteFile):
    """A remote object, of which only the bytes read are fetched."""

    def __init__(self, ranged: RangedFile) -> None:
        self._ranged = ranged
        self.touched = Touched()
        self.size = ranged.size
        self.buffers = Buffers()

    def window(self, at: int, min_bytes: int, ahead: int = WINDOW) -> memoryview:
        """Return available bytes from ``at`` on: at least ``min_bytes``, fewer only at the end."""
        return self._ranged.at_least(at, min_bytes)

    def read_into(self, at: int, array: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Read the bytes at ``at`` into ``array``; fewer than its size at the file's end."""
        found = self._ranged.at_least(at, len(array))[: len(array)]
        array[: len(found)] = np.frombuffer(found, dtype=np.uint8)
        return array[: len(found)]

    def expect(self, ranges: Sequence[tuple[int, int]]) -> None:
        """Announce sorted ranges that are going to be read, so that larger pieces are fetched."""
        self._ranged.expect(ranges)

    def close(self) -> None:
        """Close the connection."""
        self._ranged.close()

    def _pread(self, at: int, size: int) -> bytes:
        return bytes(self._ranged.at_least(at, size)[:size])
