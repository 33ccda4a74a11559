"""MCAP recordings, read from their bytes.

The file's own records are the truth and its indexes only hints: the data section is walked record
by record, each chunk is decompressed to at most the size it declares and verified, and only then
are its messages given, as ranges of the chunk's bytes. Nothing is made per message. A checksum
covers a whole chunk (or, outside chunks, the whole data section), so that is also the unit of loss:
where a checksum is wrong, nothing that only it vouches for is given.

Channels become topics as ``mcap_topics`` says. A publish time that is no int64 counts as not
available and becomes the log time, as the format writes it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from crosscue.replay.closing import Closing
from crosscue.replay.columns import Block, Topic
from crosscue.replay.ledger import Ledger
from crosscue.replay.limits import Limits
from crosscue.replay.log import EVERYTHING, Selection

from .mcap_bytes import ByteFile
from .mcap_pass import read_segments
from .mcap_segments import Segment, find_segments
from .mcap_topics import TopicBook


class McapLog(Closing):
    """An open MCAP file; see ``crosscue.replay.log.Log``."""

    def __init__(self, path: Path, limits: Limits) -> None:
        """Find the topics.

        Raises:
            LogFormatError: Not MCAP, or no readable record in it.
            OSError: It cannot be opened.
        """
        self._path = path
        self._limits = limits
        self._book = TopicBook(limits)
        self._file = ByteFile(path)
        try:
            self._segments = find_segments(self._file, path, self._book, limits)
        except BaseException:
            self._file.close()
            raise

    @property
    def path(self) -> Path:
        """Where it lies."""
        return self._path

    @property
    def format(self) -> str:
        """Short name of the format."""
        return "mcap"

    @property
    def topics(self) -> tuple[Topic, ...]:
        """From the summary, or from the data section where the summary does not tell."""
        declared = declared_counts(self._segments, self._book)
        return tuple(
            Topic(
                t.name, t.type_name, t.encoding, t.schema, t.schema_encoding, declared.get(t.name)
            )
            for t in self._book.topics
        )

    def read(self, ledger: Ledger, selection: Selection = EVERYTHING) -> Iterator[Block]:
        """Its messages in stored order: a block per topic and a few chunks; see ``Log.read``."""
        yield from read_segments(
            self._file, self._segments, self._book, self._limits, ledger, selection
        )

    def close(self) -> None:
        """Release the file."""
        self._file.close()


def declared_counts(segments: tuple[Segment, ...], book: TopicBook) -> dict[str, int]:
    """Messages by topic as the statistics say; empty unless every recording in the file counts."""
    counts: Counter[str] = Counter()
    for segment in segments:
        summary = segment.summary
        if summary is None or not summary.counts_channels or summary.statistics is None:
            return {}
        for channel_id, topic in segment.declarations(book).topics():
            counts[topic] += summary.statistics.by_channel.get(channel_id, 0)
    return dict(counts)


def open_mcap(path: Path, limits: Limits) -> McapLog:
    """Open an MCAP file.

    Raises:
        LogFormatError: Not MCAP, or no readable record in it.
        OSError: It cannot be opened.
    """
    return McapLog(path, limits)
