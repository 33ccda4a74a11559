"""ROS 1 bags, format 2.0: uncompressed, bz2 and lz4, with an index section or without.

The file's bytes are read from the front to the back; the index section and the index records are
hints, and report how much a damaged chunk held. Bags of a killed recorder (no index) and
``.bag.active`` files read like any other.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

from crosscue.replay.base import (
    DEFAULT_LIMITS,
    EVERYTHING,
    Block,
    Closing,
    Ledger,
    Limits,
    LogError,
    LogFormatError,
    Selection,
    Topic,
)
from crosscue.replay.remote.ranges import RangedFile
from crosscue.replay.seal.touched import Touched

from .bag_pass import DAMAGED_RECORD, Pass, Roster
from .chunk import CUT
from .index import Contents, read_index, walk
from .records import BAG_HEADER, MAGIC, BagFile, RangedBagFile, Record
from .window import find_bag_window


class BagLog(Closing):
    """An open ROS 1 bag; see ``crosscue.replay.base.Log``."""

    def __init__(self, path: Path, limits: Limits, file: BagFile | None = None) -> None:
        """Open the bag and learn its topics.

        Args:
            path: Where it is.
            limits: Sizes above which nothing is read.
            file: Its bytes, if they do not come from ``path``.

        Raises:
            LogFormatError: No ROS 1 bag of format 2.0, or encrypted, or nothing readable in it.
            OSError: It cannot be opened.
        """
        self._path = path
        self._limits = limits
        self._notices: list[str] = []
        self._losses: list[tuple[str, str]] = []
        self._fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC) if file is None else -1
        try:
            self._file = file or BagFile(self._fd, os.fstat(self._fd).st_size, path=path)
            self._first, header = self._bag_header()
            self._contents = self._learn(header)
        except BaseException:
            self.close()
            raise
        self._roster = Roster(self._contents)

    @property
    def path(self) -> Path:
        """Where it is."""
        return self._path

    @property
    def format(self) -> str:
        """``rosbag1``."""
        return "rosbag1"

    @property
    def topics(self) -> tuple[Topic, ...]:
        """Topics by connection number; those of a bag without index are found in its chunks."""
        return self._roster.topics

    @property
    def touched(self) -> Touched:
        """Which bytes were read, for a seal."""
        return self._file.touched

    def read(self, ledger: Ledger, selection: Selection = EVERYTHING) -> Iterator[Block]:
        """Blocks of ROS 1 messages, a few chunks at a time; see ``Log.read``."""
        for sentence in self._notices:
            ledger.notice(sentence)
        for reason, detail in self._losses:
            ledger.drop("", reason, None, detail)
        one = Pass(
            self._file,
            self._first,
            self._contents,
            self._roster,
            self._limits,
            ledger,
            selection,
            self._chunk_count,
        )
        yield from one.blocks(self._index_at)

    def report_missing(self, ledger: Ledger) -> None:
        """What the index or the walk over the records found missing; see ``KnowsItsEnd``."""
        for reason, detail in self._losses:
            ledger.drop("", reason, None, detail)
        for start, stop in () if self._losses else self._contents.gaps:
            if not 0 < self._index_at <= start:
                reason = CUT if stop == self._file.size else DAMAGED_RECORD
                ledger.drop("", reason, None, f"bytes {start} to {stop}")

    @property
    def beginning(self) -> Selection:
        """The times of the first chunk."""
        first = self._contents.infos.get(min(self._contents.infos, default=-1))
        return EVERYTHING if first is None else Selection(None, first.start_ns, first.end_ns + 1)

    def needs_whole(self, selection: Selection) -> str:
        """Why reading this part takes all bytes of the file; empty if the index leads to it."""
        if selection == EVERYTHING:
            return "all of it was requested"
        found = find_bag_window(
            self._contents, self._first, self._index_at, self._chunk_count, selection
        )
        return found if isinstance(found, str) else ""

    def close(self) -> None:
        """Release the file."""
        fd, self._fd = self._fd, -1
        if fd >= 0:
            os.close(fd)

    def _bag_header(self) -> tuple[int, Record | None]:
        """Where the records begin behind the bag header, and the header if it can be read."""
        start = self._file.bytes_at(0, len(MAGIC))
        if start != MAGIC:
            raise LogFormatError(
                f"{self._path}: begins with {start!r}, expected {MAGIC!r} (ROS 1 bag format 2.0); "
                "migrate older bags with 'rosbag fix', or check the file"
            )
        record = self._file.whole_record(len(MAGIC))
        if record is None or record.op != BAG_HEADER:
            self._notices.append("the bag header is damaged; every record was read from the bytes")
            return len(MAGIC), None
        encryptor = record.fields.get(b"encryptor", b"")
        if encryptor:
            name = encryptor.decode("utf-8", "backslashreplace")
            raise LogError(
                f"{self._path}: encrypted by {name!r}; decrypt it first with 'rosbag decrypt'"
            )
        return record.end, record

    def _learn(self, header: Record | None) -> Contents:
        self._chunk_count = header.u32(b"chunk_count") if header is not None else -1
        self._index_at = header.u64(b"index_pos") if header is not None else 0
        largest = self._limits.schema_bytes
        if self._first <= self._index_at <= self._file.size:
            contents = read_index(self._file, self._index_at, largest)
            if contents is not None and (contents.connections or self._index_at == self._first):
                self._compare_counts(header, contents)
                return contents
        contents = walk(self._file, self._first, self._limits)
        self._say_why_walked(header, contents)
        if not contents.connections and header is None:
            raise LogFormatError(
                f"{self._path}: no readable record in {self._file.size} bytes; expected a ROS 1 bag"
            )
        return contents

    def _compare_counts(self, header: Record | None, contents: Contents) -> None:
        if header is None:
            return
        for name, held in (("conn", contents.connections), ("chunk", contents.infos)):
            declared = header.u32(f"{name}_count".encode())
            if declared != len(held):
                self._notices.append(
                    f"the bag header says {name}_count {declared}, the index lists {len(held)}; "
                    "the index was used"
                )

    def _say_why_walked(self, header: Record | None, contents: Contents) -> None:
        if header is None:
            return
        if self._index_at == 0:
            self._notices.append(
                "no index: the recorder did not close the bag; every record was read from the bytes"
            )
        elif contents.is_complete or self._index_at <= self._file.size:
            self._notices.append(
                f"the index at byte {self._index_at} is damaged; every record was read from the "
                "bytes"
            )
        else:
            detail = f"index declared at byte {self._index_at}, file ends at {self._file.size}"
            self._losses.append(("file is cut", detail))


def open_bag(path: Path, limits: Limits = DEFAULT_LIMITS) -> BagLog:
    """Open a ROS 1 bag.

    Raises:
        LogError: No ROS 1 bag of format 2.0, encrypted, or nothing readable in it.
        OSError: It cannot be opened.
    """
    return BagLog(path, limits)


def open_ranged(name: Path, ranged: RangedFile, limits: Limits) -> BagLog | None:
    """Open a remote bag by its index section; None if it has none that can be used.

    Args:
        name: What it is called.
        ranged: Its bytes.
        limits: Sizes above which nothing is read.
    """
    file = RangedBagFile(-1, ranged.size, ranged)
    header = file.whole_record(len(MAGIC))
    index_at = header.u64(b"index_pos") if header is not None and header.op == BAG_HEADER else 0
    if not 0 < index_at < file.size:
        return None
    file.expect([(index_at, file.size)])
    contents = read_index(file, index_at, limits.schema_bytes)
    return BagLog(name, limits, file) if contents is not None and contents.connections else None
