"""Reader of PEAK TRC logs, versions 1.0 to 1.3, 2.0 and 2.1: ``1)  1.6  Rx  0480  2  C2 08``.

Times are milliseconds since ``$STARTTIME``, which counts days since 30 December 1899. The file
states no time zone, so the start time is read as UTC, with a notice.

The format has no checksum and no count. Each line contains its length, so a truncated line is
detected. Each line contains its message number, so missing lines are detected, except after the
last line.

A recorder numbers its rows 1, 2, 3, ..., so a missing number is a missing row. Rows may be out of
order, so a later row with a missing number closes the gap again. A row is damaged if its number
does not follow its predecessor's and its two neighbors' numbers leave exactly one number between
them.
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
from .spaced import NOTHING_FAST, Spaced, is_bus_name, is_direction, payload_stop, spaced_frames

MISSING: Final = "message numbers missing"
MISFIT: Final = "message number does not fit between its neighbors"
GO_BACK: Final = "message numbers repeat or go back"
# Number of latest gaps that a later row may close; only nearby rows are out of order.
_GAPS_KEPT: Final = 8
_PLACES_KEPT: Final = 5


class MessageNumbers:
    """The message numbers of one pass over a log, in stored order."""

    def __init__(self) -> None:
        """Start without any rows."""
        self._last, self._highest = 0, 0
        self._gaps: list[tuple[int, int]] = []
        self._missing = self._backward = self._misfits = self._damaged = 0
        self._is_fresh = True
        self._places: list[str] = []
        self._back_places: list[str] = []
        self._misfit_places: list[str] = []

    def begin(self) -> None:
        """Start a new recording, whose numbers restart."""
        self._settle_gaps()
        self._last = self._highest = self._damaged = 0
        self._is_fresh = True

    def misfits(self, number: Int64s, following: int) -> Bools:
        """Return a mask of the rows whose number contradicts their neighbors, shape (N,).

        Args:
            number: Shape (N,): numbers of consecutive rows.
            following: Number of the row after them; -1 if unknown.
        """
        before = np.concatenate(([self._last], number[:-1]))
        after = np.append(number[1:], following)
        found: Bools = (number != before + 1) & (after == before + 2)
        return found

    def misfit(self, number: int, line: int) -> None:
        """Record a row that is dropped because of its number."""
        self._misfits += 1
        _note(self._misfit_places, f"line {line}: {number}")

    def follow(self, number: Int64s, line: Int64s, damaged: Int64s, first_line: int) -> None:
        """Process the numbers of consecutive valid rows.

        Args:
            number: Shape (N,): the numbers.
            line: Shape (N,), ascending: their lines, counted from the chunk's first.
            damaged: Unreadable lines, ascending, which are reported separately. Each may be the
                missing row of a gap, which is then not reported again.
            first_line: Number of the chunk's first line in the file.
        """
        if not len(number):
            self._damaged += len(damaged)
            return
        starts = np.concatenate(([0], np.flatnonzero(np.diff(number) != 1) + 1))
        stops = np.append(starts[1:], len(number))
        # An unreadable line within a run had no number, because the run has no gap.
        bad = np.searchsorted(damaged, line[starts])
        bad[1:] -= np.searchsorted(damaged, line[starts[1:] - 1])
        bad[0] += self._damaged
        for start, stop, count in zip(starts.tolist(), stops.tolist(), bad.tolist(), strict=True):
            self._run(
                int(number[start]), int(number[stop - 1]), first_line + int(line[start]), count
            )
        self._damaged = len(damaged) - int(np.searchsorted(damaged, line[-1]))

    def settle(self, ledger: Ledger) -> None:
        """Report the missing rows, after the complete file has been read."""
        self._settle_gaps()
        ledger.drop("", MISFIT, self._misfits, _listed(self._misfit_places, self._misfits))
        more = f"first {_PLACES_KEPT} gaps: " if len(self._places) == _PLACES_KEPT else ""
        ledger.drop("", MISSING, self._missing, more + "; ".join(self._places))
        if self._backward:
            detail = _listed(self._back_places, self._backward)
            ledger.drop("", GO_BACK, None, f"{self._backward} times: {detail}")

    def _run(self, first: int, last: int, line: int, damaged: int) -> None:
        """Process rows ``first`` to ``last`` without a gap, after ``damaged`` unreadable lines."""
        if self._is_fresh and first == 0:  # some writers count from zero
            self._highest = -1
        self._is_fresh = False
        if first > self._highest:
            if first > self._highest + 1:
                self._gap(self._highest + 1, first, line, damaged)
        elif not self._fill(first, last):
            self._backward += 1
            _note(self._back_places, f"line {line}: {first} after {self._last}")
            # A new recording starts, or a part is repeated: the rows between are unknown.
            self._settle_gaps()
            self._highest = last
        self._highest = max(self._highest, last)
        self._last = last

    def _gap(self, start: int, stop: int, line: int, damaged: int) -> None:
        """Record that the numbers ``start`` to ``stop - 1`` are missing."""
        start += min(damaged, stop - start)
        if start == stop:
            return
        self._gaps.append((start, stop))
        spelled = f"{start} to {stop - 1}" if stop - start > 1 else f"{start}"
        _note(self._places, f"line {line}: {spelled}")
        if len(self._gaps) > _GAPS_KEPT:
            start, stop = self._gaps.pop(0)
            self._missing += stop - start

    def _fill(self, first: int, last: int) -> bool:
        """Close the gap that contains the run; return False if one of its numbers is repeated."""
        for k, (start, stop) in enumerate(self._gaps):
            if start <= first < stop:
                rest = [(start, first), (last + 1, stop)]
                self._gaps[k : k + 1] = [(a, b) for a, b in rest if a < b]
                return last < stop
        return False

    def _settle_gaps(self) -> None:
        self._missing += sum(stop - start for start, stop in self._gaps)
        self._gaps = []


def _note(places: list[str], place: str) -> None:
    if len(places) < _PLACES_KEPT:
        places.append(place)


def _listed(places: list[str], count: int) -> str:
    more = f" and {count - len(places)} more" if count > len(places) else ""
    return "; ".join(places) + more


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
    return TextCanLog(path, lambda: Trc(version, columns))


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
        time = by["O"]
        scaled, ok = seconds_ns(lines.buffer, lines.words, time.start, time.stop, marked=False)
        is_fd, type_ok = self._kinds(lines, by.get("T"), len(line))
        is_code = "l" not in by
        length, length_ok = _lengths(lines, by["L" if is_code else "l"], is_code, is_fd)
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
        # Times are in milliseconds; integers may have no decimal mark.
        return spaced_frames(lines, at, scaled // 1000, ok)

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
        slow = np.array([one for one in odd if one[1] is not None], np.int64).reshape(-1, 2)
        fast = np.setdiff1d(chunk.rows.place, slow[:, 0], assume_unique=True)
        at, values = self._fast_numbers
        place = np.concatenate((fast, slow[:, 0]))
        number = np.concatenate((values[np.searchsorted(at, fast)], slow[:, 1]))
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


def _lengths(lines: Lines, word: WordRanges, is_code: bool, is_fd: Bools) -> tuple[Int64s, Bools]:
    """Return the number of payload bytes from the length, or from the length code."""
    value, ok = decimal(lines.words, word.stop, word.size)
    if is_code:
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
