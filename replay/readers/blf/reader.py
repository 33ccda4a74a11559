"""Vector BLF logs: containers of objects, mostly zlib-compressed, behind a header that counts them.

Each compressed container carries a checksum, which is verified before anything in it is given.
The header's object count is held against what was met. Its start time is local to the machine
that recorded, without a zone; it is taken as UTC, with a notice.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from io import BufferedReader
from pathlib import Path
from typing import Final

import numpy as np

from crosscue.replay.base import (
    EVERYTHING,
    NOT_ASKED_TIME,
    Block,
    Closing,
    Ledger,
    Limits,
    Log,
    LogFormatError,
    Selection,
    Topic,
)
from crosscue.replay.readers.can_rows import (
    FrameRows,
    blocks_by_bus,
    bus_number,
    bus_topic,
    keep_memory,
)
from crosscue.replay.readers.can_text.digits import NANOS, within_range
from crosscue.replay.seal.touched import Touched, open_noted

from .objects import BASE_BYTES, CONTAINER, MAGIC, PADDING_MAX, TYPE_MAX, Tally, chain_of, rows_of
from .windows import unwanted

_HEADER: Final = struct.Struct("<4sL8BQQLL8H8H")
_HEADER_MAX: Final = 4096
_BASE: Final = struct.Struct("<4sHHLL")
_CONTAINER: Final = struct.Struct("<H6xL4x")
_STORED, _DEFLATED = 0, 2
_PEEKED: Final = 8
"""Containers examined for bus names before the log is read."""
STREAM_BYTES: Final = 1 << 20
"""How much inflated content is put into columns at a time."""
_SCAN_BYTES: Final = 1 << 20
_PIECE_BYTES: Final = 1 << 16
_WASTE: Final = 8
"""How many times the file's size may be read from containers that turn out damaged."""
_NOT_READ: Final = "outside the window"
NOT_CLOSED: Final = "file was not closed by its writer"
_UNCLOSED: Final = "the writer never closed the file: what it had not yet written is missing"


@dataclass(frozen=True, slots=True)
class FileHeader:
    """What the first bytes declare.

    Attributes:
        size: Bytes of this header.
        file_bytes: Bytes of the whole file when it was closed.
        objects: Objects in it; 0 when it was never closed, or is empty.
        start_ns: When the recording began, or None.
        stop_ns: When it ended, or None.
    """

    size: int
    file_bytes: int
    objects: int
    start_ns: int | None
    stop_ns: int | None


def open_blf(path: Path, limits: Limits) -> Log:
    """Open a BLF log.

    Raises:
        LogFormatError: It does not begin with a BLF header.
    """
    return BlfLog(path, limits)


class BlfLog(Closing):
    """An open BLF log (``Log``)."""

    def __init__(self, path: Path, limits: Limits) -> None:
        """Read the header and look into the first containers for bus names.

        Raises:
            LogFormatError: It does not begin with a BLF header.
        """
        self._path, self._limits = path, limits
        self.touched: Final = Touched()
        with open_noted(path, self.touched) as file:
            self._header = _header_of(file, path)
        self._names: dict[str, int] = {}
        first = _Pass(self._path, self._header, limits, self._names, self.touched)
        for n, rows in enumerate(first.rows()):
            if len(rows) or n >= _PEEKED:
                break

    @property
    def path(self) -> Path:
        """Where it is."""
        return self._path

    @property
    def format(self) -> str:
        """Short name of the format."""
        return "blf"

    @property
    def topics(self) -> tuple[Topic, ...]:
        """The buses seen so far: those of the first containers, and after a pass all of them."""
        return tuple(bus_topic(name) for name in self._names)

    def close(self) -> None:
        """Nothing stays open between passes."""

    def report_missing(self, ledger: Ledger) -> None:
        """Bytes that the header declares and the file lacks; see ``KnowsItsEnd``."""
        declared, size = self._header.file_bytes, self._path.stat().st_size
        if not self._header.objects:
            if self._names:
                ledger.drop("", NOT_CLOSED, None, _UNCLOSED)
        elif size + PADDING_MAX < declared:
            detail = f"the header declares {declared} bytes, the file has {size}"
            ledger.drop("", "file is cut", None, detail)

    def read(self, ledger: Ledger, selection: Selection = EVERYTHING) -> Iterator[Block]:
        """All frames, a stretch of containers at a time; see ``Log.read``."""
        keep_memory()
        reading = _Pass(
            self._path, self._header, self._limits, self._names, self.touched, selection
        )
        try:
            for rows in reading.rows():
                yield from blocks_by_bus(rows, tuple(self._names), ledger, selection)
        except OSError as error:
            reading.tally.damage("file cannot be read on", error.strerror or str(error))
        for name in self._names:
            ledger.topic(name)
        reading.settle(ledger)


class _Pass:
    """One reading pass: containers in, rows out, and the account at the end."""

    def __init__(
        self,
        path: Path,
        header: FileHeader,
        limits: Limits,
        names: dict[str, int],
        touched: Touched,
        selection: Selection = EVERYTHING,
    ) -> None:
        self.tally = Tally()
        self._path, self._header, self._limits, self._names = path, header, limits, names
        self._tail = b""
        self._is_resumed = self._has_loose = False
        self._deflated = self._stored = self._wasted = 0
        self._selection, self._touched = selection, touched
        self._skips: Mapping[int, int] = {}
        self._skipped_bytes = 0

    def rows(self) -> Iterator[FrameRows]:
        """The file's frames, a stretch at a time."""
        parts: list[bytes] = []
        place, held = "", 0
        with open_noted(self._path, self._touched) as file:
            for content, where in self._contents(file):
                if content is None:
                    # Where nothing is missing, only not read, an object may end in what follows.
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
        """Hold what was met against the header, and say what was verified."""
        tally, header = self.tally, self._header
        for reason, count in sorted(tally.others.items()):
            ledger.find("", count)
            ledger.skip("", reason, count)
        self._settle_losses(ledger)
        self._say(ledger)
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

    def _say(self, ledger: Ledger) -> None:
        start_ns, stop_ns = self._header.start_ns, self._header.stop_ns
        if start_ns is None:
            ledger.notice("the log states no start time; times count from 1970-01-01")
        else:
            ledger.notice("the log states no time zone; its start time is read as UTC")
            if stop_ns is not None and start_ns + self.tally.last_tick_ns > stop_ns + 10_000_000:
                ledger.notice("frames come after the stop time in the header; one of both is wrong")
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
        return self._named(rows_of(stream, chain.start, start_ns, self.tally, place))

    def _named(self, rows: FrameRows) -> FrameRows:
        if not len(rows):
            return rows
        channels, codes = np.unique(rows.bus, return_inverse=True)
        bus = np.array(
            [bus_number(str(channel), self._names) for channel in channels.tolist()], np.int64
        )
        named = FrameRows(rows.place, bus[codes], rows.log_ns, rows.frames)
        if bool((bus < 0).any()):
            self.tally.damage("more buses than a log can have", "")
            return named.take(named.bus >= 0)
        return named

    def _contents(self, file: BufferedReader) -> Iterator[tuple[bytes | None, str]]:
        """What the outer objects hold, in order; None where something is missing."""
        size = self._path.stat().st_size
        position = self._header.size
        if size < position:
            self.tally.damage("file is cut", "inside its header")
        if self._header.objects:  # otherwise nothing says how many objects are not read
            start_ns = self._header.start_ns or 0
            # Heads of containers that are left out do not count as read.
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
                self.tally.damage("too damaged to read on", place)
                return
            if not head.startswith(MAGIC):
                near = head[: PADDING_MAX + len(MAGIC) - 1].find(MAGIC)
                found = position + near if near > 0 else self._next(file, position + 1)
                if near <= 0 and (found is not None or head.strip(b"\0")):
                    self.tally.damage("bytes that are no container", place)
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
        """Where the next object to go on with begins, at or after ``position``."""
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
        """An object outside containers, with its padding, and where it ends."""
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
        """Content and end of a container; None if damaged, and the end is then as far as known."""
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
        """Uncompressed content; where the two sizes differ the smaller one is believed."""
        content = file.read(min(body_bytes, declared))
        self._stored += 1
        if body_bytes != declared:
            reason = "file is cut, or a container's size is wrong" if is_cut else "sizes differ"
            self.tally.damage(reason, f"{place}: {body_bytes} bytes, declared {declared}")
        return content, len(content)

    def _inflated(
        self, file: BufferedReader, body_bytes: int, declared: int, place: str, is_cut: bool
    ) -> tuple[bytes | None, int]:
        """Verified content; of a container that the file's end cuts, what comes before the cut."""
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
        gave = f"more than {declared}" if produced > declared else str(produced)
        detail = f"{place}: inflates to {gave} bytes, declares {declared}"
        self.tally.damage("container differs from its declared size", detail)
        return None, 0


def _header_of(file: BufferedReader, path: Path) -> FileHeader:
    head = file.read(_HEADER.size)
    if not head:
        raise LogFormatError(f"{path}: empty file; expected a BLF log, check how it was copied")
    if len(head) < _HEADER.size or not head.startswith(b"LOGG"):
        raise LogFormatError(
            f"{path}: no BLF header at its start (expected 'LOGG', got {head[:4]!r}); "
            "check that it is a BLF log, and whole"
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
    """Windows' SYSTEMTIME (year, month, weekday, day, hour, minute, second, millisecond)."""
    year, month, _, day, hour, minute, second, millisecond = fields
    try:
        at = datetime(year, month, day, hour, minute, second, tzinfo=UTC)
    except ValueError:
        return None
    return within_range(int(at.timestamp()) * NANOS + millisecond * 1_000_000)
