"""Record the blocks of files that a log has read, so that they can be checked against a seal."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from io import BufferedReader, FileIO
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, Any, Final, TypeAlias

if TYPE_CHECKING:
    from _typeshed import WriteableBuffer

# Size of blocks as a power of two: 1 MiB, as in seals.
BLOCK_BITS: Final = 20

# Block numbers by file.
Blocks: TypeAlias = dict[Path, set[int]]


class Touched:
    """Record of the blocks read while a log is opened, and while listeners are active."""

    def __init__(self) -> None:
        """Begin with the blocks read while the log is opened."""
        self._lock: Final = Lock()
        self._listeners: list[Blocks] = [{}]
        self._opening: Blocks | None = self._listeners[0]

    def add(self, path: Path, start: int, size: int) -> None:
        """Record that ``size`` bytes of a file were read from byte ``start`` on; thread-safe."""
        if size <= 0 or not self._listeners:
            return
        blocks = range(start >> BLOCK_BITS, ((start + size - 1) >> BLOCK_BITS) + 1)
        with self._lock:
            for listener in self._listeners:
                listener.setdefault(path, set()).update(blocks)

    def of_opening(self) -> Blocks:
        """Return the blocks read while the log was opened; to be called once it is open."""
        with self._lock:
            self._listeners = [one for one in self._listeners if one is not self._opening]
        return self._opening or {}

    @contextmanager
    def listened(self) -> Iterator[Blocks]:
        """Collect the blocks read within a ``with`` block; ``taken`` empties the collection."""
        own: Blocks = {}
        with self._lock:
            self._listeners.append(own)
        try:
            yield own
        finally:
            with self._lock:
                self._listeners = [one for one in self._listeners if one is not own]

    def taken(self, listener: Blocks) -> Blocks:
        """Return the blocks of a listener since the last call."""
        with self._lock:
            heard = dict(listener)
            listener.clear()
        return heard


class _RecordedFile(FileIO):
    """File that records which of its bytes are read."""

    def __init__(self, path: Path, touched: Touched) -> None:
        super().__init__(path, "rb")
        self._path: Final = path
        self._touched: Final = touched

    def readinto(self, buffer: WriteableBuffer, /) -> int | None:
        at = self.tell()
        size = super().readinto(buffer)
        self._touched.add(self._path, at, size or 0)
        return size

    def read(self, size: int | None = -1, /) -> bytes | Any:
        at = self.tell()
        found = super().read(size)
        self._touched.add(self._path, at, len(found))
        return found

    def readall(self) -> bytes | Any:
        return self.read()


def open_noted(path: Path, touched: Touched, buffering: int = 1 << 13) -> BufferedReader:
    """Open a file for reading, and record all reads.

    Raises:
        OSError: It cannot be opened.
    """
    return BufferedReader(_RecordedFile(path, touched), buffering)
