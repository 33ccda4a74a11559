"""Reader of BUSMASTER logs: ``22:20:14:992 Rx 0 0000021A s 8 FE 36 12 FE 69 05 07 AD``.

Times are times of day, which restart at midnight. The date and the time mode are in the header. The
file states no time zone, so its clock is read as UTC, with a notice.
"""

import re
from datetime import UTC, datetime
from typing import Final

import numpy as np

from crosscue.replay.columns import DATA, REMOTE, Int64s
from crosscue.replay.ledger import Ledger

from .dialect import (
    BAD_IDENTIFIER,
    BAD_LENGTH,
    DamagedLine,
    Dialect,
    Fast,
    HeaderLine,
    Other,
    Outcome,
    ParsedFrame,
)
from .digits import NANOS, TIME_MAX_NS, Bools, decimal, within_range
from .lines import Lines, clean_lines, next_fields, skip_gap
from .spaced import NOTHING_FAST, Spaced, is_direction, payload_stop, spaced_frames

BUSMASTER_HEAD: Final = b"***BUSMASTER"
DAY_NS: Final = 86_400 * NANOS

_START: Final = re.compile(
    rb"\*\*\*START DATE AND TIME (\d+):(\d+):(\d+) (\d+):(\d+):(\d+):(\d+)\*\*\*"
)
_LINE: Final = re.compile(
    rb"(\d{1,3}):(\d\d):(\d\d):(\d{1,9}) ([RT]x) (\d+) (?:0x)?([0-9A-Fa-f]{1,9}) ([sx])(r?) "
    rb"(\d{1,2})((?: [0-9A-Fa-f]{1,3})*) ?"
)
_EVENT: Final = re.compile(rb"\d{1,3}:\d\d:\d\d:\d+\s.*(ERR|ERROR|Error|WARNING)")


class Busmaster(Dialect):
    """One pass over a BUSMASTER log."""

    format = "candump"
    says = "BUSMASTER log"
    integrity = (
        "BUSMASTER text has no checksums or counts: a changed digit or a missing line cannot be "
        "detected"
    )

    def __init__(self, head: bytes) -> None:
        """Read the time mode and the number base from the start of the file."""
        self._base = 10 if b"***DEC***" in head else 16
        self._is_relative = b"***RELATIVE MODE***" in head
        self._is_clock = b"***SYSTEM MODE***" in head
        self._day_ns = self._start_ns = 0
        self._last_ns: int | None = None
        self._is_dated = False
        found = _START.search(head)
        if found:
            self.note(HeaderLine(_start_of(found)))

    def fast(self, lines: Lines) -> Fast:
        """Parse data frames in hexadecimal."""
        line = clean_lines(lines)
        if self._base != 16 or not len(line):
            return NOTHING_FAST
        limit = lines.stop[line]
        time, way, bus, identifier, letter, code, rest = next_fields(
            lines, lines.start[line], limit, 7
        )
        buffer = lines.buffer
        length = buffer[code.start].astype(np.int64) - ord("0")
        kind = buffer[letter.start]
        ok = (length >= 0) & (length <= 8) & (code.size == 1) & (letter.size == 1)
        ok &= ((kind == ord("s")) | (kind == ord("x"))) & is_direction(lines, way)
        t_ns, time_ok = _time_of_day(lines, time.start, time.stop)
        no_fd = np.zeros(len(line), np.bool_)
        at = Spaced(
            line, bus, identifier, kind == ord("x"), np.clip(length, 0, 8), rest.start, no_fd
        )
        ok &= skip_gap(lines, np.minimum(payload_stop(at), limit), limit) == limit
        return spaced_frames(lines, at, t_ns, ok & time_ok)

    def slow(self, line: bytes) -> Outcome:
        """Parse header lines, remote frames and decimal logs."""
        line = line.rstrip()
        if line.startswith(b"***"):
            return self._header(line)
        if found := _LINE.fullmatch(line):
            return self._frame(found)
        if _EVENT.match(line):
            return Other("error or warning, no frame")
        return DamagedLine("line is not a BUSMASTER frame") if line else None

    def is_complete(self, outcome: Outcome) -> bool:
        """Return whether the line has as many bytes as its length states, in hexadecimal."""
        return isinstance(outcome, ParsedFrame) and outcome.kind == DATA and self._base == 16

    def finish(self, ledger: Ledger) -> None:
        """Report the basis of the clock."""
        if self._is_dated:
            ledger.notice("the log states no time zone; its start date and times are read as UTC")
        else:
            ledger.notice("the log states no start date before 2116; times count from 1970-01-01")

    def log_times(self, t_ns: Int64s) -> Int64s:
        """Add the date and a day at every midnight, or sum up relative times."""
        if not len(t_ns):
            return t_ns
        if self._is_relative:
            before = self._start_ns if self._last_ns is None else self._last_ns
            steps = np.cumsum(np.minimum(t_ns, DAY_NS))
            total: Int64s = np.minimum(steps + before, TIME_MAX_NS)
            self._last_ns = int(total[-1])
            return total
        if not self._is_clock:
            return t_ns + self._start_ns
        before = t_ns[0] if self._last_ns is None else self._last_ns
        step = np.diff(t_ns, prepend=before)
        days = np.cumsum(step < -DAY_NS // 2)
        self._last_ns = int(t_ns[-1])
        out = t_ns + self._day_ns + days * DAY_NS
        self._day_ns += int(days[-1]) * DAY_NS
        return out

    def note(self, mark: HeaderLine) -> None:
        """Start again at the date of a new session."""
        if mark.origin_ns is None:
            return
        start_ns = self._start_ns = mark.origin_ns
        self._is_dated = True
        self._day_ns = start_ns - start_ns % DAY_NS
        self._last_ns = None

    def _header(self, line: bytes) -> Outcome:
        if found := _START.fullmatch(line):
            return HeaderLine(origin_ns=_start_of(found))
        if (b"***DEC***" in line) != (self._base == 10) and line in (b"***DEC***", b"***HEX***"):
            return HeaderLine(stops="a different number base inside the file")
        return HeaderLine()

    def _frame(self, found: re.Match[bytes]) -> Outcome:
        hour, minute, second = int(found[1]), int(found[2]), int(found[3])
        t_ns = (hour * 3600 + minute * 60 + second) * NANOS + _fraction_ns(found[4])
        try:
            identifier = int(found[7], self._base)
            payload = bytes(int(one, self._base) for one in found[11].split())
        except ValueError:
            return DamagedLine("number out of range")
        is_extended, is_remote = found[8] == b"x", bool(found[9])
        if identifier > (0x1FFFFFFF if is_extended else 0x7FF):
            return DamagedLine(BAD_IDENTIFIER)
        if len(payload) != (0 if is_remote else int(found[10])) or len(payload) > 8:
            return DamagedLine(BAD_LENGTH)
        kind = REMOTE if is_remote else DATA
        bus = found[6].decode("ascii")
        return ParsedFrame(bus, t_ns, identifier, is_extended, kind, len(payload), payload)


def _start_of(found: re.Match[bytes]) -> int | None:
    day, month, year, hour, minute, second = (int(found[k]) for k in range(1, 7))
    try:
        start = datetime(year, month, day, hour, minute, second, tzinfo=UTC)
    except (ValueError, OverflowError):
        return None
    return within_range(int(start.timestamp()) * NANOS + _fraction_ns(found[7]))


def _fraction_ns(digits: bytes) -> int:
    return int(digits[:9].ljust(9, b"0"))


def _time_of_day(lines: Lines, start: Int64s, stop: Int64s) -> tuple[Int64s, Bools]:
    """Convert ``HH:MM:SS:fff`` with one to nine decimals to nanoseconds of the day."""
    two = np.full(len(start), 2)
    parts = [decimal(lines.words, start + k, two) for k in (2, 5, 8)]
    fraction, ok = decimal(lines.words, stop, stop - start - 9)
    colon = ord(":")
    for k, (value, part_ok) in zip((2, 5, 8), parts, strict=True):
        ok &= part_ok & (lines.buffer[start + k] == colon) & (value < (24 if k == 2 else 60))
    ok &= stop - start - 9 <= 9
    scale = np.array([10**k for k in range(10)], np.int64)[np.clip(18 - (stop - start), 0, 9)]
    seconds = parts[0][0] * 3600 + parts[1][0] * 60 + parts[2][0]
    return seconds * NANOS + fraction * scale, ok
