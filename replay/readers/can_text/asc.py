"""Reader of Vector ASC logs: ``0.019968 1  64  Rx   d 4 64 00 00 00``.

It reads CAN and CAN FD frames, remote frames and error frames. Other events (statistics, status,
J1939TP, LIN, ...) are counted as lines without a frame. Times are relative to the header's date.
The date has no time zone and is read as UTC, with a notice, regardless of the machine's time zone.
``timestamps relative`` times, which are relative to the previous line, are summed over all lines
that have one.

``Statistic`` lines count the data, remote and error frames of a channel. They are not used: no
public description states their time range, and a logging filter removes frames from the log but not
from these counts.

The format has no checksum. Each line contains its length, so a truncated line is detected.
``End TriggerBlock`` shows that the writer finished the file.
"""

import re
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

import numpy as np

from crosscue.replay.base import Log
from crosscue.replay.columns import DATA, ERROR, REMOTE, Int64s
from crosscue.replay.ledger import Ledger
from crosscue.replay.limits import Limits
from crosscue.replay.readers.can_rows import FD_LENGTHS

from .dialect import (
    BAD_IDENTIFIER,
    BAD_LENGTH,
    NOT_UNDERSTOOD,
    DamagedLine,
    Dialect,
    Fast,
    HeaderLine,
    Other,
    Outcome,
    ParsedFrame,
    TextCanLog,
    comment,
    head_of,
)
from .digits import (
    NANOS,
    OUT_OF_RANGE,
    SECONDS_MAX,
    TIME_MAX_NS,
    Bools,
    decimal,
    nibble,
    seconds_ns,
    within_range,
)
from .lines import Lines, WordRanges, clean_lines, next_fields, skip_gap
from .spaced import (
    NOTHING_FAST,
    Spaced,
    is_bus_name,
    is_direction,
    joined_fast,
    payload_stop,
    spaced_frames,
)

_DATE: Final = re.compile(
    r"(?:[^\s\d]+\s+)?([^\s\d]+)\s+(\d{1,2})\s+(\d{1,2}):(\d\d):(\d\d)(?:[.,](\d{1,9}))?"
    r"\s*([ap]m)?\s+(\d{4})\s*",
    re.IGNORECASE,
)
# English and German, the languages that the writing tools use.
_MONTHS: Final = {
    "jan": 1, "feb": 2, "mar": 3, "mär": 3, "mrz": 3, "apr": 4, "may": 5, "mai": 5, "jun": 6,
    "jul": 7, "aug": 8, "sep": 9, "oct": 10, "okt": 10, "nov": 11, "dec": 12, "dez": 12,
}  # fmt: skip
_HEADER_DATE: Final = re.compile(r"date\s+(.*)", re.IGNORECASE)
_HEADER_BASE: Final = re.compile(
    r"base\s+(hex|dec)(?:\s+timestamps\s+(absolute|relative))?\s*", re.IGNORECASE
)
_HEADER_EVENTS: Final = re.compile(r"(no\s+)?internal\s+events\s+logged\s*", re.IGNORECASE)
_BEGIN: Final = re.compile(r"begin\s+triggerblock(.*)", re.IGNORECASE)
_END: Final = re.compile(r"end\s+triggerblock\s*", re.IGNORECASE)
_TIMED: Final = re.compile(r"\s*(\d{1,10})[.,](\d{1,9})\s+(\S.*?)\s*")
_EVENT: Final = re.compile(
    r"""(?:CAN\s+)?\S+\s+Status:.* | \S+\s+Statistic:.* | \S+\s+J1939TP\s.* | \S+\s+OverloadFrame.*
    | Start\s+of\s+measurement.* | log\s+(?:trigger|direct)\s.* | \S+\s+\S+\s+TxRq\s.*
    | (?:LIN|Li|L\d+|FR|Fr|ETH|Eth|MOST|GPS|SV:|EnvVar|Env:|TFS:|Comment:?|TextEvent:?|//|WLAN|AFDX
      |A429|SPI|K-Line|KLINE|Diag|SYS|Sys|SUB|Watermark|Global|Trigger|CAPL)\b.*
    | \S+\s+:=\s.*""",
    re.VERBOSE,
)
_ERROR: Final = re.compile(r"(\S+)\s+ErrorFrame(?:\s.*)?", re.IGNORECASE)
_FD_ERROR: Final = re.compile(r"CANFD\s+(\S+)\s+[RT]x\s+ErrorFrame(?:\s.*)?", re.IGNORECASE)
_SECOND: Final = re.compile(r"\d[.,]\d{1,9}\s+(?:CANFD\s+)?\S+\s(?:.*\s)?[RT]x\s")
# Maximum time between two lines; a longer one is damage.
_STEP_MAX_NS: Final = 86_400 * NANOS
_IDENTIFIER: Final = re.compile(r"([0-9A-Fa-f]{1,10})([xX]?)")
_TWO_HEX: Final = re.compile(r"[0-9A-Fa-f]{2}")
NOT_ENDED: Final = "no 'End TriggerBlock': the log may be cut"
_BEGIN_WORDS, _END_WORDS = b"begin triggerblock", b"end triggerblock"
_CANFD: Final = np.uint64(int.from_bytes(b"CANFD", "little"))
_BEGINS, _ENDS = "begins", "ends"


def open_asc(path: Path, limits: Limits) -> Log:
    """Open an ASC log.

    Raises:
        LogFormatError: The start of the file has neither a header nor a line of this format.
    """
    head = head_of(path)
    return TextCanLog(path, lambda: Asc(head))


class Asc(Dialect):
    """One pass over an ASC log."""

    format = "asc"
    says = "Vector ASC log"
    integrity = (
        "ASC text has no checksums and no usable counts (its Statistic lines count frames of the "
        "bus over an unknown time): a changed digit or a missing line cannot be detected"
    )

    def __init__(self, head: bytes) -> None:
        """Read the number base, the time mode and the date from the start of the file."""
        self._base, self._is_relative, self._start_ns = 16, False, 0
        self._has_date = self._has_header = False
        self._last_ns = 0
        self._block = ""
        self._other_dates = self._has_events = False
        for raw in head.splitlines():
            line = raw.decode("latin-1").strip().removeprefix("\xef\xbb\xbf")
            if found := _HEADER_BASE.fullmatch(line):
                self._base, self._is_relative = _base_of(found)
                self._has_header = True
            elif _TIMED.fullmatch(line):
                break

    def fast(self, lines: Lines) -> Fast:
        """Parse data frames in hexadecimal, including CAN FD."""
        if self._base != 16:
            return NOTHING_FAST
        line = _single(lines, clean_lines(lines))
        if not len(line):
            return NOTHING_FAST
        head = next_fields(lines, lines.start[line], lines.stop[line], 6)
        t_ns, ok = seconds_ns(lines.buffer, lines.words, head[0].start, head[0].stop)
        if self._is_relative:
            ok &= t_ns <= _STEP_MAX_NS
        is_fd = _is_fd(lines, head[1])
        parts = [
            _classic(lines, line, head, t_ns, ok & ~is_fd),
            _fd(lines, line, head, t_ns, ok & is_fd),
        ]
        return joined_fast([part for part in parts if len(part.rows)])

    def slow(self, line: bytes) -> Outcome:
        """Parse headers, events, remote frames, error frames and decimal logs."""
        text = line.decode("latin-1")
        if found := _TIMED.fullmatch(text):
            seconds = int(found[1])
            if seconds > SECONDS_MAX:
                return DamagedLine(OUT_OF_RANGE)
            return self._timed(seconds * NANOS + int(found[2].ljust(9, "0")), found[3])
        text = text.strip().removeprefix("\xef\xbb\xbf")
        if not text or text.startswith("//"):
            return comment(text)
        return self._header(text)

    def is_complete(self, outcome: Outcome) -> bool:
        """Return whether the line has as many bytes as its length states, or is a mark."""
        if isinstance(outcome, ParsedFrame):
            return self._base == 16 and outcome.kind != REMOTE
        return outcome is not None and not isinstance(outcome, Other)

    def unended(self, head: bytes, tail: bytes) -> str:
        """Check for an ``End TriggerBlock`` after the last start of a block."""
        begins = max(head.lower().rfind(_BEGIN_WORDS), tail.lower().rfind(_BEGIN_WORDS))
        is_open = tail.lower().rfind(_END_WORDS) <= tail.lower().rfind(_BEGIN_WORDS)
        return NOT_ENDED if begins >= 0 and is_open else ""

    def finish(self, ledger: Ledger) -> None:
        """Report the basis of the clock, and whether the writer finished the file."""
        if self._has_date:
            ledger.notice("the log states no time zone; its start date is read as UTC")
        else:
            ledger.notice(
                "the log states no readable start date before 2116; times count from 1970"
            )
        if not self._has_header:
            ledger.notice("the log has no 'base' line; read as hexadecimal, absolute times")
        if self._other_dates:
            ledger.notice("a trigger block states another date than the header, which is used")
        if self._is_relative and not ledger.is_whole:
            ledger.notice("times are relative to the previous line: a lost line shifts later ones")
        if self._block == _BEGINS:
            ledger.drop("", NOT_ENDED, None)
        elif not self._block and not self._has_events:
            ledger.drop("", "a header without any frame: the log may be cut", None)

    def log_times(self, t_ns: Int64s) -> Int64s:
        """Add the date, and sum up times that are relative to the previous line."""
        self._has_events |= len(t_ns) > 0
        if self._is_relative and len(t_ns):
            t_ns = np.minimum(np.cumsum(t_ns) + self._last_ns, TIME_MAX_NS)
            self._last_ns = int(t_ns[-1])
        return t_ns + self._start_ns

    def note(self, mark: HeaderLine) -> None:
        """Set the start of the times after a date, and whether a block is open."""
        if mark.tag:
            self._block = mark.tag
        if mark.origin_ns is None:
            return
        if mark.tag != _BEGINS or not self._has_date:
            self._start_ns, self._last_ns, self._has_date = mark.origin_ns, 0, True
        elif mark.origin_ns != self._start_ns:
            self._other_dates = True

    def _header(self, text: str) -> Outcome:
        if found := _HEADER_DATE.fullmatch(text):
            return HeaderLine(_date_ns(found[1]))
        if found := _BEGIN.fullmatch(text):
            return HeaderLine(_date_ns(found[1].strip()), tag=_BEGINS)
        if _END.fullmatch(text):
            return HeaderLine(tag=_ENDS)
        if _HEADER_EVENTS.fullmatch(text):
            return HeaderLine()
        if found := _HEADER_BASE.fullmatch(text):
            is_same = _base_of(found) == (self._base, self._is_relative)
            return HeaderLine(stops="" if is_same else "a different 'base' line inside the file")
        return DamagedLine(NOT_UNDERSTOOD)

    def _timed(self, t_ns: int, rest: str) -> Outcome:
        if _SECOND.search(rest):
            return DamagedLine("two lines in one")
        if self._is_relative and t_ns > _STEP_MAX_NS:
            return DamagedLine(OUT_OF_RANGE)
        if _EVENT.fullmatch(rest):
            return Other("event that is not a CAN frame", t_ns)
        if not rest.isascii():
            return DamagedLine(NOT_UNDERSTOOD)
        if found := _FD_ERROR.fullmatch(rest) or _ERROR.fullmatch(rest):
            is_fd = rest[:5].upper() == "CANFD"
            return _checked(ParsedFrame(found[1], t_ns, 0, False, ERROR, 0, b"", is_fd))
        words = rest.split()
        if words[0].upper() == "CANFD":
            return self._fd_frame(t_ns, words[1:])
        if len(words) >= 4 and words[2].lower() in ("rx", "tx"):
            return self._frame(t_ns, words)
        return DamagedLine(NOT_UNDERSTOOD)

    def _frame(self, t_ns: int, words: list[str]) -> Outcome:
        bus, _, _, letter = words[:4]
        rest = words[4:]
        found = self._identifier(words[1])
        if found is None:
            return DamagedLine(BAD_IDENTIFIER)
        if letter.lower() == "r":
            return _checked(ParsedFrame(bus, t_ns, *found, REMOTE, 0))
        if letter.lower() != "d" or not rest or not _is_code(rest[0], self._base):
            return DamagedLine(NOT_UNDERSTOOD)
        length = min(int(rest[0], self._base), 8)
        payload = self._payload(rest[1:], length)
        if payload is None:
            return DamagedLine(BAD_LENGTH)
        return _checked(ParsedFrame(bus, t_ns, *found, DATA, length, payload))

    def _fd_frame(self, t_ns: int, words: list[str]) -> Outcome:
        if len(words) < 7 or words[1].lower() not in ("rx", "tx"):
            return DamagedLine(NOT_UNDERSTOOD)
        found = self._identifier(words[2])
        rest = words[3:] if words[3] in ("0", "1") else words[4:]
        if found is None:
            return DamagedLine(BAD_IDENTIFIER)
        if len(rest) < 4 or {rest[0], rest[1]} - {"0", "1"} or not _is_code(rest[2], self._base):
            return DamagedLine(NOT_UNDERSTOOD)
        code = int(rest[2], self._base)
        if rest[3] == "0" and code:
            return _checked(ParsedFrame(words[0], t_ns, *found, REMOTE, 0, b"", True))
        length = int(FD_LENGTHS[code])
        payload = self._payload(rest[4:], length, is_last=False)
        if rest[3] != str(length) or payload is None:
            return DamagedLine(BAD_LENGTH)
        return _checked(ParsedFrame(words[0], t_ns, *found, DATA, length, payload, True))

    def _identifier(self, word: str) -> tuple[int, bool] | None:
        found = _IDENTIFIER.fullmatch(word)
        try:
            value = int(found[1], self._base) if found else -1
        except ValueError:
            return None
        is_extended = bool(found and found[2])
        is_valid = 0 <= value <= (0x1FFFFFFF if is_extended else 0x7FF)
        return (value, is_extended) if is_valid else None

    def _payload(self, words: list[str], length: int, is_last: bool = True) -> bytes | None:
        """Convert ``length`` words to bytes; None if there are fewer, or more with ``is_last``."""
        if len(words) < length:
            return None
        if self._base == 10:
            good = all(w.isascii() and w.isdigit() and int(w) < 256 for w in words[:length])
            return bytes(int(w) for w in words[:length]) if good else None
        if is_last and len(words) > length and _TWO_HEX.fullmatch(words[length]):
            return None
        good = all(_TWO_HEX.fullmatch(w) for w in words[:length])
        return bytes(int(w, 16) for w in words[:length]) if good else None


def _base_of(found: re.Match[str]) -> tuple[int, bool]:
    return 10 if found[1].lower() == "dec" else 16, (found[2] or "").lower() == "relative"


def _is_code(word: str, base: int) -> bool:
    if base == 10:
        return word.isascii() and word.isdigit() and int(word) <= 15
    return len(word) == 1 and word in "0123456789abcdefABCDEF"


def _checked(frame: ParsedFrame) -> Outcome:
    if not is_bus_name(frame.bus.encode("latin-1", "replace")):
        return DamagedLine(NOT_UNDERSTOOD)
    return frame


def _date_ns(text: str) -> int | None:
    found = _DATE.fullmatch(text)
    month = _MONTHS.get(found[1].lower()[:3]) if found else None
    if not found or month is None:
        return None
    hour = int(found[3])
    if found[7]:
        hour = hour % 12 + (12 if found[7].lower() == "pm" else 0)
    try:
        start = datetime(
            int(found[8]), month, int(found[2]), hour, int(found[4]), int(found[5]), tzinfo=UTC
        )
    except ValueError:
        return None
    return within_range(int(start.timestamp()) * NANOS + int((found[6] or "0").ljust(9, "0")))


def _single(lines: Lines, line: Int64s) -> Int64s:
    """Remove lines with two ``Rx`` or ``Tx``, which are two lines joined by damage."""
    begin, end = int(lines.start[0]), int(lines.stop[-1])
    text = lines.buffer[begin:end]
    # "R" and "T" differ in two bits, which are masked.
    is_mark = (text[1:] == ord("x")) & ((text[:-1] & 0xF9) == (ord("R") & ord("T")))
    at = np.flatnonzero(is_mark) + begin
    first = np.searchsorted(at, lines.start[line])
    twice = np.append(at, [end, end])[np.minimum(first + 1, len(at))] < lines.stop[line]
    return line[~twice] if bool(twice.any()) else line


def _is_fd(lines: Lines, word: WordRanges) -> Bools:
    """Return whether each word is ``CANFD``."""
    found: Bools = (lines.words[word.start] & np.uint64(0xFFFFFFFFFF)) == _CANFD
    found &= word.size == 5
    return found


def _classic(lines: Lines, line: Int64s, head: list[WordRanges], t_ns: Int64s, ok: Bools) -> Fast:
    """Parse ``time bus id Rx d 8`` and the bytes, with no further byte after the last one."""
    if not bool(ok.any()):
        return NOTHING_FAST
    _, bus, identifier, way, letter, code = head
    length = nibble(lines.buffer[code.start])
    ok = ok & (lines.buffer[letter.start] == ord("d")) & (letter.size == 1)
    ok &= is_direction(lines, way) & (length <= 8) & (code.size == 1)
    limit = lines.stop[line]
    payload = skip_gap(lines, code.stop, limit)
    no_fd = np.zeros(len(line), np.bool_)
    at = _spaced(lines, line, bus, identifier, np.where(length <= 8, length, 0), payload, no_fd)
    (follower,) = next_fields(lines, np.minimum(payload_stop(at), limit), limit, 1)
    return spaced_frames(lines, at, t_ns, ok & (follower.size != 2))


def _fd(lines: Lines, line: Int64s, head: list[WordRanges], t_ns: Int64s, ok: Bools) -> Fast:
    """Parse ``time CANFD bus Rx id [name] brs esi code count`` and the bytes."""
    keep = np.flatnonzero(ok)
    if not len(keep):
        return NOTHING_FAST
    line, t_ns = line[keep], t_ns[keep]
    _, _, bus, way, identifier, maybe_name = (field.take(keep) for field in head)
    limit = lines.stop[line]
    start = np.where(_is_flag(lines, maybe_name), maybe_name.start, maybe_name.stop)
    switch, state, code, count, rest = next_fields(lines, start, limit, 5)
    length_code = nibble(lines.buffer[code.start])
    length, ok = decimal(lines.words, count.stop, count.size)
    ok &= _is_flag(lines, switch) & _is_flag(lines, state) & is_direction(lines, way)
    # A count of 0 with a different code is a remote frame.
    ok &= (code.size == 1) & (length == FD_LENGTHS[length_code & 15]) & (length_code < 16)
    length = np.where(ok, length, 0)
    is_fd = np.ones(len(line), np.bool_)
    at = _spaced(lines, line, bus, identifier, length, rest.start, is_fd)
    return spaced_frames(lines, at, t_ns, ok)


def _spaced(
    lines: Lines,
    line: Int64s,
    bus: WordRanges,
    identifier: WordRanges,
    length: Int64s,
    payload: Int64s,
    is_fd: Bools,
) -> Spaced:
    """Return the fields, with the ``x`` of 29-bit identifiers removed."""
    is_extended: Bools = (lines.buffer[identifier.stop - 1] | 0x20) == ord("x")
    digits = WordRanges(identifier.start, identifier.stop - is_extended)
    return Spaced(line, bus, digits, is_extended, length, payload, is_fd)


def _is_flag(lines: Lines, word: WordRanges) -> Bools:
    letter = lines.buffer[word.start]
    found: Bools = (letter == ord("0")) | (letter == ord("1"))
    found &= word.size == 1
    return found
