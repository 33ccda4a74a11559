"""Location of a selected part of a recording by the summary's index of chunks.

A summary is trusted if it has a checksum, its counts add up and its chunks do not overlap. Chunks
outside the selected time range, or without a selected topic, are then not read. The bytes between
the indexed chunks are always read, so that messages outside chunks are found.

A summary without a checksum is trusted only for times, and only if its chunks are in order of time.
A wrong time then violates this order, or belongs to a chunk next to the selected ones. These
neighbors are therefore read too.
"""

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.base import Selection
from crosscue.replay.limits import Limits
from crosscue.replay.readers.mcap.chunks.chunk_table import ChunkTable

from .bytes import ByteFile
from .channels import Declarations
from .segments import RecordingSegment, Summary
from .walk import End, Item, Walk

LATEST: Final = np.uint64((1 << 63) - 1)


@dataclass(frozen=True, slots=True, eq=False)
class ChunkWindow:
    """The location of a part of a recording.

    Attributes:
        chunks: All chunks of the recording.
        is_read: Shape (N,), bool: mask of the chunks that may contain selected messages.
        begin: Offset of the recording's first record.
        end: End of its data section.
    """

    chunks: ChunkTable
    is_read: NDArray[np.bool_]
    begin: int
    end: int

    @property
    def left(self) -> int:
        """Number of chunks that are not read."""
        return int(np.count_nonzero(~self.is_read))

    def ranges(self) -> list[tuple[int, int]]:
        """Return the ranges to read: everything except the skipped chunks."""
        out = ~self.is_read
        begin = np.concatenate(([self.begin], self.chunks.after[out]))
        end = np.concatenate((self.chunks.at[out], [self.end]))
        filled = end > begin
        return list(zip(begin[filled].tolist(), end[filled].tolist(), strict=True))

    def items(self, file: ByteFile, limits: Limits) -> Iterator[Item]:
        """Yield the items in these ranges, in the order of the file."""
        for begin, end in self.ranges():
            yield from self._walk(begin, end, file, limits)

    def others(self, file: ByteFile, limits: Limits) -> Iterator[Item]:
        """Yield the items of the skipped chunks, in the order of the file."""
        out = ~self.is_read
        for begin, end in zip(
            self.chunks.at[out].tolist(), self.chunks.after[out].tolist(), strict=True
        ):
            yield from self._walk(begin, end, file, limits)

    def _walk(self, begin: int, end: int, file: ByteFile, limits: Limits) -> Iterator[Item]:
        rows = slice(*np.searchsorted(self.chunks.at, (begin, end)).tolist())
        known = self.chunks.take(rows)
        for item in Walk(file, begin, end, known, limits):
            if not isinstance(item, End):
                yield item

    def rest(self, summary: Summary, held: Mapping[int, int]) -> Counter[int] | None:
        """Count the messages of each channel in the skipped chunks; None if inconsistent.

        Args:
            summary: A summary with statistics.
            held: Number of messages of each channel found or dropped in the chunks read.
        """
        statistics = summary.statistics
        if statistics is None:
            return None
        out = self.chunks.take(~self.is_read)
        named = np.bincount(out.channel, minlength=1)
        is_open = bool(out.is_unnamed.any())
        rest: Counter[int] = Counter()
        for channel_id in statistics.by_channel.keys() | held.keys():
            count = statistics.by_channel.get(channel_id, 0) - held.get(channel_id, 0)
            min_count = int(named[channel_id]) if channel_id < len(named) else 0
            if count < min_count or (count and not min_count and not is_open):
                return None
            rest[channel_id] = count
        return +rest


def find_window(
    segment: RecordingSegment, declarations: Declarations, selection: Selection
) -> ChunkWindow | str:
    """Locate the selected part, or return the reason why the index cannot be used."""
    summary = segment.summary
    if summary is None or not len(summary.chunks):
        return "it has no index of chunks"
    doubt = _doubt(segment, summary)
    if doubt:
        return doubt
    chunks = summary.chunks
    is_asked = _in_time(chunks, selection)
    if summary.is_verified:
        is_asked &= chunks.is_unnamed | chunks.naming(_wanted(declarations, selection))
    else:
        if not selection.is_timed:
            return "its index of chunks has no checksum"
        if not (_is_rising(chunks.start) and _is_rising(chunks.end)):
            return "its index of chunks has no checksum, and is not in order of time"
        is_asked = _with_neighbours(is_asked)
    return ChunkWindow(chunks, is_asked, segment.begin, segment.end)


def _doubt(segment: RecordingSegment, summary: Summary) -> str:
    """Return the problem of the index; empty for none."""
    statistics, chunks = summary.statistics, summary.chunks
    if statistics is None or not summary.counts_channels:
        return "it has no counts by topic"
    if statistics.chunk_count != len(chunks):
        return f"its index has {len(chunks)} chunks, its statistics {statistics.chunk_count}"
    if sum(statistics.by_channel.values()) != statistics.message_count:
        return "its counts by topic do not add up"
    if not (chunks.is_tiled and chunks.at[0] >= segment.begin and chunks.after[-1] <= segment.end):
        return "the chunks in its index overlap, or are beyond its data section"
    if not summary.is_verified and (chunks.after[:-1] < chunks.at[1:]).any():
        return "its index of chunks has no checksum, and has gaps"
    return ""


def _in_time(chunks: ChunkTable, selection: Selection) -> NDArray[np.bool_]:
    """Return a mask of the chunks that may contain selected or impossible times."""
    is_odd = (chunks.start > chunks.end) | (chunks.end > LATEST)
    # Some writers do not set the times of a chunk.
    is_odd |= (chunks.start == 0) & (chunks.end == 0)
    return selection.overlaps(chunks.start, chunks.end) | is_odd


def _wanted(declarations: Declarations, selection: Selection) -> NDArray[np.bool_]:
    """Return a mask of the selected channel numbers, shape (65536,)."""
    wanted = np.zeros(1 << 16, dtype=np.bool_)
    for channel_id, topic in declarations.topics():
        wanted[channel_id] = selection.wants(topic)
    return wanted


def _is_rising(times: NDArray[np.uint64]) -> bool:
    return bool((times[1:] >= times[:-1]).all())


def _with_neighbours(asked: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Add the chunk before the first selected one, and the chunk after the last."""
    wider = asked.copy()
    wider[:-1] |= asked[1:]
    wider[1:] |= asked[:-1]
    return wider
