"""Reader of Vector BLF logs: a header with an object count, then containers of objects.

Containers are usually compressed with zlib. Each compressed container has a checksum, which is
verified before its contents are used. The header's object count is compared with the number of
objects found. The start time is local time without a time zone; it is read as UTC, with a notice.
"""

import struct
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from io import BufferedReader
from pathlib import Path
from typing import Final

import numpy as np

from crosscue.replay.base import EVERYTHING, Selection
from crosscue.replay.columns import Block, Topic
from crosscue.replay.errors import LogFormatError
from crosscue.replay.files.closing import Closing
from crosscue.replay.ledger import NOT_ASKED_TIME, Ledger
from crosscue.replay.limits import Limits
from crosscue.replay.readers.can_rows import (
    TOO_MANY_BUSES,
    FrameRows,
    blocks_by_bus,
    bus_topic,
    keep_memory,
    named_buses,
)
from crosscue.replay.readers.can_text.digits import NANOS, within_range
from crosscue.replay.seal.touched import Touched, open_noted

from .objects import (
    BASE_BYTES,
    CONTAINER,
    MAGIC,
    PADDING_MAX,
    TYPE_MAX,
    ObjectCounts,
    chain_of,
    parse_frames,
)
from .windows import unwanted

_HEADER: Final = struct.Struct("<4sL8BQQLL8H8H")
_HEADER_MAX: Final = 4096
_BASE: Final = struct.Struct("<4sHHLL")
_CONTAINER: Final = struct.Struct("<H6xL4x")
_STORED, _DEFLATED = 0, 2
# Number of containers examined for bus names before the log is read.
_PEEKED: Final = 8
# Number of decompressed bytes that are parsed at a time.
STREAM_BYTES: Final = 1 << 20
_SCAN_BYTES: Final = 1 << 20
_PIECE_BYTES: Final = 1 << 16
# Maximum number of bytes read from damaged containers, as a multiple of the file's size.
_WASTE: Final = 8
_NOT_READ: Final = "outside the window"
NOT_CLOSED: Final = "file was not closed by its writer"
_UNCLOSED: Final = "the writer never closed the file: what it had not yet written is missing"


@dataclass(frozen=True, slots=True)
class FileHeader:
    """The header of a BLF file.

    Attributes:
        size: Size of this header in bytes.
        file_bytes: Size of the file in bytes when it was closed.
        objects: Number of objects in the file; 0 if it was never closed or is empty.
        start_ns: Start time of the recording, or None.
        stop_ns: End time of the recording, or None.
    """

    size: int
    file_bytes: int
    objects: int
    start_ns: int | None
    stop_ns: int | None


class BlfLog(Closing):
    """An open BLF log (``Log``)."""

    format: Final = "blf"

    def __init__(self, path: Path, limits: Limits) -> None:
        """Read the header and search the first containers for bus names.

        Raises:
            LogFormatError: The file does not start with a BLF header.
        """
        self.path: Final = path
        self._limits = limits
        self.touched: Final = Touched()
        with open_noted(path, self.touched) as file:
            self._header = _header_of(file, path)
        self._names: dict[str, int] = {}
        first = _Pass(self.path, self._header, limits, self._names, self.touched)
        for n, rows in enumerate(first.rows()):
            if len(rows) or n >= _PEEKED:
                break

    @property
    def topics(self) -> tuple[Topic, ...]:
        """The buses found so far: those in the first containers, or all buses after a pass."""
        return tuple(bus_topic(name) for name in self._names)

    def report_missing(self, ledger: Ledger) -> None:
        """Report that the file is shorter than the header declares; see ``KnowsItsEnd``."""
        declared, size = self._header.file_bytes, self.path.stat().st_size
        if not self._header.objects:
            if self._names:
                ledger.drop("", NOT_CLOSED, None, _UNCLOSED)
        elif size + PADDING_MAX < declared:
            detail = f"the header declares {declared} bytes, the file has {size}"
            ledger.drop("", "file is cut", None, detail)

    def read(self, ledger: Ledger, selection: Selection = EVERYTHING) -> Iterator[Block]:
        """Yield all frames, several containers at a time; see ``Log.read``."""
        keep_memory()
        reading = _Pass(self.path, self._header, self._limits, self._names, self.touched, selection)
        try:
            for rows in reading.rows():
                yield from blocks_by_bus(rows, tuple(self._names), ledger, selection)
        except OSError as error:
            reading.tally.damage("reading the file failed", error.strerror or str(error))
        for name in self._names:
            ledger.topic(name)
        reading.settle(ledger)


class _Pass:
    """One pass over the file, from containers to rows, with the account at the end."""

    def __init__(
        self,
        path: Path,
        header: FileHeader,
        limits: Limits,
        names: dict[str, int],
        touched: Touched,
        selection: Selection = EVERYTHING,
    ) -> None:
        self.tally = ObjectCounts()
        self._path, self._header, self._limits, self._names = path, header, limits, names
        self._tail = b""
        self._is_resumed = self._has_loose = False
        self._deflated = self._stored = self._wasted = 0
        self._selection, self._touched = selection, touched
        self._skips: Mapping[int, int] = {}
        self._skipped_bytes = 0

    def rows(self) -> Iterator[FrameRows]:
        """Yield the file's frames, several containers at a time."""
        parts: list[bytes] = []
        place, held = "", 0
        with open_noted(self._path, self._touched) as file:
            for content, where in self._contents(file):
                if content is None:
                    # If containers are skipped but not missing, an object may continue in them.
                    is_end = where != _NOT_READ
                    if parts or self._tail:
                        yield self._rows(b"".join(parts), place, is_end=is_end)
                    parts, held, self._is_resumed, self._tail = [], 0, True, b""
                    continue
                place = place if parts else where
                parts.append(content)
                held += len(content)
                if held >= STREAM_BYTES:
                    yield from self._slices(b"".join(parts), place)
                    parts, held = [], 0
            yield self._rows(b"".join(parts), place, is_end=True)

    def settle(self, ledger: Ledger) -> None:
        """Compare the counts with the header, and report the verified checksums."""
        tally, header = self.tally, self._header
        for reason, count in sorted(tally.others.items()):
            ledger.find("", count)
            ledger.skip("", reason, count)
        self._settle_losses(ledger)
        self._add_notices(ledger)
        plain = f"; {self._stored} stored without one" if self._stored else ""
        unread = f"; {self._skipped_bytes} bytes outside --from/--to not read"
        ledger.integrity = (
            f"checksums of {self._deflated} compressed containers verified{plain}"
            f"{unread if self._skips else ''}; BLF headers have none"
        )
        size = self._path.stat().st_size
        if header.objects and size != header.file_bytes:
            ledger.notice(f"the header declares {header.file_bytes} bytes, the file has {size}")

    def _settle_losses(self, ledger: Ledger) -> None:
        tally, header = self.tally, self._header
        reasons = list(tally.reasons)
        detail = "; ".join(tally.places)
        missing = header.objects - tally.counted
        if not header.objects and tally.counted:
            ledger.drop("", NOT_CLOSED, None, _UNCLOSED)
        if not header.objects and not tally.counted:
            ledger.notice("no objects: nothing was recorded, or the writer was stopped early")
        if self._skips and missing > 0:
            ledger.find("", missing)
            ledger.skip("", NOT_ASKED_TIME, missing)
            missing = 0
        if header.objects and missing > 0:
            reason = reasons[0] if len(reasons) == 1 else "objects damaged or missing"
            declared = f"declared {header.objects} objects, found {tally.counted}"
            ledger.drop("", reason, missing, f"{declared}; {detail}" if detail else declared)
        else:
            for reason in reasons:
                ledger.drop("", reason, None, detail)
        if header.objects and missing < 0:
            ledger.notice(f"the header declares {header.objects} objects, found {tally.counted}")

    def _add_notices(self, ledger: Ledger) -> None:
        start_ns, stop_ns = self._header.start_ns, self._header.stop_ns
        if start_ns is None:
            ledger.notice("the log states no start time before 2116; times count from 1970-01-01")
        else:
            ledger.notice("the log states no time zone; its start time is read as UTC")
            if stop_ns is not None and start_ns + self.tally.last_tick_ns > stop_ns + 10_000_000:
                ledger.notice("some frames are later than the stop time in the header")
        if self.tally.padded:
            ledger.notice(
                f"{self.tally.padded} CAN FD frames store fewer bytes than their length; the rest "
                "is read as zeros, as Vector's tools do"
            )

    def _slices(self, content: bytes, place: str) -> Iterator[FrameRows]:
        for k in range(0, len(content), STREAM_BYTES):
            yield self._rows(content[k : k + STREAM_BYTES], place, is_end=False)

    def _rows(self, content: bytes, place: str, *, is_end: bool) -> FrameRows:
        stream = np.frombuffer(self._tail + content, np.uint8)
        chain = chain_of(
            stream,
            is_resumed=self._is_resumed,
            is_end=is_end,
            size_max=self._limits.message_bytes,
            tally=self.tally,
            place=place,
        )
        self._is_resumed = self._is_resumed and not len(chain.start)
        self._tail = b"" if is_end else stream[chain.rest :].tobytes()
        if is_end and len(stream) - chain.rest >= len(MAGIC):
            self.tally.damage("last object is cut", place)
        start_ns = self._header.start_ns or 0
        rows = parse_frames(stream, chain.start, start_ns, self.tally, place)
        named = named_buses(rows, self._names)
        if len(named) < len(rows):
            self.tally.damage(TOO_MANY_BUSES, "")
        return named

    def _contents(self, file: BufferedReader) -> Iterator[tuple[bytes | None, str]]:
        """Yield the contents of the outer objects in order; None for missing contents."""
        size = self._path.stat().st_size
        position = self._header.size
        if size < position:
            self.tally.damage("file is cut", "inside its header")
        if self._header.objects:  # otherwise the number of skipped objects is unknown
            start_ns = self._header.start_ns or 0
            # The headers of skipped containers do not count as read.
            with self._path.open("rb") as heads:
                self._skips = unwanted(heads, position, size, start_ns, self._selection)
        while position < size:
            if position in self._skips:
                self._skipped_bytes += self._skips[position] - position
                position = self._skips[position]
                yield None, _NOT_READ
                continue
            file.seek(position)
            head = file.read(BASE_BYTES)
            place = f"byte {position}"
            if self._wasted > _WASTE * size:
                self.tally.damage("too damaged to continue", place)
                return
            if not head.startswith(MAGIC):
                near = head[: PADDING_MAX + len(MAGIC) - 1].find(MAGIC)
                found = position + near if near > 0 else self._next(file, position + 1)
                if near <= 0 and (found is not None or head.strip(b"\0")):
                    self.tally.damage("bytes without a container", place)
                    yield None, place
                if found is None:
                    return
                position = found
                continue
            if len(head) < BASE_BYTES:
                self.tally.damage("file is cut", place)
                return
            _, _, _, object_bytes, type_ = _BASE.unpack(head)
            if type_ == CONTAINER:
                content, position = self._container(file, position, object_bytes, size)
            else:
                content, position = self._loose(file, position, object_bytes, size)
            yield content, place

    def _next(self, file: BufferedReader, position: int) -> int | None:
        """Return the offset of the next object at or after ``position``, to resume reading."""
        file.seek(position)
        kept = b""
        while more := file.read(_SCAN_BYTES):
            stretch = kept + more
            at = stretch.find(MAGIC)
            while 0 <= at <= len(stretch) - BASE_BYTES:
                _, header_bytes, _, object_bytes, type_ = _BASE.unpack_from(stretch, at)
                is_container = type_ == CONTAINER and header_bytes == BASE_BYTES < object_bytes
                is_loose = self._has_loose and header_bytes in (32, 40) and type_ <= TYPE_MAX
                if is_container or (is_loose and object_bytes >= header_bytes):
                    return position + at
                at = stretch.find(MAGIC, at + 1)
            kept = stretch[-BASE_BYTES + 1 :]
            position += len(stretch) - len(kept)
        return None

    def _loose(
        self, file: BufferedReader, position: int, object_bytes: int, size: int
    ) -> tuple[bytes | None, int]:
        """Return an object outside containers, with its padding, and its end."""
        self._has_loose = True
        whole = object_bytes + object_bytes % 4
        is_possible = BASE_BYTES <= object_bytes <= self._limits.message_bytes
        if not is_possible or position + object_bytes > size:
            self.tally.damage("file is cut, or an object's size is wrong", f"byte {position}")
            return None, position + len(MAGIC)
        file.seek(position)
        return file.read(whole), position + whole

    def _container(
        self, file: BufferedReader, position: int, object_bytes: int, size: int
    ) -> tuple[bytes | None, int]:
        """Return a container's content and end; None and the probable end if it is damaged."""
        place = f"container at byte {position}"
        file.seek(position + BASE_BYTES)
        head = file.read(_CONTAINER.size)
        end = position + object_bytes
        is_cut = end > size
        body_bytes = min(end, size) - position - BASE_BYTES - _CONTAINER.size
        if body_bytes < 0 or len(head) < _CONTAINER.size:
            self.tally.damage("file is cut, or a container's size is wrong", place)
            return None, position + BASE_BYTES
        method, declared = _CONTAINER.unpack(head)
        content, used = None, 0
        if max(declared, body_bytes) > self._limits.chunk_bytes:
            size_bytes, limit = max(declared, body_bytes), self._limits.chunk_bytes
            detail = f"{place}: declares {size_bytes} bytes, the limit is {limit} (--max-chunk)"
            self.tally.damage("container is over the size limit", detail)
        elif method == _STORED:
            content, used = self._stored_content(file, body_bytes, declared, place, is_cut)
        elif method == _DEFLATED:
            content, used = self._inflated(file, body_bytes, declared, place, is_cut)
        else:
            self.tally.damage("unknown compression", f"{place}: method {method}")
        if content is None:
            return None, end if self._begins_object(file, end, size) else position + BASE_BYTES
        return content, position + BASE_BYTES + _CONTAINER.size + used

    def _begins_object(self, file: BufferedReader, position: int, size: int) -> bool:
        if position >= size:
            return position == size
        file.seek(position)
        return file.read(PADDING_MAX + len(MAGIC) - 1).find(MAGIC) >= 0

    def _stored_content(
        self, file: BufferedReader, body_bytes: int, declared: int, place: str, is_cut: bool
    ) -> tuple[bytes, int]:
        """Return uncompressed content; if the two sizes differ, the smaller one is used."""
        content = file.read(min(body_bytes, declared))
        self._stored += 1
        if body_bytes != declared:
            reason = "file is cut, or a container's size is wrong" if is_cut else "sizes differ"
            self.tally.damage(reason, f"{place}: {body_bytes} bytes, declared {declared}")
        return content, len(content)

    def _inflated(
        self, file: BufferedReader, body_bytes: int, declared: int, place: str, is_cut: bool
    ) -> tuple[bytes | None, int]:
        """Return verified content; of a truncated container, the part before the file's end."""
        inflater = zlib.decompressobj()
        parts: list[bytes] = []
        produced = used = 0
        try:
            while used < body_bytes and not inflater.eof and produced <= declared:
                piece = file.read(min(_PIECE_BYTES, body_bytes - used))
                if not piece:
                    break
                used += len(piece)
                parts.append(inflater.decompress(piece, declared + 1 - produced))
                produced += len(parts[-1])
        except zlib.error as error:
            self._wasted += used
            self.tally.damage("container does not match its checksum", f"{place}: {error}")
            return None, 0
        used -= len(inflater.unused_data)
        if inflater.eof and produced == declared:
            self._deflated += 1
            if body_bytes - used >= PADDING_MAX:
                self.tally.damage("a container's size is wrong", place)
            return b"".join(parts), used
        if is_cut and not inflater.eof and produced <= declared:
            self.tally.damage("file is cut, or a container's size is wrong", place)
            return b"".join(parts), used
        self._wasted += used
        found = f"more than {declared}" if produced > declared else str(produced)
        detail = f"{place}: inflates to {found} bytes, declares {declared}"
        self.tally.damage("container differs from its declared size", detail)
        return None, 0


def _header_of(file: BufferedReader, path: Path) -> FileHeader:
    head = file.read(_HEADER.size)
    if not head:
        raise LogFormatError(f"{path}: empty file; expected a BLF log, check how it was copied")
    if len(head) < _HEADER.size or not head.startswith(b"LOGG"):
        raise LogFormatError(
            f"{path}: no BLF header at its start (expected 'LOGG', got {head[:4]!r}); "
            "check that it is a complete BLF log"
        )
    fields = _HEADER.unpack(head)
    size = fields[1]
    if not _HEADER.size <= size <= _HEADER_MAX:
        size = 144
    return FileHeader(
        size,
        file_bytes=fields[10],
        objects=fields[12],
        start_ns=_system_time_ns(fields[14:22]),
        stop_ns=_system_time_ns(fields[22:30]),
    )


def _system_time_ns(fields: tuple[int, ...]) -> int | None:
    """Convert a Windows SYSTEMTIME (year, month, weekday, day, hour, minute, second, ms)."""
    year, month, _, day, hour, minute, second, millisecond = fields
    try:
        at = datetime(year, month, day, hour, minute, second, tzinfo=UTC)
    except ValueError:
        return None
    return within_range(int(at.timestamp()) * NANOS + millisecond * 1_000_000)
