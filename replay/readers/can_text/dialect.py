"""Base reader of CAN logs in text form: columnar parsing of chunks, and single lines where needed.

A ``Dialect`` parses one format. Its ``fast`` method parses all lines of a chunk that follow the
common pattern, as columns. Every other line that is not blank is parsed by ``slow``, which
classifies it as a frame, a line without a frame, a mark such as a header, or damage. Each line is
thus used, skipped or dropped.
"""

import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import ClassVar, Final, NamedTuple, TypeAlias

import numpy as np

from crosscue.replay.base import EVERYTHING, Selection
from crosscue.replay.columns import Block, Bytes, CanFrames, Int64s, Topic
from crosscue.replay.errors import LogFormatError
from crosscue.replay.files.closing import Closing
from crosscue.replay.ledger import Ledger
from crosscue.replay.readers.can_rows import (
    NO_ROWS,
    TOO_MANY_BUSES,
    FrameRows,
    blocks_by_bus,
    bus_name,
    bus_number,
    bus_topic,
    keep_memory,
    merge_rows,
    widened,
)

from .digits import Bools, payload8, payload64, spaced8
from .lines import Lines, Overlong, Tail, read_lines

HEAD_BYTES: Final = 64 << 10
# Maximum length of a line that is parsed by ``slow``.
LINE_MAX: Final = 8192
MAY_BE_CUT: Final = "last line has no line end, may be cut"
NOT_UNDERSTOOD: Final = "line not understood"
BAD_LENGTH: Final = "length differs from the number of bytes"
BAD_IDENTIFIER: Final = "identifier out of range"
_CONTROL: Final = re.compile(rb"[\x00-\x08\x0e-\x1f]")
_EXCERPT: Final = 60
_DOS_END: Final = b"\x1a"


class ParsedFrame(NamedTuple):
    """A frame parsed by ``slow``; ``t_ns`` is the time in the line, before ``Dialect.clock``."""

    bus: str
    t_ns: int
    arbitration_id: int
    is_extended: bool
    kind: int
    length: int
    payload: bytes = b""
    is_fd: bool = False
    number: int | None = None
    """The writer's message number, in formats that have them."""


class Other(NamedTuple):
    """A valid line without a frame, counted by its reason and by its bus if it has one."""

    reason: str
    t_ns: int | None = None
    bus: str = ""
    number: int | None = None


class DamagedLine(NamedTuple):
    """A line that cannot be parsed.

    With ``taints``, the same damage may have truncated the previous line.
    """

    reason: str
    taints: bool = False


class HeaderLine(NamedTuple):
    """A header or comment line.

    Attributes:
        origin_ns: New origin of the times, for ``Dialect.clock``.
        stops: Reason to stop reading here, or empty.
        tag: Value for use by the dialect.
    """

    origin_ns: int | None = None
    stops: str = ""
    tag: str = ""


Outcome: TypeAlias = ParsedFrame | Other | DamagedLine | HeaderLine | None


@dataclass(frozen=True, slots=True, eq=False)
class Fast:
    """Result of ``Dialect.fast``: ``rows.bus`` indexes ``names``, ``rows.place`` is the line."""

    rows: FrameRows
    names: tuple[str, ...]


@dataclass(slots=True, eq=False)
class ChunkResult:
    """The parsed lines of a chunk; lines count from the chunk's first.

    Attributes:
        first_number: Number of the chunk's first line in the file.
        done: The line after the chunk's last.
        rows: Frames, by line; in the end including ``odd``.
        odd: Frames parsed by ``slow``, with their lines and bus numbers.
        others: Lines without a frame.
        damaged: Lines that cannot be parsed, ascending.
        marks: Header lines.
    """

    first_number: int
    done: int
    rows: FrameRows = NO_ROWS
    odd: list[tuple[int, int, ParsedFrame]] = field(default_factory=list)
    others: list[tuple[int, Other]] = field(default_factory=list)
    damaged: list[int] = field(default_factory=list)
    marks: list[tuple[int, HeaderLine]] = field(default_factory=list)


class Dialect(ABC):
    """Parser of one text format, with the state of one pass."""

    format: ClassVar[str]
    says: ClassVar[str]
    integrity: ClassVar[str]

    @abstractmethod
    def fast(self, lines: Lines) -> Fast:
        """Parse the lines that follow the common pattern."""

    @abstractmethod
    def slow(self, line: bytes) -> Outcome:
        """Parse a line that does not follow the common pattern."""

    def last(self, line: bytes) -> Outcome:
        """Parse a last line without a line end, which may be truncated."""
        outcome = self.slow(line)
        if self.is_complete(outcome):
            return outcome
        return DamagedLine(MAY_BE_CUT) if line.strip() else None

    def is_complete(self, outcome: Outcome) -> bool:
        """Return whether the contents of a last line show that it is not truncated."""
        return False

    def clock(self, place: Int64s, t_ns: Int64s, marks: Sequence[tuple[int, HeaderLine]]) -> Int64s:
        """Convert the times in the lines to log times.

        Args:
            place: Line of every time, ascending, with and without frames.
            t_ns: Times in the lines.
            marks: Marks of this chunk with their lines.
        """
        out = np.empty_like(t_ns)
        begin = 0
        for i, mark in marks:
            end = int(place.searchsorted(i))
            out[begin:end] = self.log_times(t_ns[begin:end])
            begin = end
            self.note(mark)
        out[begin:] = self.log_times(t_ns[begin:])
        return out

    def log_times(self, t_ns: Int64s) -> Int64s:
        """Convert the times of lines between two marks to log times."""
        return t_ns

    def note(self, mark: HeaderLine) -> None:
        """Apply a mark to the lines that follow it."""
        del mark

    def check(self, chunk: ChunkResult) -> Int64s:
        """Check a chunk against the format's own counters.

        Returns:
            Lines, ascending, whose frames contradict the counters. These frames are not yielded,
            and ``finish`` reports them.
        """
        return chunk.rows.place[:0]

    def unended(self, head: bytes, tail: bytes) -> str:
        """Describe what the first and last bytes lack compared with a complete log, or empty."""
        return ""

    def finish(self, ledger: Ledger) -> None:
        """Report losses and notices after the complete file has been read."""
        del ledger


class TextCanLog(Closing):
    """An open CAN log in text form (``Log``)."""

    def __init__(self, path: Path, dialect: Callable[[], Dialect]) -> None:
        """Examine the first chunk; the size of a chunk bounds all memory here.

        Raises:
            LogFormatError: The file is empty, or its first chunk contains no line of this format.
        """
        self.path: Final = path
        self._dialect = dialect
        self._names: dict[str, int] = {}
        one = dialect()
        self.format: Final = one.format
        self._peek(one)

    @property
    def topics(self) -> tuple[Topic, ...]:
        """The buses found so far: those in the first chunk, or all buses after a pass."""
        return tuple(bus_topic(name) for name in self._names)

    def read(self, ledger: Ledger, selection: Selection = EVERYTHING) -> Iterator[Block]:
        """Yield all frames, chunk by chunk; see ``Log.read``."""
        keep_memory()
        scribe = _ChunkParser(self._dialect(), self._names, ledger)
        size = self.path.stat().st_size
        try:
            for piece in read_lines(self.path):
                rows = scribe.rows(piece)
                yield from blocks_by_bus(rows, tuple(self._names), ledger, selection)
                if scribe.stopped:
                    break
        except OSError as error:
            ledger.drop("", "reading the file failed", None, error.strerror or str(error))
        for name in self._names:
            ledger.topic(name)
        if self.path.stat().st_size != size:
            ledger.drop("", "file changed while it was read", None, f"had {size} bytes before")
        scribe.dialect.finish(ledger)
        ledger.integrity = scribe.dialect.integrity

    def report_missing(self, ledger: Ledger) -> None:
        """Report a truncated end, from the last 64 KiB; see ``KnowsItsEnd``."""
        head, dialect = head_of(self.path), self._dialect()
        with self.path.open("rb") as file:
            file.seek(max(0, self.path.stat().st_size - HEAD_BYTES))
            tail = file.read(HEAD_BYTES)
        last = tail[tail.rfind(b"\n") + 1 :]
        if last not in (b"", _DOS_END):
            outcome = dialect.last(last) if len(last) <= LINE_MAX else None
            if outcome is None or isinstance(outcome, ParsedFrame | DamagedLine):
                detail = f"{len(last)} bytes without a line end: {last[:_EXCERPT]!r}"
                ledger.drop("", "file may be cut in its last line", None, detail)
        if missing := dialect.unended(head, tail):
            ledger.drop("", missing, None)

    def _peek(self, dialect: Dialect) -> None:
        ledger = Ledger(str(self.path))
        scribe = _ChunkParser(dialect, self._names, ledger)
        for piece in read_lines(self.path, HEAD_BYTES):
            found = len(scribe.rows(piece))
            if isinstance(piece, Lines) or found or scribe.is_recognised:
                break
        if not self._names and not scribe.is_recognised:
            why = next((f"{d.reason}: {d.detail}" for d in ledger.drops()), "it is empty")
            raise LogFormatError(
                f"{self.path}: no frame of a {dialect.says} at its start ({why}); "
                "check that it is a complete log of this format"
            )


class _ChunkParser:
    """Converts chunks to rows and records all other lines in the ledger."""

    def __init__(self, dialect: Dialect, names: dict[str, int], ledger: Ledger) -> None:
        self.dialect = dialect
        self.stopped = False
        self.is_recognised = False
        self._names, self._ledger = names, ledger

    def rows(self, piece: Lines | Overlong | Tail) -> FrameRows:
        """Parse the frames of a piece of the file, with log times."""
        if isinstance(piece, Lines):
            return self._lines(piece)
        if isinstance(piece, Tail):
            return self._tail(piece)
        detail = f"line {piece.number}: at least {piece.byte_count} bytes without a line end"
        self._ledger.drop("", "no line end over many bytes", None, detail)
        return NO_ROWS

    def _tail(self, tail: Tail) -> FrameRows:
        if tail.text == _DOS_END:
            return NO_ROWS
        chunk = ChunkResult(tail.number, 1)
        outcome = self.dialect.last(tail.text) if len(tail.text) <= LINE_MAX else None
        if outcome is None and tail.text.strip():
            outcome = DamagedLine(MAY_BE_CUT)
        if outcome is None or isinstance(outcome, ParsedFrame):
            detail = f"line {tail.number} has no line end"
            self._ledger.drop("", "file may be cut after its last frame", None, detail)
        self._add(chunk, 0, tail.text, outcome)
        return self._finished(chunk)

    def _lines(self, lines: Lines) -> FrameRows:
        rows = self._renamed(self.dialect.fast(lines))
        chunk, tainted = ChunkResult(lines.first_number, lines.done, rows), list[int]()
        for i in _left_over(lines, rows):
            line = lines.text(i)
            outcome = self._outcome_of(line)
            if isinstance(outcome, DamagedLine) and outcome.taints and i > 0:
                tainted.append(i - 1)
            if i >= lines.done:
                break
            self._add(chunk, i, line, outcome)
            if self.stopped:
                chunk.done = i
                return self._finished(chunk)
        return self._untainted(self._finished(chunk), tainted, lines)

    def _outcome_of(self, line: bytes) -> Outcome:
        if len(line) > LINE_MAX:
            return DamagedLine("line too long")
        outcome = self.dialect.slow(line)
        if _CONTROL.search(line):
            taints = isinstance(outcome, DamagedLine) and outcome.taints
            return DamagedLine("control characters in a line", taints)
        return outcome

    def _add(self, chunk: ChunkResult, i: int, line: bytes, outcome: Outcome) -> None:
        number = chunk.first_number + i
        match outcome:
            case ParsedFrame():
                code = bus_number(outcome.bus, self._names)
                if code < 0:
                    chunk.damaged.append(i)
                    self._drop("", TOO_MANY_BUSES, number, line)
                else:
                    chunk.odd.append((i, code, outcome))
            case Other():
                self.is_recognised = True
                chunk.others.append((i, outcome))
            case DamagedLine():
                chunk.damaged.append(i)
                self._drop("", outcome.reason, number, line)
            case HeaderLine():
                self.is_recognised = True
                chunk.marks.append((i, outcome))
                if outcome.stops:
                    self.stopped = True
                    self._ledger.drop("", outcome.stops, None, f"from line {number} on")
            case None:
                pass

    def _drop(self, topic: str, reason: str, number: int, line: bytes) -> None:
        excerpt = line[:_EXCERPT].decode("ascii", "backslashreplace")
        dots = "..." if len(line) > _EXCERPT else ""
        self._ledger.drop(topic, reason, 1, f"line {number}: {excerpt!r}{dots}")

    def _untainted(self, rows: FrameRows, tainted: list[int], lines: Lines) -> FrameRows:
        if not tainted:
            return rows
        is_bad = np.isin(rows.place, tainted)
        names = tuple(self._names)
        for k in np.flatnonzero(is_bad).tolist():
            i = int(rows.place[k])
            reason = "followed by a broken line, may be cut"
            self._drop(names[rows.bus[k]], reason, lines.first_number + i, lines.text(i))
        return rows.take(~is_bad)

    def _finished(self, chunk: ChunkResult) -> FrameRows:
        """Merge the rows of ``fast`` and ``slow``, with log times, and check them."""
        others: dict[tuple[str, str], list[int]] = {}
        for i, other in chunk.others:
            others.setdefault((other.bus, other.reason), []).append(chunk.first_number + i)
        for (bus, reason), numbers in others.items():
            topic = bus and bus_name(bus)
            self._ledger.find(topic, len(numbers))
            self._ledger.skip(topic, reason, len(numbers), f"from line {numbers[0]} on")
        done = int(np.searchsorted(chunk.rows.place, chunk.done))
        rows = merge_rows((chunk.rows.take(slice(0, done)), _slow_rows(chunk.odd)))
        place, t_ns = rows.place, rows.log_ns
        times = [(i, other.t_ns) for i, other in chunk.others if other.t_ns is not None]
        if times:
            at, values = (np.array(column, np.int64) for column in zip(*times, strict=True))
            place, t_ns = np.concatenate((place, at)), np.concatenate((t_ns, values))
        order = np.argsort(place, kind="stable") if times else slice(None)
        log_ns = np.empty_like(t_ns)
        log_ns[order] = self.dialect.clock(place[order], t_ns[order], chunk.marks)
        chunk.rows = rows = replace(rows, log_ns=log_ns[: len(rows)])
        refused = self.dialect.check(chunk)
        return rows.take(~np.isin(rows.place, refused)) if len(refused) else rows

    def _renamed(self, fast: Fast) -> FrameRows:
        rows = fast.rows
        if not len(rows):
            return rows
        if len(fast.names) == 1 and bus_number(fast.names[0], self._names) == 0:
            return rows
        uses = np.bincount(rows.bus, minlength=len(fast.names)).tolist()
        named = zip(fast.names, uses, strict=True)
        codes = np.array(
            [bus_number(name, self._names) if used else -1 for name, used in named], np.int64
        )
        bus = codes[rows.bus]
        renamed = replace(rows, bus=bus)
        return renamed.take(bus >= 0) if bool((bus < 0).any()) else renamed


def _left_over(lines: Lines, rows: FrameRows) -> list[int]:
    """Return the lines that are neither blank nor in ``rows``."""
    if len(rows) == len(lines):
        return []
    is_odd = lines.stop > lines.start
    is_odd[rows.place] = False
    left: list[int] = np.flatnonzero(is_odd).tolist()
    return left


def _slow_rows(odd: Sequence[tuple[int, int, ParsedFrame]]) -> FrameRows:
    """Return the frames that were parsed by ``slow`` as rows."""
    if not odd:
        return NO_ROWS
    place, bus, frames = zip(*odd, strict=True)
    width = 64 if any(f.is_fd or len(f.payload) > 8 for f in frames) else 8
    payload = b"".join(f.payload.ljust(width, b"\0") for f in frames)
    return FrameRows(
        np.array(place, np.int64),
        np.array(bus, np.int64),
        np.array([f.t_ns for f in frames], np.int64),
        CanFrames(
            np.array([f.arbitration_id for f in frames], np.uint32),
            np.array([f.is_extended for f in frames], np.bool_),
            np.array([f.kind for f in frames], np.uint8),
            np.array([f.length for f in frames], np.uint8),
            np.frombuffer(payload, np.uint8).reshape(-1, width).copy(),
            np.array([f.is_fd for f in frames], np.bool_),
        ),
    )


_FRAME_LIKE: Final = re.compile(
    r"\d[.,]\d+\s+(?:.*\s)?(?:[RT]x|DT|F[BDE]|BI|RR)\s|\d\)\s+\d+[.,]?\d*\s+[0-9A-Fa-f]{4,8}\s"
)


def comment(text: str) -> Outcome:
    """Parse a comment line, to which damage may have joined the line of a frame."""
    if _FRAME_LIKE.search(text):
        return Other("comment that holds a frame")
    return None


def head_of(path: Path) -> bytes:
    """Read the first 64 KiB of a file, which contain its header.

    Raises:
        LogFormatError: The file is empty, compressed or UTF-16; the message states the remedy.
    """
    with path.open("rb") as file:
        head = file.read(HEAD_BYTES)
    if not head:
        raise LogFormatError(f"{path}: empty file; expected a CAN log, check how it was copied")
    for magic, what, todo in (
        (b"\x1f\x8b", "compressed with gzip", "unpack it first (gzip -d)"),
        (b"\xff\xfe", "UTF-16 text", "save it as UTF-8"),
        (b"\xfe\xff", "UTF-16 text", "save it as UTF-8"),
        (b"PK\x03\x04", "a zip archive", "unpack it first"),
    ):
        if head.startswith(magic):
            raise LogFormatError(f"{path}: {what}, expected plain text; {todo}")
    return head


def payloads(
    lines: Lines, start: Int64s, length: Int64s, is_fd: Bools, gap: int | None
) -> tuple[Bytes, Bools]:
    """Parse payloads in hexadecimal, with the character ``gap`` or nothing between the bytes.

    Returns:
        Bytes of shape (N, 8), or (N, 64) if a frame is CAN FD, and a mask of the valid payloads.
    """
    if gap is None:
        payload, ok = payload8(lines.words, start, length)
    else:
        payload, ok = spaced8(lines.words, start, length, gap)
    if not bool(is_fd.any()):
        return payload, ok
    payload = widened(payload, 64)
    long = np.flatnonzero(length > 8)
    payload[long], ok[long] = payload64(lines.buffer, start[long], length[long], gap)
    return payload, ok


def picked(keep: Bools, rows: FrameRows, spelled: Sequence[bytes]) -> Fast:
    """Return the rows that passed every check of ``fast``, whose buses are spelled so."""
    names = tuple(one.decode("ascii", "replace") for one in spelled)
    return Fast(rows if bool(keep.all()) else rows.take(keep), names)
