"""Reader of MCAP recordings.

The reader relies on the file's records and uses its indexes only as hints. It walks through the
data section record by record. It decompresses each chunk to at most the declared size, verifies it,
and only then yields its messages, as ranges of the chunk's bytes and without an object per message.

If a chunk's checksum is wrong, all its messages are dropped. If only the data section's checksum
covers messages and is wrong, the changed message cannot be identified. The reader then yields the
structurally sound messages, and the account is incomplete. After damaged bytes, reading continues
at the next verified chunk or at the next plausible consecutive records.

``channels`` maps channels to topics. A publish time that does not fit into an int64 counts as not
available and is replaced by the log time, as the format specifies.
"""

from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Final

from crosscue.replay.base import EVERYTHING, Selection
from crosscue.replay.columns import Block, Topic
from crosscue.replay.files.closing import Closing
from crosscue.replay.ledger import Ledger
from crosscue.replay.limits import Limits
from crosscue.replay.remote.ranges import RangedFile
from crosscue.replay.seal.touched import Touched

from .bytes import ByteFile, RangedByteFile
from .channels import TopicBook
from .recording_pass import CUT, INCOMPLETE, read_segments
from .segments import RecordingSegment, find_segments, has_whole_summary
from .window import LATEST, find_window

HEADER_GUESS: Final = 64
# Number of bytes at the end of a remote file that are fetched at once.
SUMMARY_GUESS: Final = 64 << 10


class McapLog(Closing):
    """An open MCAP file; see ``crosscue.replay.base.Log``."""

    format: Final = "mcap"

    def __init__(self, path: Path, limits: Limits, file: ByteFile | None = None) -> None:
        """Open the file and find its topics.

        Args:
            path: Path of the file.
            limits: Maximum sizes that are read.
            file: The file's bytes, if they are not read from ``path``.

        Raises:
            LogFormatError: The file is not MCAP, or has no readable record.
            OSError: The file cannot be opened.
        """
        self.path: Final = path
        self._limits = limits
        self._book = TopicBook(limits)
        self._file = ByteFile(path) if file is None else file
        try:
            self._segments = find_segments(self._file, path, self._book, limits)
        except BaseException:
            self._file.close()
            raise

    @property
    def topics(self) -> tuple[Topic, ...]:
        """Topics in the summary, or in the data section if the summary lacks them."""
        declared = declared_counts(self._segments, self._book)
        return tuple(replace(t, declared=declared.get(t.name)) for t in self._book.topics)

    @property
    def touched(self) -> Touched:
        """Record of the bytes read, for a seal."""
        return self._file.touched

    def read(self, ledger: Ledger, selection: Selection = EVERYTHING) -> Iterator[Block]:
        """Yield the messages, one block per topic for every few chunks; see ``Log.read``."""
        yield from read_segments(
            self._file, self._segments, self._book, self._limits, ledger, selection
        )

    def report_missing(self, ledger: Ledger) -> None:
        """Report recordings without an end; see ``KnowsItsEnd``."""
        for segment in self._segments:
            if segment.after:
                ledger.drop("", INCOMPLETE, None, segment.after)
            elif not segment.has_end:
                detail = f"no data end record and footer up to byte {segment.end}"
                ledger.drop("", CUT, None, detail)

    def start_ns(self) -> int | None:
        """Return the start of the first chunk, if a verified summary says nothing is earlier."""
        summary = self._segments[0].summary
        if summary is None or not summary.is_verified or not len(summary.chunks):
            return None
        start, end = int(summary.chunks.start[0]), int(summary.chunks.end[0])
        counted = summary.statistics
        # Some writers do not set the times of a chunk.
        is_first = counted is not None and start == counted.start and 0 < end <= LATEST
        return start if is_first and len(self._segments) == 1 else None

    @property
    def beginning(self) -> Selection:
        """Return a selection of the times of the first chunk."""
        summary = self._segments[0].summary
        if summary is None or not len(summary.chunks):
            return EVERYTHING
        return Selection(None, int(summary.chunks.start[0]), int(summary.chunks.end[0]) + 1)

    def needs_whole(self, selection: Selection) -> str:
        """Return why this part needs the complete file; empty if the index locates it."""
        segment = self._segments[0]
        if selection == EVERYTHING:
            return "all of it was requested"
        if len(self._segments) > 1 or not segment.has_end:
            return "it has no usable summary"
        found = find_window(segment, segment.declarations(self._book), selection)
        return found if isinstance(found, str) else ""

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def declared_counts(segments: tuple[RecordingSegment, ...], book: TopicBook) -> dict[str, int]:
    """Return the statistics' message counts by topic; empty if a recording has no counts."""
    counts: Counter[str] = Counter()
    for segment in segments:
        summary = segment.summary
        if summary is None or not summary.counts_channels or summary.statistics is None:
            return {}
        for channel_id, topic in segment.declarations(book).topics():
            counts[topic] += summary.statistics.by_channel.get(channel_id, 0)
    return dict(counts)


def open_remote_mcap(name: Path, ranged: RangedFile, limits: Limits) -> McapLog | None:
    """Open a remote MCAP file by its summary; None if the summary is insufficient.

    Args:
        name: Path that stands for the file.
        ranged: The file's bytes.
        limits: Maximum sizes that are read.
    """
    file = RangedByteFile(ranged)
    file.window(0, HEADER_GUESS)
    file.window(max(0, file.size - SUMMARY_GUESS), SUMMARY_GUESS)
    return McapLog(name, limits, file) if has_whole_summary(file, limits) else None
