"""MCAP recordings, read from their bytes.

The file's own records are the truth and its indexes only hints: the data section is walked record
by record, each chunk is decompressed to at most the size it declares and verified, and only then
are its messages given, as ranges of the chunk's bytes. Nothing is made per message. A chunk's
checksum is also the unit of loss: where it is wrong, nothing of the chunk is given. Where only the
data section's checksum covers messages and is wrong, one of them may hold changed bytes and nobody
can know which: those that are structurally sound are given, and the account is not whole. Behind
damaged bytes reading goes on at the next chunk that proves itself, or at the next records that are
plausible in a row.

Channels become topics as ``mcap_topics`` says. A publish time that is not an int64 counts as not
available and becomes the log time, as the format writes it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Final

from crosscue.replay.base import EVERYTHING, Block, Closing, Ledger, Limits, Selection, Topic
from crosscue.replay.remote.ranges import RangedFile
from crosscue.replay.seal.touched import Touched

from .bytes import ByteFile, RangedByteFile
from .channels import TopicBook
from .recording_pass import CUT, INCOMPLETE, read_segments
from .segments import Segment, find_segments, has_whole_summary
from .window import find_window

HEADER_GUESS: Final = 64
SUMMARY_GUESS: Final = 64 << 10
"""Bytes at the end of a remote file that are fetched at once."""


class McapLog(Closing):
    """An open MCAP file; see ``crosscue.replay.base.Log``."""

    def __init__(self, path: Path, limits: Limits, file: ByteFile | None = None) -> None:
        """Find the topics.

        Args:
            path: Where it is.
            limits: Sizes above which nothing is read.
            file: Its bytes, if they do not come from ``path``.

        Raises:
            LogFormatError: Not MCAP, or no readable record in it.
            OSError: It cannot be opened.
        """
        self._path = path
        self._limits = limits
        self._book = TopicBook(limits)
        self._file = ByteFile(path) if file is None else file
        try:
            self._segments = find_segments(self._file, path, self._book, limits)
        except BaseException:
            self._file.close()
            raise

    @property
    def path(self) -> Path:
        """Where it is."""
        return self._path

    @property
    def format(self) -> str:
        """Short name of the format."""
        return "mcap"

    @property
    def topics(self) -> tuple[Topic, ...]:
        """From the summary, or from the data section where the summary does not report."""
        declared = declared_counts(self._segments, self._book)
        return tuple(replace(t, declared=declared.get(t.name)) for t in self._book.topics)

    @property
    def touched(self) -> Touched:
        """Which bytes were read, for a seal."""
        return self._file.touched

    def read(self, ledger: Ledger, selection: Selection = EVERYTHING) -> Iterator[Block]:
        """Its messages in stored order: a block per topic and a few chunks; see ``Log.read``."""
        yield from read_segments(
            self._file, self._segments, self._book, self._limits, ledger, selection
        )

    def report_missing(self, ledger: Ledger) -> None:
        """Recordings in it without an end; see ``KnowsItsEnd``."""
        for segment in self._segments:
            if segment.after:
                ledger.drop("", INCOMPLETE, None, segment.after)
            elif not segment.has_end:
                detail = f"no data end record and footer up to byte {segment.end}"
                ledger.drop("", CUT, None, detail)

    @property
    def beginning(self) -> Selection:
        """The times of the first chunk."""
        summary = self._segments[0].summary
        if summary is None or not len(summary.chunks):
            return EVERYTHING
        return Selection(None, int(summary.chunks.start[0]), int(summary.chunks.end[0]) + 1)

    def needs_whole(self, selection: Selection) -> str:
        """Why reading this part takes all bytes of the file; empty if the index leads to it."""
        segment = self._segments[0]
        if selection == EVERYTHING:
            return "all of it was requested"
        if len(self._segments) > 1 or not segment.has_end:
            return "it has no summary that can be used"
        found = find_window(segment, segment.declarations(self._book), selection)
        return found if isinstance(found, str) else ""

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


def open_ranged(name: Path, ranged: RangedFile, limits: Limits) -> McapLog | None:
    """Open a remote MCAP file by its summary; None if its summary is not enough to know it.

    Args:
        name: What it is called.
        ranged: Its bytes.
        limits: Sizes above which nothing is read.
    """
    file = RangedByteFile(ranged)
    file.window(0, HEADER_GUESS)
    file.window(max(0, file.size - SUMMARY_GUESS), SUMMARY_GUESS)
    return McapLog(name, limits, file) if has_whole_summary(file, limits) else None
