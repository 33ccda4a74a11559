"""Reader of PEAK TRC logs, versions 1.0 to 1.3, 2.0 and 2.1: ``1)  1.6  Rx  0480  2  C2 08``.

Times are milliseconds since ``$STARTTIME``, which counts days since 30 December 1899. The file
states no time zone, so the start time is read as UTC, with a notice.

The format has no checksum and no count. Each line contains its length, so a truncated line is
detected. Each line contains its message number, so missing lines are detected, except after the
last line.
"""

import re
from pathlib import Path
from typing import Final

import numpy as np

from crosscue.replay.base import Log
from crosscue.replay.columns import DATA, ERROR, REMOTE, Int64s
from crosscue.replay.errors import LogFormatError
from crosscue.replay.ledger import Ledger
from crosscue.replay.limits import Limits
from crosscue.replay.readers.can_rows import FD_LENGTHS, IS_FD_LENGTH

from .dialect import (
    BAD_IDENTIFIER,
    BAD_LENGTH,
    NOT_UNDERSTOOD,
    ChunkResult,
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
from .digits import NANOS, OUT_OF_RANGE, SECONDS_MAX, Bools, decimal, seconds_ns, within_range
from .lines import Lines, WordRanges, clean_lines, next_fields, skip_gap
from .message_numbers import MessageNumbers
from .spaced import NOTHING_FAST, Spaced, is_bus_name, is_direction, payload_stop, spaced_frames

_COLUMNS_OF: Final = {"1.0": "NOIlD", "1.1": "NOTIlD", "1.2": "NOBTIlD", "1.3": "NOBTIRlD"}
_KNOWN_COLUMNS: Final = frozenset("NOTBIdRLlDASsZP")
_NEEDED_COLUMNS: Final = ("O", "T", "I", "D")
_VERSION: Final = re.compile(rb";\$FILEVERSION=(\d+\.\d+)\s*")
_START: Final = re.compile(rb";\$STARTTIME=(\d{1,6})(?:[.,](\d{1,15}))?\s*")
_COLUMNS: Final = re.compile(rb";\$COLUMNS=([A-Za-z](?:,[A-Za-z])*)\s*")
_TIME: Final = re.compile(r"(\d{1,10})(?:[.,](\d{1,9}))?")
_NUMBER: Final = re.compile(r"\d{1,16}")
_OLD_NUMBER: Final = re.compile(r"\d{1,16}\)")
_HEX_ID: Final = re.compile(r"[0-9A-Fa-f]{1,8}")
_PAIR: Final = re.compile(r"[0-9A-Fa-f]{2}")
_DATA_TYPES: Final = ("DT", "FD", "FB", "FE", "BI")
_NO_FRAME_TYPES: Final = ("WARNG", "ST", "EC", "EV", "BUS", "BUSST", "ERRCT", "EVENT")
# Days from 30 December 1899 to 1 January 1970.
_EPOCH_DAYS: Final = 25_569
_DAY_NS: Final = 86_400 * NANOS


def open_trc(path: Path, limits: Limits) -> Log:
    """Open a TRC log.

    Raises:
        LogFormatError: The start of the file has neither a header nor a line of this format, or
            the version or the columns are unknown.
    """
    head = head_of(path)
    version, columns = _layout(head, path)
    return TextCanLog(path, limits, lambda: Trc(version, columns))


def _layout(head: bytes, path: Path) -> tuple[str, str]:
    found = _VERSION.search(head)
    version = found[1].decode("ascii") if found else "1.0"
    if version in _COLUMNS_OF:
        return version, _COLUMNS_OF[version]
    if not version.startswith("2."):
        known = ", ".join(_COLUMNS_OF)
        raise LogFormatError(f"{path}: TRC version {version} unknown; expected {known}, 2.0 or 2.1")
    listed = _COLUMNS.search(head)
    columns = listed[1].decode("ascii").replace(",", "") if listed else ""
    is_known = set(columns) <= _KNOWN_COLUMNS and len(set(columns)) == len(columns)
    has_all = all(c in columns for c in _NEEDED_COLUMNS) and ("l" in columns or "L" in columns)
    if not is_known or not has_all or not columns.endswith("D"):
        raise LogFormatError(
            f"{path}: TRC version {version} with columns {columns or 'missing'!r}; "
            "expected O, T, I, d, L or l, and D at the end: the header is damaged"
        )
    return version, columns


class Trc(Dialect):
    """One pass over a TRC log."""

    format = "trc"
    says = "PEAK TRC log"
    integrity = (
        "message numbers checked, so that only missing rows after the last one are not detected; "
        "TRC text has no checksums: a changed digit cannot be detected"
    )

    def __init__(self, version: str, columns: str) -> None:
        """Create a parser; ``columns`` are the letters of ``$COLUMNS``, or their equivalent."""
        self._version, self._columns = version, columns
        self._is_old = version in _COLUMNS_OF
        self._start_ns = 0
        self._is_dated = False
        self._numbers = MessageNumbers()
        self._fast_numbers = NOTHING_FAST.rows.place, NOTHING_FAST.rows.place

    def fast(self, lines: Lines) -> Fast:
        """Parse data frames, including CAN FD."""
        line = clean_lines(lines)
        line = line[lines.buffer[lines.start[line]] != ord(";")]
        self._fast_numbers = line[:0], line[:0]
        if not len(line):
            return NOTHING_FAST
        limit = lines.stop[line]
        fields = next_fields(lines, lines.start[line], limit, len(self._columns) - 1)
        by = dict(zip(self._columns, fields, strict=False))
        t_ns, ok = _offsets_ns(lines, by["O"])
        is_fd, type_ok = self._kinds(lines, by.get("T"), len(line))
        length, length_ok = _lengths(lines, by.get("L"), by.get("l"), is_fd)
        identifier = by["I"]
        ok &= type_ok & length_ok & ((identifier.size == 4) | (identifier.size == 8))
        if "d" in by:
            ok &= is_direction(lines, by["d"])
        if "R" in by:
            reserved = by["R"]
            ok &= (reserved.size == 1) & (lines.buffer[reserved.start] == ord("-"))
        if "N" in by:
            number, number_ok = _number(lines, by["N"], self._is_old)
            self._fast_numbers = line, number
            ok &= number_ok
        payload = skip_gap(lines, fields[-1].stop, limit)
        is_extended = identifier.size == 8
        at = Spaced(line, by.get("B"), identifier, is_extended, length, payload, is_fd)
        ok &= skip_gap(lines, np.minimum(payload_stop(at), limit), limit) == limit
        return spaced_frames(lines, at, t_ns, ok)

    def slow(self, line: bytes) -> Outcome:
        """Parse header lines, remote frames, error frames and status lines."""
        line = line.strip().removeprefix(b"\xef\xbb\xbf")
        if not line:
            return None
        if line.startswith(b";"):
            return self._header(line)
        values = line.decode("latin-1").split()
        before = len(self._columns) - 1
        by = dict(zip(self._columns, values[:before], strict=False))
        found = _TIME.fullmatch(by.get("O", ""))
        number = (_OLD_NUMBER if self._is_old else _NUMBER).fullmatch(by.get("N", "1"))
        if not found or not number or by.get("R", "-") != "-":
            return DamagedLine(NOT_UNDERSTOOD)
        if int(found[1]) > SECONDS_MAX:
            return DamagedLine(OUT_OF_RANGE)
        t_ns = (int(found[1]) * NANOS + int((found[2] or "").ljust(9, "0"))) // 1000
        outcome = self._outcome(t_ns, by, values[before:])
        if isinstance(outcome, ParsedFrame | Other) and "N" in by:
            return outcome._replace(number=int(by["N"].rstrip(")")))
        return outcome

    def is_complete(self, outcome: Outcome) -> bool:
        """Return whether the line has as many bytes as its length states."""
        return isinstance(outcome, ParsedFrame | DamagedLine)

    def log_times(self, t_ns: Int64s) -> Int64s:
        """Add the last start time."""
        return t_ns + self._start_ns

    def note(self, mark: HeaderLine) -> None:
        """Set the start time of the lines that follow."""
        if mark.origin_ns is not None:
            self._start_ns, self._is_dated = mark.origin_ns, True

    def check(self, chunk: ChunkResult) -> Int64s:
        """Check the message numbers of each recording in the file."""
        if "N" not in self._columns:
            return chunk.rows.place[:0]
        place, number = self._numbered(chunk)
        at, values = self._fast_numbers
        k = int(np.searchsorted(at, chunk.done))
        following = int(values[k]) if k < len(at) and at[k] == chunk.done else -1
        is_misfit = self._numbers.misfits(number, following)
        for i in np.flatnonzero(is_misfit).tolist():
            self._numbers.misfit(int(number[i]), chunk.first_number + int(place[i]))
        refused = place[is_misfit]
        damaged = np.union1d(np.array(chunk.damaged, np.int64), refused)
        place, number = place[~is_misfit], number[~is_misfit]
        begin = 0
        for end in [*(i for i, mark in chunk.marks if mark.origin_ns is not None), chunk.done]:
            here = slice(*np.searchsorted(place, (begin, end)).tolist())
            bad = damaged[slice(*np.searchsorted(damaged, (begin, end)).tolist())]
            self._numbers.follow(number[here], place[here], bad, chunk.first_number)
            if end != chunk.done:
                self._numbers.begin()
            begin = end
        self._fast_numbers = place[:0], place[:0]
        return refused

    def _numbered(self, chunk: ChunkResult) -> tuple[Int64s, Int64s]:
        """Return the valid lines of a chunk and their message numbers."""
        odd = [(i, frame.number) for i, _, frame in chunk.odd]
        odd += [(i, other.number) for i, other in chunk.others]
        at, values = self._fast_numbers
        known = {i: number for i, number in odd if number is not None}
        is_fast = ~np.isin(chunk.rows.place, list(known)) if known else slice(None)
        fast = chunk.rows.place[is_fast]
        if not known:
            return fast, values[np.searchsorted(at, fast)]
        place = np.concatenate((fast, np.array(list(known), np.int64)))
        number = np.concatenate(
            (values[np.searchsorted(at, fast)], np.array(list(known.values()), np.int64))
        )
        order = np.argsort(place, kind="stable")
        return place[order], number[order]

    def finish(self, ledger: Ledger) -> None:
        """Report the basis of the clock and the missing message numbers."""
        self._numbers.settle(ledger)
        if self._is_dated:
            ledger.notice("the log states no time zone; its start time is read as UTC")
        else:
            ledger.notice("the log has no $STARTTIME; times count from 1970-01-01")

    def _kinds(self, lines: Lines, word: WordRanges | None, count: int) -> tuple[Bools, Bools]:
        """Return masks of the CAN FD frames and of the data frames."""
        if word is None:
            return np.zeros(count, np.bool_), np.ones(count, np.bool_)
        if self._is_old:
            return np.zeros(count, np.bool_), is_direction(lines, word)
        two = lines.words[word.start] & np.uint64(0xFFFF)
        is_type = [two == int.from_bytes(one.encode(), "little") for one in _DATA_TYPES]
        is_fd = np.logical_or.reduce(is_type[1:])
        return is_fd, (is_fd | is_type[0]) & (word.size == 2)

    def _header(self, line: bytes) -> Outcome:
        if found := _START.fullmatch(line):
            return HeaderLine(_start_ns(found))
        if found := _VERSION.fullmatch(line):
            is_same = found[1].decode("ascii") == self._version
            return HeaderLine(stops="" if is_same else "a different version inside the file")
        if found := _COLUMNS.fullmatch(line):
            is_same = found[1].decode("ascii").replace(",", "") == self._columns
            return HeaderLine(stops="" if is_same else "different columns inside the file")
        return comment(line.decode("latin-1"))

    def _outcome(self, t_ns: int, by: dict[str, str], rest: list[str]) -> Outcome:
        type_ = by.get("T", "Rx" if self._is_old else "").upper()
        bus, id_text = by.get("B", "1"), by.get("I", "")
        if type_ in _NO_FRAME_TYPES or (self._version == "1.0" and id_text == "FFFFFFFF"):
            return Other("status line, no frame", t_ns)
        is_error = type_ in ("ERROR", "ER")
        is_remote = type_ == "RR" or (self._is_old and rest == ["RTR"])
        is_frame = type_ in (("RX", "TX") if self._is_old else _DATA_TYPES)
        if not (is_error or is_remote or is_frame) or not is_bus_name(bus.encode("latin-1")):
            return DamagedLine(NOT_UNDERSTOOD)
        if is_error and id_text == "-":
            id_text = "0000"
        is_extended = len(id_text) > 4
        if not _HEX_ID.fullmatch(id_text):
            return DamagedLine(NOT_UNDERSTOOD)
        identifier = int(id_text, 16)
        if identifier > (0x1FFFFFFF if is_extended else 0x7FF):
            return DamagedLine(BAD_IDENTIFIER)
        if is_remote:
            is_bare = not rest or rest == ["RTR"]
            remote = ParsedFrame(bus, t_ns, identifier, is_extended, REMOTE, 0)
            return remote if is_bare else DamagedLine(NOT_UNDERSTOOD)
        is_fd = type_ in _DATA_TYPES[1:]
        length = _length(by, is_fd)
        if length is None or len(rest) != length or not all(_PAIR.fullmatch(w) for w in rest):
            return DamagedLine(BAD_LENGTH)
        kind = ERROR if is_error else DATA
        payload = bytes(int(word, 16) for word in rest)
        return ParsedFrame(bus, t_ns, identifier, is_extended, kind, length, payload, is_fd)


def _number(lines: Lines, word: WordRanges, is_old: bool) -> tuple[Int64s, Bools]:
    """Parse message numbers, which are followed by a bracket in old versions."""
    stop = word.stop - is_old
    number, ok = decimal(lines.words, stop, stop - word.start)
    if is_old:
        ok &= lines.buffer[stop] == ord(")")
    return number, ok


def _offsets_ns(lines: Lines, time: WordRanges) -> tuple[Int64s, Bools]:
    """Convert milliseconds to nanoseconds; integers may have no decimal mark."""
    scaled, ok = seconds_ns(lines.buffer, lines.words, time.start, time.stop, marked=False)
    return scaled // 1000, ok


def _lengths(
    lines: Lines, code: WordRanges | None, count: WordRanges | None, is_fd: Bools
) -> tuple[Int64s, Bools]:
    """Return the number of payload bytes from the length, else from the length code."""
    word = count or code
    if word is None:
        raise ValueError("columns: expected L or l, got neither")
    value, ok = decimal(lines.words, word.stop, word.size)
    if count is None:
        ok &= value <= 15
        value = FD_LENGTHS[np.where(ok, value, 0)]
        value = np.where(is_fd, value, np.minimum(value, 8))
    else:
        ok &= np.where(is_fd, IS_FD_LENGTH[np.clip(value, 0, 64)] & (value <= 64), value <= 8)
    return np.where(ok, value, 0), ok


def _length(by: dict[str, str], is_fd: bool) -> int | None:
    text = by.get("l", by.get("L", ""))
    if not text.isascii() or not text.isdigit() or len(text) > 2:
        return None
    if "l" in by:
        length = int(text)
        return length if length <= 64 and (IS_FD_LENGTH[length] if is_fd else length <= 8) else None
    if int(text) > 15:
        return None
    length = int(FD_LENGTHS[int(text)])
    return length if is_fd else min(length, 8)


def _start_ns(found: re.Match[bytes]) -> int | None:
    decimals = found[2] or b"0"
    part_ns, rest = divmod(int(decimals) * _DAY_NS, 10 ** len(decimals))
    part_ns += 2 * rest >= 10 ** len(decimals)
    days = int(found[1]) - _EPOCH_DAYS
    return within_range(days * _DAY_NS + part_ns)
