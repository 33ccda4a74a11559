"""Loading of chunks in order: reading, decompression and verification.

Chunks with a high compression ratio are loaded ahead on another thread. Other chunks (uncompressed
data, images) are loaded when used, because handing them over would take longer. Consecutive small
chunks are loaded into one buffer, so that their messages form common blocks.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from threading import Event
from typing import TYPE_CHECKING, Final, Self

from crosscue.replay.columns import Bytes
from crosscue.replay.limits import Limits
from crosscue.replay.readers.mcap.bytes import ByteFile
from crosscue.replay.readers.mcap.chunks.inflate import inflate_chunk, inflate_prefix
from crosscue.replay.readers.mcap.records import BrokenRecordError
from crosscue.replay.readers.mcap.walk import Item, UnreadChunk

if TYPE_CHECKING:
    from concurrent.futures import Future, ThreadPoolExecutor

# Number of threads. One hides most of the work; more would only compete for the interpreter.
WORKERS: Final = 1
# Maximum number of groups of chunks, or other items, that are loaded ahead.
AHEAD: Final = 2
# Maximum total size of the groups that are loaded ahead.
AHEAD_BYTES: Final = 32 << 20
# Maxima of a group of chunks: a block of many rows takes little longer than one of few, as long as
# its columns fit into the processor's cache.
GROUP_BYTES: Final = 16 << 20
GROUP_CHUNKS: Final = 64
GROUP_ROWS: Final = 1 << 15
# Size up to which a checksum is computed at once.
SMALL_BYTES: Final = 1 << 20
# Compression ratio above which decompression takes longer than the handover to a thread.
WORTHWHILE: Final = 1.5


@dataclass(slots=True, eq=False)
class ChunkRecords:
    """The records of one chunk within a buffer: bytes ``begin`` to ``end`` of ``whole``."""

    whole: Bytes
    begin: int
    end: int

    @property
    def records(self) -> Bytes:
        """The records of the chunk."""
        return self.whole[self.begin : self.end]


@dataclass(slots=True, eq=False)
class ChunkGroup:
    """Chunks that are loaded together.

    Attributes:
        chunks: The chunks.
        begins: Offset of each chunk's records in ``whole``.
        size: Total size of the records in bytes.
        rows: Number of their messages, by the indexes.
        whole: Buffer of the records, once the first chunk is loaded.
        future: The records or the error of each chunk, if another thread loads them.
    """

    chunks: list[UnreadChunk] = field(default_factory=list)
    begins: list[int] = field(default_factory=list)
    size: int = 0
    rows: int = 0
    whole: Bytes | None = None
    future: Future[list[ChunkRecords | BrokenRecordError]] | None = None

    def add(self, chunk: UnreadChunk) -> None:
        """Add a chunk."""
        self.chunks.append(chunk)
        self.begins.append(self.size)
        self.size += _size(chunk)
        self.rows += _rows(chunk)

    def has_room_for(self, chunk: UnreadChunk) -> bool:
        """Return whether ``chunk`` can be loaded together with the others."""
        if not self.chunks:
            return True
        if not _is_plain_case(chunk) or not _is_plain_case(self.chunks[-1]):
            return False
        if len(self.chunks) == GROUP_CHUNKS or self.rows + _rows(chunk) > GROUP_ROWS:
            return False
        return self.size + _size(chunk) <= GROUP_BYTES


@dataclass(slots=True)
class Load:
    """One chunk of a group."""

    loader: Loader
    group: ChunkGroup
    number: int

    @property
    def is_last(self) -> bool:
        """True for the last chunk of the group."""
        return self.number + 1 == len(self.group.chunks)

    def stretch(self) -> ChunkRecords:
        """Return the chunk's records.

        Raises:
            BrokenRecordError: They contradict the header, or exceed the limits.
        """
        group = self.group
        future = group.future
        if self.is_last:
            group.future = None
        if future is None:
            return self.loader.load_of(group, self.number)
        found = future.result()[self.number]
        if isinstance(found, BrokenRecordError):
            raise found
        return found


class Loader:
    """Loads chunks; results are independent of the timing of threads."""

    def __init__(self, file: ByteFile, limits: Limits) -> None:
        self._file = file
        self._limits = limits
        self._threads: ThreadPoolExecutor | None = None
        self._stop = Event()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        if self._threads is not None:
            self._threads.shutdown(wait=True, cancel_futures=True)

    @property
    def _pool(self) -> ThreadPoolExecutor:
        if self._threads is None:
            from concurrent.futures import ThreadPoolExecutor  # a short log needs no threads

            self._threads = ThreadPoolExecutor(WORKERS, thread_name_prefix="mcap")
        return self._threads

    def ahead(
        self, items: Iterator[Item], wanted: Callable[[UnreadChunk], bool]
    ) -> Iterator[tuple[Item, Load | None]]:
        """Yield the items in order, each selected chunk with its load in progress."""
        queue: deque[tuple[list[tuple[Item, Load | None]], ChunkGroup]] = deque()
        entries: list[tuple[Item, Load | None]] = []
        group = ChunkGroup()
        under_way = 0
        for item in items:
            is_wanted = isinstance(item, UnreadChunk) and wanted(item)
            joins = isinstance(item, UnreadChunk) and is_wanted and group.has_room_for(item)
            if entries and not (joins and group.chunks):
                self._start(group)
                queue.append((entries, group))
                under_way += group.size
                entries, group = [], ChunkGroup()
            if isinstance(item, UnreadChunk) and is_wanted:
                entries.append((item, Load(self, group, len(group.chunks))))
                group.add(item)
            else:
                entries.append((item, None))
            while len(queue) > AHEAD or (queue and under_way > AHEAD_BYTES):
                first, done = queue.popleft()
                under_way -= done.size
                yield from first
        if queue:
            self._start(group)  # else nothing is done while another thread loads it
        for first, _ in queue:
            yield from first
        yield from entries

    def _start(self, group: ChunkGroup) -> None:
        stored = sum(c.head.body_size for c in group.chunks if c.head is not None)
        if group.size > WORTHWHILE * stored:
            group.future = self._pool.submit(self.load_group, group)

    def crc(self, begin: int, end: int) -> Callable[[], int | None]:
        """Compute the checksum of the bytes from ``begin`` to ``end``, and return its getter."""
        if end - begin <= SMALL_BYTES:
            found = self._file.crc(begin, end, self._stop)
            return lambda: found
        return self._pool.submit(self._file.crc, begin, end, self._stop).result

    def load_group(self, group: ChunkGroup) -> list[ChunkRecords | BrokenRecordError]:
        """Load each chunk of a group; return its records or its error."""
        loaded: list[ChunkRecords | BrokenRecordError] = []
        for number in range(len(group.chunks)):
            try:
                loaded.append(self.load_of(group, number))
            except BrokenRecordError as error:
                loaded.append(error)
        return loaded

    def load_of(self, group: ChunkGroup, number: int) -> ChunkRecords:
        """Load one chunk of a group; chunks must be loaded in order.

        Raises:
            BrokenRecordError: The records contradict the header, or exceed the limits.
        """
        chunk = group.chunks[number]
        if len(group.chunks) == 1:
            records = self.load(chunk)
            return ChunkRecords(records, 0, len(records))
        if group.whole is None:
            group.whole = self._file.buffers.take(group.size + 1)
        whole, begin = group.whole, group.begins[number]
        if number + 1 == len(group.chunks):
            group.whole = None  # reusable once no message refers to it
        end = begin + _size(chunk)
        self.load(chunk, whole[begin : end + 1])
        return ChunkRecords(whole, begin, end)

    def load(self, chunk: UnreadChunk, room: Bytes | None = None) -> Bytes:
        """Load the verified records of a chunk, or the start of a truncated chunk.

        Args:
            chunk: The chunk.
            room: Output buffer, one byte larger than the declared size; None for a new one.

        Raises:
            BrokenRecordError: The records contradict the header, or exceed the limits.
        """
        head = chunk.head
        if chunk.fault or head is None:
            raise BrokenRecordError(chunk.fault or "its fields cannot be read")
        max_bytes = self._limits.chunk_bytes
        if max(head.size, min(head.body_size, self._file.size)) > max_bytes:
            size = max(head.size, head.body_size)
            raise BrokenRecordError(
                f"declares {size} bytes, the limit is {max_bytes} (--max-chunk)"
            )
        if room is not None and not head.compression and head.body_size == head.size:
            return inflate_chunk(self._file.read_into(chunk.body_at, room[: head.size]), head, room)
        body = self._file.read(chunk.body_at, head.body_size)
        if chunk.is_cut:
            return inflate_prefix(body, head)
        if room is None:
            room = self._file.buffers.take(head.size + 1) if head.compression else body
        return inflate_chunk(body, head, room)


def _size(chunk: UnreadChunk) -> int:
    return 0 if chunk.head is None else chunk.head.size


def _rows(chunk: UnreadChunk) -> int:
    return sum(index.count for index in chunk.messages)


def _is_plain_case(chunk: UnreadChunk) -> bool:
    """Return whether header and summary agree, so that the chunk can be loaded with others."""
    return chunk.head is not None and not (chunk.fault or chunk.differs or chunk.is_cut)
