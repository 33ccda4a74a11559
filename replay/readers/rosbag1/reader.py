"""Reader of ROS 1 bags, format 2.0: uncompressed, bz2 and lz4, with or without an index section.

The file is read from start to end. The index section and the index records are hints, and show the
number of messages in a damaged chunk. Bags of a killed recorder (without an index) and
``.bag.active`` files are read in the same manner.
"""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from crosscue.replay.base import EVERYTHING, Selection
from crosscue.replay.columns import Block, Topic
from crosscue.replay.errors import LogError, LogFormatError
from crosscue.replay.files.closing import Closing
from crosscue.replay.ledger import DAMAGED_RECORD, Ledger
from crosscue.replay.limits import DEFAULT_LIMITS, Limits
from crosscue.replay.remote.ranges import RangedFile
from crosscue.replay.seal.touched import Touched

from .bag_pass import Pass, Roster
from .chunk import CUT
from .index import Contents, read_index, scan_records
from .records import BAG_HEADER, MAGIC, BagFile, BagRecord, RangedBagFile
from .window import find_bag_window


class BagLog(Closing):
    """An open ROS 1 bag; see ``crosscue.replay.base.Log``."""

    format: Final = "rosbag1"

    def __init__(
        self, path: Path, limits: Limits = DEFAULT_LIMITS, file: BagFile | None = None
    ) -> None:
        """Open the bag and find its topics.

        Args:
            path: Path of the bag.
            limits: Maximum sizes that are read.
            file: The bag's bytes, if they are not read from ``path``.

        Raises:
            LogFormatError: Not a ROS 1 bag of format 2.0, encrypted, or without readable records.
            OSError: The file cannot be opened.
        """
        self.path: Final = path
        self._limits = limits
        self._notices: list[str] = []
        self._losses: list[tuple[str, str]] = []
        self._fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC) if file is None else -1
        try:
            self._file = file or BagFile(self._fd, os.fstat(self._fd).st_size, path=path)
            self._contents = self._learn(*self._bag_header())
        except BaseException:
            self.close()
            raise
        self._roster = Roster(self._contents)

    @property
    def topics(self) -> tuple[Topic, ...]:
        """Topics by connection number; without an index, they are found in the chunks."""
        return self._roster.topics

    @property
    def touched(self) -> Touched:
        """Record of the bytes read, for a seal."""
        return self._file.touched

    def read(self, ledger: Ledger, selection: Selection = EVERYTHING) -> Iterator[Block]:
        """Yield blocks of ROS 1 messages, a few chunks at a time; see ``Log.read``."""
        for sentence in self._notices:
            ledger.notice(sentence)
        for reason, detail in self._losses:
            ledger.drop("", reason, None, detail)
        one = Pass(self._file, self._roster, self._limits, ledger, selection)
        yield from one.blocks()

    def report_missing(self, ledger: Ledger) -> None:
        """Report losses found by the index or by a walk over the records; see ``KnowsItsEnd``."""
        for reason, detail in self._losses:
            ledger.drop("", reason, None, detail)
        for start, stop in () if self._losses else self._contents.gaps:
            if not 0 < self._contents.index_at <= start:
                reason = CUT if stop == self._file.size else DAMAGED_RECORD
                ledger.drop("", reason, None, f"bytes {start} to {stop}")

    @property
    def beginning(self) -> Selection:
        """Return a selection of the times of the first chunk."""
        first = self._contents.infos.get(min(self._contents.infos, default=-1))
        return EVERYTHING if first is None else Selection(None, first.start_ns, first.end_ns + 1)

    def needs_whole(self, selection: Selection) -> str:
        """Return why this part needs the complete file; empty if the index locates it."""
        if selection == EVERYTHING:
            return "all of it was requested"
        found = find_bag_window(self._contents, selection)
        return found if isinstance(found, str) else ""

    def close(self) -> None:
        """Close the file."""
        fd, self._fd = self._fd, -1
        if fd >= 0:
            os.close(fd)

    def _bag_header(self) -> tuple[int, BagRecord | None]:
        """Return the offset of the first record, and the bag header if it can be read."""
        start = self._file.bytes_at(0, len(MAGIC))
        if start != MAGIC:
            raise LogFormatError(
                f"{self.path}: begins with {start!r}, expected {MAGIC!r} (ROS 1 bag format 2.0); "
                "migrate older bags with 'rosbag fix', or check the file"
            )
        record = self._file.whole_record(len(MAGIC))
        if record is None or record.op != BAG_HEADER:
            self._notices.append("the bag header is damaged; the complete file was read")
            return len(MAGIC), None
        encryptor = record.fields.get(b"encryptor", b"")
        if encryptor:
            name = encryptor.decode("utf-8", "backslashreplace")
            raise LogError(
                f"{self.path}: encrypted by {name!r}; decrypt it first with 'rosbag decrypt'"
            )
        return record.end, record

    def _learn(self, first: int, header: BagRecord | None) -> Contents:
        contents = None
        index_at = header.u64(b"index_pos") if header is not None else 0
        if header is not None and first <= index_at <= self._file.size:
            contents = read_index(self._file, index_at, self._limits.schema_bytes)
            if contents is not None and (contents.connections or index_at == first):
                self._compare_counts(header, contents)
            else:
                contents = None
        if contents is None:
            contents = scan_records(self._file, first, self._limits)
            if header is not None:
                self._say_why_walked(index_at, contents)
            elif not contents.connections:
                size = self._file.size
                raise LogFormatError(
                    f"{self.path}: no readable record in {size} bytes; expected a ROS 1 bag"
                )
        contents.first, contents.index_at = first, index_at
        contents.chunk_count = header.u32(b"chunk_count") if header is not None else -1
        return contents

    def _compare_counts(self, header: BagRecord, contents: Contents) -> None:
        for name, held in (("conn", contents.connections), ("chunk", contents.infos)):
            declared = header.u32(f"{name}_count".encode())
            if declared != len(held):
                self._notices.append(
                    f"the bag header states {name}_count {declared}, the index lists {len(held)}; "
                    "the index was used"
                )

    def _say_why_walked(self, index_at: int, contents: Contents) -> None:
        if index_at == 0:
            self._notices.append(
                "no index: the recorder did not close the bag; the complete file was read"
            )
        elif contents.is_complete or index_at <= self._file.size:
            self._notices.append(
                f"the index at byte {index_at} is damaged; the complete file was read"
            )
        else:
            detail = f"index declared at byte {index_at}, file ends at {self._file.size}"
            self._losses.append(("file is cut", detail))


def open_remote_bag(name: Path, ranged: RangedFile, limits: Limits) -> BagLog | None:
    """Open a remote bag by its index section; None if the index is unusable.

    Args:
        name: Path that stands for the bag.
        ranged: The bag's bytes.
        limits: Maximum sizes that are read.
    """
    file = RangedBagFile(-1, ranged.size, ranged)
    header = file.whole_record(len(MAGIC))
    index_at = header.u64(b"index_pos") if header is not None and header.op == BAG_HEADER else 0
    if not 0 < index_at < file.size:
        return None
    file.expect([(index_at, file.size)])
    contents = read_index(file, index_at, limits.schema_bytes)
    return BagLog(name, limits, file) if contents is not None and contents.connections else None
