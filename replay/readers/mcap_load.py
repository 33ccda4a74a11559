"""Chunks read, decompressed and verified on other threads, handed back in order."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from threading import Event
from typing import Final, Self

from crosscue.replay.columns import Bytes
from crosscue.replay.limits import Limits

from .mcap_bytes import ByteFile
from .mcap_inflate import inflate, inflate_prefix
from .mcap_records import BrokenRecordError
from .mcap_segments import Segment
from .mcap_walk import Chunk, Item

WORKERS: Final = 1
"""One hides most of the work; each more costs more in handing over the interpreter."""
AHEAD: Final = 4
"""Chunks under way at once ..."""
AHEAD_BYTES: Final = 32 << 20
"""... unless they are larger than this together."""


class Loader:
    """Loads chunks ahead of their use; results do not depend on timing."""

    def __init__(self, file: ByteFile, limits: Limits) -> None:
        self._file = file
        self._limits = limits
        self._pool = ThreadPoolExecutor(WORKERS, thread_name_prefix="mcap")
        self._stop = Event()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._pool.shutdown(wait=True, cancel_futures=True)

    def ahead(
        self, items: Iterator[Item], wanted: Callable[[Chunk], bool]
    ) -> Iterator[tuple[Item, Future[Bytes] | None]]:
        """The items in order, each wanted chunk with its records to come.

        The future's result is the chunk's records, or it raises BrokenRecordError.
        """
        queue: deque[tuple[Item, Future[Bytes] | None, int]] = deque()
        under_way = 0
        for item in items:
            future, size = None, 0
            if isinstance(item, Chunk) and wanted(item):
                size = 0 if item.head is None else item.head.size
                future = self._pool.submit(self.load, item)
            queue.append((item, future, size))
            under_way += size
            while len(queue) > AHEAD or under_way > AHEAD_BYTES:
                first, future, size = queue.popleft()
                under_way -= size
                yield first, future
        for first, future, _ in queue:
            yield first, future

    def section_crc(self, segment: Segment) -> Future[int | None]:
        """The checksum of a segment's data section, computed from its bytes."""
        return self.crc(segment.base, segment.end)

    def crc(self, begin: int, end: int) -> Future[int | None]:
        """The checksum of the bytes from ``begin`` to ``end``."""
        return self._pool.submit(self._file.crc, begin, end, self._stop)

    def load(self, chunk: Chunk) -> Bytes:
        """The records of a chunk: all of them verified, or what a cut one begins with.

        Raises:
            BrokenRecordError: Not as declared, or over the limits.
        """
        head = chunk.head
        if chunk.fault or head is None:
            raise BrokenRecordError(chunk.fault or "its fields cannot be read")
        most = self._limits.chunk_bytes
        if max(head.size, min(head.body_size, self._file.size)) > most:
            raise BrokenRecordError(
                f"declares {max(head.size, head.body_size)} bytes, the limit is {most}"
            )
        body = self._file.read(chunk.body_at, head.body_size)
        return (
            inflate_prefix(body, head) if chunk.is_cut else inflate(body, head, self._file.buffers)
        )
