"""Parser of time files, which have one line per image or video frame.

A line contains a time, or a file name and a time in either order, separated by a comma, a semicolon
or blanks (``12.35``; ``frame_07.jpg,12.35``; TUM's ``1305031102.175304
rgb/1305031102.175304.png``). Empty lines and lines that start with ``#`` are ignored. A first line
without a time names the columns. The time column is the one whose name contains ``time`` or
``stamp``, and a unit in its name (``time_ns``, ``time_us``, ``time_ms``, ``time [s]``) applies. A
time is one of

* seconds with a decimal point or exponent (``12.35``, ``1.2e-1``);
* an integer in nanoseconds, or in the unit of the column's name;
* a date-time (``2011-09-26 13:02:25.964389445``, ``...T13:02:25Z``, ``...+02:00``), in UTC if it
  has no zone.

A last line without a line end was truncated if it is not a time, or has fewer decimals than all
lines above it. It yields no time, and a notice is added.

If the times were not recorded, a single line ``rate_hz: 15`` specifies the frame rate instead.
Times are computed with integers and fractions, never with floats.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from decimal import Decimal, InvalidOperation
from fractions import Fraction
from pathlib import Path, PurePosixPath
from typing import Final, NamedTuple

import numpy as np

from crosscue.replay.columns import Int64s
from crosscue.replay.errors import LogFormatError, LogTooLargeError
from crosscue.replay.files.bounded import read_at_most
from crosscue.replay.limits import Limits

SECOND_NS: Final = 1_000_000_000
_LATEST_NS: Final = 1 << 62
_SHORTEST_PERIOD_NS: Final = 1_000_000
_UNITS_NS: Final = {"ns": 1, "us": 1_000, "ms": 1_000_000, "s": SECOND_NS, "sec": SECOND_NS}
_UNIT: Final = re.compile(r"(?:_|\[|\()(ns|us|ms|s|sec)[\])]?$")
_DATE: Final = re.compile(
    r"(\d{4}-\d\d-\d\d)[ T](\d\d:\d\d:\d\d)(?:[.,](\d{1,18}))?\s*(Z|[+-]\d\d:?\d\d)?"
)
_RATE: Final = re.compile(r"rate_hz\s*[:=]\s*(\S+)", re.IGNORECASE)
_NUMBER: Final = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d{1,2})?")
_UNIX_START: Final = datetime(1970, 1, 1, tzinfo=UTC)


@dataclass(frozen=True, slots=True, eq=False)
class TimeFile:
    """The contents of a time file.

    Attributes:
        path: Path of the file.
        t_ns: Shape (N,), int64: times; empty if the file states only a rate.
        names: N file names without folders, or None if lines contain only times.
        period: Nanoseconds between images if the file states only a rate, else None.
        notices: Remarks on the file, one sentence each.
    """

    path: Path
    t_ns: Int64s
    names: tuple[str, ...] | None
    period: Fraction | None
    notices: tuple[str, ...] = ()

    def times_at(self, index: Int64s) -> Int64s:
        """Return the times of the images with these indices, shape (N,)."""
        if self.period is None:
            return self.t_ns[index]
        return np.array([round(int(i) * self.period) for i in index], dtype=np.int64)


class _Line(NamedTuple):
    """A line's time and file name, a flag for integers without a unit, and the decimals."""

    t_ns: int
    name: str | None
    is_bare: bool
    decimals: int


def read_time_file(path: Path, limits: Limits) -> TimeFile:
    """Read and validate a time file.

    Raises:
        LogFormatError: A line cannot be parsed; the message names it.
        LogTooLargeError: The file exceeds the size limit of a message.
    """
    lines, has_end = _lines(path, limits)
    if len(lines) == 1 and (rate := _RATE.fullmatch(lines[0][1])):
        return TimeFile(path, np.zeros(0, np.int64), None, _period(path, lines[0][0], rate[1]))
    times: list[_Line] = []
    columns: tuple[str, ...] = ()
    notices: tuple[str, ...] = ()
    for number, line in lines:
        where = f"{path}: line {number}"
        parts = _split(line)
        if not times and not columns and not any(_is_time(part) for part in parts):
            columns = tuple(parts)
            if not any(_names_a_time(column) for column in columns):
                raise LogFormatError(
                    f"{where}: {line[:80]!r}: expected a time (seconds with a decimal "
                    "point, integer nanoseconds or a date-time), alone or with a file name"
                )
            continue
        may_be_cut = number == lines[-1][0] and not has_end and len(times) > 1
        try:
            one = _one_line(parts, columns, where)
        except LogFormatError:
            if not may_be_cut:
                raise
            one = None
        if one is None or (may_be_cut and _is_shorter(one, times)):
            notices = (
                f"{path.name}: line {number}, the last one, is cut: {line[:80]!r}; it has no "
                "time (add a line end if the line is complete)",
            )
            continue
        times.append(one)
        if (one.name is None) != (times[0].name is None):
            raise LogFormatError(
                f"{where}: {line[:80]!r}: expected a file name in every line or in none"
            )
    if not times:
        raise LogFormatError(f"{path}: no time in it; expected one line for each picture")
    t_ns = np.array([one.t_ns for one in times], dtype=np.int64)
    names = tuple(one.name for one in times if one.name is not None)
    _check_period(path, t_ns, integers=all(one.is_bare for one in times))
    _check_twins(path, names)
    return TimeFile(path, t_ns, names or None, None, notices)


def _is_shorter(last: _Line, above: list[_Line]) -> bool:
    """Return whether a line has fewer decimals than the lines above, which all have the same."""
    usual = {one.decimals for one in above}
    return len(usual) == 1 and last.decimals < max(usual)


def _lines(path: Path, limits: Limits) -> tuple[list[tuple[int, str]], bool]:
    """Return the non-empty lines with their numbers, and whether the last one has a line end."""
    raw = read_at_most(path, limits.message_bytes)
    if raw is None:
        raise LogTooLargeError(
            f"{path}: over {limits.message_bytes} bytes; a time file has one line for each picture"
        )
    try:
        text = raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        bad = raw[: error.start].count(b"\n") + 1
        raise LogFormatError(f"{path}: line {bad}: not UTF-8 text; expected a text file") from None
    stripped = ((n, line.strip()) for n, line in enumerate(text.split("\n"), start=1))
    said = [(n, line) for n, line in stripped if line and not line.startswith("#")]
    return said, not text or text.endswith("\n")


def _split(line: str) -> list[str]:
    """Split a line into cells; a blank between date and time does not separate cells."""
    if date := _DATE.search(line):
        written = date[0].rstrip()
        line = line.replace(written, written.replace(" ", "T", 1).replace(",", "."))
    for mark in (",", ";", "\t"):
        if mark in line:
            return [cell.strip().strip('"') for cell in line.split(mark)]
    return [cell.strip('"') for cell in line.split()]


def _one_line(parts: list[str], columns: tuple[str, ...], where: str) -> _Line:
    at = [i for i, column in enumerate(columns) if _names_a_time(column)]
    if columns:
        if len(parts) != len(columns):
            raise LogFormatError(f"{where}: {len(parts)} cells; expected {len(columns)}")
    else:
        at = [i for i, part in enumerate(parts) if _is_time(part)]
    if len(at) != 1 or (not columns and len(parts) > 2):
        raise LogFormatError(
            f"{where}: {' '.join(parts)[:80]!r}: expected one time, alone or with a file name; "
            "name the columns in a first line (name,time) where there are more"
        )
    named = _UNIT.search(columns[at[0]].lower()) if columns else None
    unit_ns = _UNITS_NS[named[1]] if named else None
    others = [part for i, part in enumerate(parts) if i != at[0] and not _is_time(part)]
    name = PurePosixPath(others[0].replace("\\", "/")).name if others else None
    text = parts[at[0]]
    is_bare = unit_ns is None and re.fullmatch(r"[+-]?\d+", text) is not None
    decimals = len(text.replace(",", ".").partition(".")[2].rstrip("Z"))
    return _Line(_time_ns(text, unit_ns, where), name, is_bare, decimals)


def _is_time(text: str) -> bool:
    return _NUMBER.fullmatch(text) is not None or _DATE.fullmatch(text) is not None


def _names_a_time(column: str) -> bool:
    low = column.lower()
    return "time" in low or "stamp" in low or low in ("t", "t_ns", "t_us", "t_ms", "t_s")


def _time_ns(text: str, unit_ns: int | None, where: str) -> int:
    try:
        if date := _DATE.fullmatch(text):
            t_ns = _date_ns(date)
        elif _NUMBER.fullmatch(text):
            if unit_ns is None:
                unit_ns = 1 if re.fullmatch(r"[+-]?\d+", text) else SECOND_NS
            t_ns = int((Decimal(text) * unit_ns).to_integral_value())
        else:
            raise LogFormatError(f"{where}: {text[:80]!r} is not a time")
    except (ValueError, InvalidOperation) as error:
        raise LogFormatError(f"{where}: {text[:80]!r} is not a time: {error}") from None
    if not 0 <= t_ns < _LATEST_NS:
        raise LogFormatError(f"{where}: {text[:80]!r}: expected a time from 0 on and before 2116")
    return t_ns


def _date_ns(date: re.Match[str]) -> int:
    """Convert a matched date-time to nanoseconds since 1970, exactly."""
    zone = (date[4] or "Z").replace("Z", "+0000").replace(":", "")
    moment = datetime.strptime(f"{date[1]} {date[2]} {zone}", "%Y-%m-%d %H:%M:%S %z")
    whole_s = (moment - _UNIX_START) // timedelta(seconds=1)
    return whole_s * SECOND_NS + int((date[3] or "0").ljust(9, "0")[:9])


def _period(path: Path, line: int, text: str) -> Fraction:
    rate = Fraction(text) if _NUMBER.fullmatch(text) else Fraction(0)
    if not 0 < rate <= 100_000:
        raise LogFormatError(
            f"{path}: line {line}: rate_hz {text[:40]!r}; expected a rate like 29.97"
        )
    return SECOND_NS / rate


def _check_period(path: Path, t_ns: Int64s, *, integers: bool) -> None:
    """Check that integer times are not too close together to be nanoseconds."""
    if not integers or len(t_ns) < 2:
        return
    step_ns = int(np.median(np.abs(np.diff(t_ns))))
    if step_ns <= _SHORTEST_PERIOD_NS:
        raise LogFormatError(
            f"{path}: integers {step_ns} apart are read as nanoseconds, too close for pictures; "
            "write seconds with a decimal point, or name the column time_us or time_ms in a first "
            "line"
        )


def _check_twins(path: Path, names: Sequence[str]) -> None:
    seen: set[str] = set()
    for name in names:
        if name in seen:
            raise LogFormatError(
                f"{path}: {name[:80]!r} occurs twice; expected one time for each picture"
            )
        seen.add(name)
