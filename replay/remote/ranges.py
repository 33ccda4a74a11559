"""Ranges of one remote object, fetched when asked for, with a bounded read-ahead.

A reader says beforehand which ranges it is going to need (``expect``); within these, pieces of up
to 4 MiB are fetched at once. Elsewhere a little more than asked for is fetched, more each time that
the next read goes on where the last fetch ended. A lost connection is tried again a few times. A
range that comes back short, or an object whose size or version has changed, is an error.
"""

from __future__ import annotations

import time
from bisect import bisect_right
from collections import deque
from collections.abc import Callable, Sequence
from threading import Lock
from typing import BinaryIO, Final, TypeVar

from crosscue.replay.errors import CrosscueError, LogError, one_line

PIECE: Final = 4 << 20
AHEAD: Final = 8 << 10
AHEAD_MOST: Final = 512 << 10
KEPT: Final = 8
KEPT_BYTES: Final = 32 << 20
WAITS_S: Final = (0.1, 0.5, 2.0)
"""Before each further try after a lost connection."""

T = TypeVar("T")


class RangedFile:
    """A remote object by position; safe from any thread.

    Attributes:
        url: As the user gave it.
        size: Bytes, as the store says.
        transferred: Bytes fetched so far.
    """

    def __init__(
        self, url: str, size: int, opened: Callable[[], BinaryIO], changed: Callable[[], bool]
    ) -> None:
        """Take over an object.

        Args:
            url: As the user gave it.
            size: Bytes, as the store says.
            opened: Opens it; the file's reads must fetch exactly what they are asked for.
            changed: Asks the store whether size or version are no longer what they were.
        """
        self.url: Final = url
        self.size: Final = size
        self.transferred = 0
        self._opened: Final = opened
        self._changed: Final = changed
        self._file: BinaryIO | None = None
        self._lock: Final = Lock()
        self._kept: deque[tuple[int, memoryview]] = deque()
        self._expected: list[tuple[int, int]] = []
        self._next_at = -1
        self._ahead = AHEAD

    def expect(self, ranges: Sequence[tuple[int, int]]) -> None:
        """These ranges, sorted, are going to be read."""
        with self._lock:
            self._expected = list(ranges)

    def at_least(self, at: int, size: int) -> memoryview:
        """What is at hand from ``at`` on: at least ``size`` bytes, less only at the end.

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
        """Compare size and version with what they were when it was opened.

        Raises:
            LogError: They differ, or the store cannot be asked.
        """
        if self._tried(self._changed, "its version"):
            raise LogError(f"{self.url}: changed while it was read; run again when it is written")

    def close(self) -> None:
        """Release the connection."""
        with self._lock:
            self._kept.clear()
            if self._file is not None:
                self._file.close()
                self._file = None

    def _fetched(self, at: int, end: int) -> memoryview:
        """The bytes from ``at`` on, to ``end`` at least; what is at hand is not fetched again."""
        head = next((kept[at - b :] for b, kept in self._kept if b <= at < b + len(kept)), None)
        begin = at + len(head) if head is not None else at
        stop = max(end, min(begin + self._reach(begin, end), self.size))
        found = self._tried(lambda: self._range(begin, stop), f"bytes {begin} to {stop}")
        self._next_at = stop
        whole = memoryview(bytes(head) + found if head is not None else found)
        self._kept.append((at, whole))
        while len(self._kept) > KEPT or (
            len(self._kept) > 1 and sum(len(kept) for _, kept in self._kept) > KEPT_BYTES
        ):
            self._kept.popleft()
        return whole

    def _reach(self, begin: int, end: int) -> int:
        """How many bytes from ``begin`` on to fetch, if more than up to ``end``."""
        place = bisect_right(self._expected, (begin, self.size + 1)) - 1
        if place >= 0 and begin < self._expected[place][1]:
            return min(self._expected[place][1] - begin, PIECE)
        self._ahead = min(2 * self._ahead, AHEAD_MOST) if begin == self._next_at else AHEAD
        return end - begin + self._ahead

    def _range(self, begin: int, stop: int) -> bytes:
        if self._file is None:
            self._file = self._opened()
        self._file.seek(begin)
        found = self._file.read(stop - begin)
        self.transferred += len(found)
        if len(found) != stop - begin:
            raise OSError(f"{len(found)} of {stop - begin} bytes came")
        return bytes(found)

    def _tried(self, ask: Callable[[], T], what: str) -> T:
        """What ``ask`` gives, tried again a few times; each store's library has its own errors."""
        for wait_s in (*WAITS_S, None):
            try:
                return ask()
            except CrosscueError:
                raise
            except FileNotFoundError:
                raise LogError(f"{self.url}: gone while it was read; check the store") from None
            except Exception as error:
                self._file = None
                if wait_s is None:
                    raise LogError(
                        f"{self.url}: {what} could not be read in {len(WAITS_S) + 1} tries "
                        f"({type(error).__name__}: {one_line(error)}); check the connection"
                    ) from None
                time.sleep(wait_s)
        raise AssertionError("the last try returns or raises")
