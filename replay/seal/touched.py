"""Which parts of its files a log has read, in blocks, so that a seal can be held against them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from io import BufferedReader, FileIO
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, Any, Final, TypeAlias

if TYPE_CHECKING:
    from _typeshed import WriteableBuffer

BLOCK_BITS: Final = 20
"""Blocks of 1 MiB, as in seals."""

Blocks: TypeAlias = dict[Path, set[int]]
"""Numbers of blocks, by file."""


class Touched:
    """Collects the blocks read while opening, and those read while somebody listens."""

    def __init__(self) -> None:
        """Begin with what opening the log reads."""
        self._lock: Final = Lock()
        self._listeners: list[Blocks] = [{}]
        self._opening: Blocks | None = self._listeners[0]

    def add(self, path: Path, start: int, size: int) -> None:
        """``size`` bytes of a file were read from byte ``start`` on; safe from any thread."""
        if size <= 0 or not self._listeners:
            return
        blocks = range(start >> BLOCK_BITS, ((start + size - 1) >> BLOCK_BITS) + 1)
        with self._lock:
            for listener in self._listeners:
                listener.setdefault(path, set()).update(blocks)

    def of_opening(self) -> Blocks:
        """What opening the log has read; asked once, when it is open."""
        with self._lock:
            self._listeners = [one for one in self._listeners if one is not self._opening]
        return self._opening or {}

    @contextmanager
    def listened(self) -> Iterator[Blocks]:
        """Blocks read within the ``with`` block; emptied by ``taken``."""
        own: Blocks = {}
        with self._lock:
            self._listeners.append(own)
        try:
            yield own
        finally:
            with self._lock:
                self._listeners = [one for one in self._listeners if one is not own]

    def taken(self, listener: Blocks) -> Blocks:
        """What a listener has heard since it was last asked."""
        with self._lock:
            heard = dict(listener)
            listener.clear()
        return heard


class _Noted(FileIO):
    """A file that notes which of its bytes are read."""

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
    """A file opened for reading, whatever is read of it noted.

    Raises:
        OSError: It cannot be opened.
    """
    return BufferedReader(_Noted(path, touched), buffering)
