"""Byte ranges of a remote object, fetched on demand with a bounded read-ahead.

A reader announces the ranges that it is going to read (``expect``). Within these, pieces of up to
4 MiB are fetched at once. Elsewhere a small read-ahead is added, which doubles for sequential
reads. Nothing is fetched twice: a replay reads its window several times, so data that no longer
fits into memory moves to a sparse temporary file, as long as the disk has space. A failed request
is retried a few times, but one that the store does not answer in time is not. A short response, or
an object whose size or version has changed, is an error.
"""

import os
import tempfile
import time
import warnings
from bisect import bisect_left, bisect_right
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from threading import Lock, Thread
from typing import BinaryIO, Final, TypeVar

from crosscue.replay.errors import CrosscueError, LogError, one_line

from .address import LogAddress

NOTICE_S: Final = 5.0
# Longest time for one request, of at most 4 MiB: 70 kB/s suffice.
LIMIT_S: Final = 60.0

T = TypeVar("T")


def answered(url: str, ask: Callable[[], T]) -> T:
    """Return ``ask()``, a request to a store, run in a thread because not all have a time limit.

    Raises:
        LogError: There is no result after ``LIMIT_S``.
    """
    results: list[T] = []
    errors: list[BaseException] = []

    def request() -> None:
        try:
            results.append(ask())
        except BaseException as error:
            errors.append(error)

    thread = Thread(target=request, name="crosscue store request", daemon=True)
    thread.start()
    thread.join(NOTICE_S)
    if thread.is_alive():
        waiting = f"no answer to a request for {NOTICE_S:g} s; it ends after {LIMIT_S:g} s"
        warnings.warn(f"{url}: {waiting}", RuntimeWarning, stacklevel=2)
        thread.join(LIMIT_S - NOTICE_S)
    for error in errors:
        raise error
    if not results:
        raise LogError(f"{url}: no answer to a request for {LIMIT_S:g} s; check the connection")
    return results[0]


PIECE: Final = 4 << 20
AHEAD: Final = 8 << 10
MAX_AHEAD: Final = 512 << 10
KEPT: Final = 64
KEPT_BYTES: Final = 32 << 20
# Waiting times before each retry of a failed request.
WAITS_S: Final = (0.1, 0.5, 2.0)


class Spool:
    """A cache of byte ranges in a sparse temporary file, which is deleted when closed."""

    def __init__(self, folder: Path, max_bytes: int) -> None:
        """Configure an empty cache; the file is created on the first write.

        Args:
            folder: Folder of the file; created if it does not exist.
            max_bytes: Maximum number of bytes to store; further data is not stored.
        """
        self._folder: Final = folder
        self._left = max_bytes
        self._file: BinaryIO | None = None
        self._begins: list[int] = []
        self._ends: list[int] = []

    def put(self, at: int, content: memoryview) -> None:
        """Store bytes; they are discarded if the disk is full or the limit is exceeded."""
        end = at + len(content)
        if self.end_at(at) >= end or len(content) > self._left:
            return
        try:
            if self._file is None:
                self._folder.mkdir(parents=True, exist_ok=True)
                self._file = tempfile.TemporaryFile(dir=self._folder)  # noqa: SIM115
            done = 0
            while done < len(content):
                done += os.pwrite(self._file.fileno(), content[done:], at + done)
        except OSError:
            self._left = 0
            return
        self._left -= len(content)
        # Merge all spans that touch the new one.
        first, last = bisect_left(self._ends, at), bisect_right(self._begins, end)
        begin = min([at, *self._begins[first:last]])
        end = max([end, *self._ends[first:last]])
        self._begins[first:last], self._ends[first:last] = [begin], [end]

    def end_at(self, at: int) -> int:
        """Return the end of the stored span that contains ``at``, else ``at``."""
        place = bisect_right(self._begins, at) - 1
        return max(at, self._ends[place]) if place >= 0 else at

    def next_at(self, at: int) -> int:
        """Return the start of the next stored span after ``at``; ``at`` if none exists."""
        place = bisect_right(self._begins, at)
        return self._begins[place] if place < len(self._begins) else at

    def read(self, at: int, size: int) -> bytes:
        """Return stored bytes; empty if the disk fails, so that they are fetched again."""
        if self._file is None:
            return b""
        try:
            return os.pread(self._file.fileno(), size, at)
        except OSError:
            return b""

    def close(self) -> None:
        """Delete the file."""
        self._begins, self._ends = [], []
        if self._file is not None:
            self._file.close()
            self._file = None


class RangedFile:
    """Random access to a remote object; thread-safe.

    Attributes:
        url: URL of the object.
        size: Size in bytes, as reported by the store.
        transferred: Number of bytes fetched so far.
    """

    def __init__(
        self,
        url: LogAddress,
        size: int,
        opened: Callable[[], BinaryIO],
        changed: Callable[[], bool],
        spool: Spool,
    ) -> None:
        """Wrap a remote object.

        Args:
            url: URL of the object.
            size: Size in bytes, as reported by the store.
            opened: Opens the object; the file's reads must fetch exactly the requested bytes.
            changed: Queries the store and returns whether the size or version has changed.
            spool: Cache for data that no longer fits into memory; closed with this object.
        """
        self.url: Final = url
        self.size: Final = size
        self.transferred = 0
        self._opened: Final = opened
        self._changed: Final = changed
        self._spool: Final = spool
        self._file: BinaryIO | None = None
        self._lock: Final = Lock()
        self._kept: deque[tuple[int, memoryview]] = deque()
        self._expected: list[tuple[int, int]] = []
        self._next_at = -1
        self._ahead = AHEAD

    def expect(self, ranges: Sequence[tuple[int, int]]) -> None:
        """Announce the sorted ranges that are going to be read."""
        with self._lock:
            self._expected = list(ranges)

    def at_least(self, at: int, size: int) -> memoryview:
        """Return the available bytes from ``at`` on: at least ``size``, fewer only at the end.

        Raises:
            LogError: The object has changed, or cannot be reached.
        """
        end = min(at + size, self.size)
        if at >= end:
            return memoryview(b"")
        with self._lock:
            for begin, kept in self._kept:
                if begin <= at and end <= begin + len(kept):
                    return kept[at - begin :]
            return self._fetched(at, end)

    def verify(self) -> None:
        """Verify that the size and version have not changed since the object was opened.

        Raises:
            LogError: They differ, or the store cannot be queried.
        """
        if self._tried(self._changed, "its version"):
            raise LogError(f"{self.url}: changed while it was read; run again when it is written")

    def close(self) -> None:
        """Close the connection and delete cached data."""
        with self._lock:
            self._kept.clear()
            self._spool.close()
            if self._file is not None:
                self._file.close()
                self._file = None

    def _fetched(self, at: int, end: int) -> memoryview:
        """Return the bytes from ``at`` to ``end`` or beyond, and fetch those not yet available."""
        parts: list[memoryview] = []
        place = at
        while place < end:
            part = self._cached(place, end) or self._new(place, end)
            parts.append(part)
            place += len(part)
        whole = parts[0] if len(parts) == 1 else memoryview(b"".join(parts))
        self._kept.append((at, whole))
        while len(self._kept) > KEPT or (
            len(self._kept) > 1 and sum(len(kept) for _, kept in self._kept) > KEPT_BYTES
        ):
            self._spool.put(*self._kept.popleft())
        return whole

    def _cached(self, at: int, end: int) -> memoryview | None:
        """Return bytes from ``at`` on from memory or the temporary file; None if not cached."""
        for begin, kept in self._kept:
            if begin <= at < begin + len(kept):
                return kept[at - begin : end - begin]
        stop = min(self._spool.end_at(at), max(end, at + MAX_AHEAD))
        return memoryview(self._spool.read(at, stop - at)) if stop > at else None

    def _new(self, begin: int, end: int) -> memoryview:
        """Fetch bytes from ``begin`` up to the next cached byte."""
        stop = max(end, min(begin + self._reach(begin, end), self.size))
        held = [at for at, _ in self._kept] + [self._spool.next_at(begin)]
        stop = min([stop, *(at for at in held if at > begin)])
        found = self._tried(lambda: self._range(begin, stop), f"bytes {begin} to {stop}")
        self._next_at = stop
        return memoryview(found)

    def _reach(self, begin: int, end: int) -> int:
        """Return the number of bytes to fetch from ``begin`` on, including the read-ahead."""
        place = bisect_right(self._expected, (begin, self.size + 1)) - 1
        if place >= 0 and begin < self._expected[place][1]:
            return min(self._expected[place][1] - begin, PIECE)
        self._ahead = min(2 * self._ahead, MAX_AHEAD) if begin == self._next_at else AHEAD
        return end - begin + self._ahead

    def _range(self, begin: int, stop: int) -> bytes:
        if self._file is None:
            self._file = self._opened()
        self._file.seek(begin)
        found = self._file.read(stop - begin)
        self.transferred += len(found)
        if len(found) != stop - begin:
            raise OSError(f"{len(found)} of {stop - begin} bytes received")
        return bytes(found)

    def _tried(self, ask: Callable[[], T], what: str) -> T:
        """Return ``ask()``, with a few retries on any error of a store's library."""
        why = ""
        for wait_s in (0.0, *WAITS_S):
            time.sleep(wait_s)
            try:
                return answered(self.url, ask)
            except CrosscueError:
                raise
            except FileNotFoundError:
                why = "deleted while it was read; check the store"
                break
            except Exception as error:
                self._file = None
                why = (
                    f"{what} could not be read in {len(WAITS_S) + 1} tries "
                    f"({self.url.hide(f'{type(error).__name__}: {one_line(error)}')}); check "
                    "the connection"
                )
        # Raised here, so that it does not carry the library's error, whose text may hold secrets.
        raise LogError(f"{self.url}: {why}")
