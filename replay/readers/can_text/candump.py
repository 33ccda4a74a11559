"""Reader of candump logs: ``(1436509052.249713) can0 123#DEADBEEF``, one frame per line.

It also reads CAN FD (``123##1DEADBEEF``), remote (``123#R4``) and error frames, a trailing
direction ``R`` or ``T``, the raw DLC suffix ``_9``, and candump's screen format with times
(`` (1436509052.249713)  can0  123   [4]  DE AD BE EF``).

The format has no checksum, no count and no length in its lines. A last line without a line end is
therefore dropped, and so is a line followed by one with an invalid start: both may be truncated.
"""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from crosscue.replay.base import Log
from crosscue.replay.columns import DATA, ERROR, REMOTE, CanFrames, Int64s
from crosscue.replay.errors import LogFormatError
from crosscue.replay.limits import Limits
from crosscue.replay.readers.can_rows import IS_FD_LENGTH, FrameRows

from .dialect import (
    BAD_IDENTIFIER,
    BAD_LENGTH,
    DamagedLine,
    Dialect,
    Fast,
    Other,
    Outcome,
    ParsedFrame,
    TextCanLog,
    head_of,
    payloads,
    picked,
)
from .digits import (
    LABEL_MAX,
    NANOS,
    OUT_OF_RANGE,
    SECONDS_MAX,
    Bools,
    hexadecimal,
    is_hex,
    labels,
    seconds_ns,
)
from .lines import Lines

HASH: Final = ord("#")
BLANK: Final = ord(" ")
_BYTE: Final = np.uint64(0xFF)
_FIVE_BYTES: Final = np.uint64(40)
ERROR_FLAG: Final = 0x20000000
NOT_A_FRAME: Final = "line is not a candump frame"
# Maximum number of different lengths of the time field in a chunk for the fast parser.
_TIME_WIDTHS: Final = 12
IS_INTERFACE: Final = re.compile(rb"[A-Za-z0-9_.:@-]{1,16}")

_TIME: Final = rb"\((\d+)\.(\d+)\)"
_LOG_LINE: Final = re.compile(
    rb"\s*" + _TIME + rb"\s+([A-Za-z0-9_.:@-]+)\s+([0-9A-Fa-f]{3}|[0-9A-Fa-f]{8})#"
    rb"(?:#([0-9A-Fa-f])((?:[0-9A-Fa-f]{2})*)|[Rr]([0-9]?)|((?:[0-9A-Fa-f]{2})*))"
    rb"(?:_[0-9A-Fa-f])?(?:\s+[RTrt])?\s*"
)
_XL_LINE: Final = re.compile(
    rb"\s*" + _TIME + rb"\s+([A-Za-z0-9_.:@-]+)\s+[0-9A-F]{5}#[0-9A-F]{2}:[0-9A-F]{2}:[0-9A-F]{8}#"
    rb"[0-9A-Fa-f]*\s*"
)
_SCREEN_LINE: Final = re.compile(
    rb"\s*" + _TIME + rb"\s+([A-Za-z0-9_.:@-]+)\s+(?:[RT]X [-B] [-E]\s+)?"
    rb"([0-9A-F]{3}|[0-9A-F]{8})\s+\[(\d{1,2})\]\s*"
    rb"(remote request|(?:[0-9A-F]{2}(?: [0-9A-F]{2})*)?)(?:\s+('.*'|ERRORFRAME))?\s*"
)
_UNTIMED: Final = re.compile(rb"\s*[A-Za-z][A-Za-z0-9_.:@-]*\s+[0-9A-F]{3,8}\s+\[\d{1,2}\]")
_DATED: Final = re.compile(rb"\s*\(\d{4}-\d\d-\d\d \d\d:\d\d:\d\d\.\d+\)\s+[^\s#]+\s+\S+\s+\[\d")


def open_candump(path: Path, limits: Limits) -> Log:
    """Open a candump log.

    Raises:
        LogFormatError: The file is candump's screen output without usable times.
    """
    _refuse_without_times(path, head_of(path))
    return TextCanLog(path, Candump)


def _refuse_without_times(path: Path, head: bytes) -> None:
    line = next((one for one in head.splitlines() if one.strip()), b"")
    if _UNTIMED.match(line):
        raise LogFormatError(
            f"{path}: candump's screen output without times; record with 'candump -l' or '-ta'"
        )
    if _DATED.match(line):
        raise LogFormatError(
            f"{path}: candump's screen output with local dates and no time zone; "
            "record with 'candump -l' or '-ta'"
        )


class Candump(Dialect):
    """One pass over a log of candump, can-utils or python-can."""

    format = "candump"
    says = "candump log"
    integrity = (
        "candump text has no checksums, lengths or counts: a changed digit or a missing line "
        "cannot be detected"
    )

    def fast(self, lines: Lines) -> Fast:
        """Parse data frames, including CAN FD, in the format of ``candump -l``."""
        shape = _shaped(lines)
        buffer, words, hash_ = lines.buffer, lines.words, shape.hash_
        t_ns, ok = seconds_ns(buffer, words, lines.start[shape.line] + 1, shape.close)
        identifier, id_ok = hexadecimal(words, hash_, shape.id_digits)
        is_long = shape.id_digits == 8
        payload, payload_ok = payloads(lines, shape.text, shape.length, shape.is_fd, None)
        name_start = shape.close + 2
        bus, spelled = labels(words, name_start, hash_ - shape.id_digits - 1 - name_start)
        ok &= id_ok & payload_ok
        if not all(IS_INTERFACE.fullmatch(one) for one in spelled) or int(bus.min(initial=0)) < 0:
            is_name = [IS_INTERFACE.fullmatch(one) is not None for one in spelled]
            ok &= np.array([*is_name, False])[bus]
        kind = np.zeros(len(hash_), np.uint8)
        if bool(is_long.any()):
            ok &= identifier <= np.where(is_long, 0x3FFFFFFF, 0x7FF)
            is_error = (identifier & ERROR_FLAG) != 0
            kind[is_error] = ERROR
            is_long &= ~is_error
            identifier &= 0x1FFFFFFF
        else:
            ok &= identifier <= 0x7FF
        frames = CanFrames(
            identifier.astype(np.uint32),
            is_long,
            kind,
            shape.length.astype(np.uint8),
            payload,
            shape.is_fd,
        )
        return picked(ok, FrameRows(shape.line, bus, t_ns, frames), spelled)

    def slow(self, line: bytes) -> Outcome:
        """Parse remote frames, the screen format and other unusual lines."""
        if found := _LOG_LINE.fullmatch(line):
            return _frame_of_log_line(found)
        if found := _SCREEN_LINE.fullmatch(line):
            return _frame_of_screen_line(found)
        if found := _XL_LINE.fullmatch(line):
            bus = found[3].decode("ascii")
            return Other("CAN XL frame, not supported", _time_ns(found), bus)
        if not line.strip():
            return None
        return DamagedLine(NOT_A_FRAME, taints=not line.startswith(b"("))


@dataclass(frozen=True, slots=True, eq=False)
class _Shaped:
    """Lines with brackets, blanks and ``#`` at the positions of a frame; fields of shape (N,)."""

    line: Int64s
    close: Int64s
    hash_: Int64s
    id_digits: Int64s
    text: Int64s
    length: Int64s
    is_fd: Bools


def _shaped(lines: Lines) -> _Shaped:
    line, hash_ = _first_hash(lines)
    buffer, words = lines.buffer, lines.words
    start, stop = lines.start[line], lines.stop[line]
    close = _closing_bracket(lines, start)
    around = words[hash_ - 4]
    is_short = (around & _BYTE) == BLANK
    id_digits = np.where(is_short, 3, 8)
    ok = is_short | (buffer[hash_ - 9] == BLANK) if not bool(is_short.all()) else is_short
    name_count = hash_ - id_digits - (close + 3)
    ok = ok & (buffer[start] == ord("(")) & (close > start) & (buffer[close + 1] == BLANK)
    ok &= (name_count > 0) & (name_count <= LABEL_MAX)
    is_fd = (around >> _FIVE_BYTES & _BYTE) == HASH
    text = hash_ + 1
    digits = stop - text
    if bool((buffer[stop - 2] == BLANK).any()):
        digits -= 2 * _has_direction(lines, stop)
    if bool(is_fd.any()):
        text, digits = text + 2 * is_fd, digits - 2 * is_fd
        is_flag = is_hex(buffer[hash_ + 2])
        fits = IS_FD_LENGTH[np.clip(digits >> 1, 0, 64)] & is_flag & (digits <= 128)
        ok &= np.where(is_fd, fits, digits <= 16)
    else:
        ok &= digits <= 16
    ok &= (digits >= 0) & ((digits & 1) == 0)
    length = digits >> 1
    if bool(ok.all()):
        return _Shaped(line, close, hash_, id_digits, text, length, is_fd)
    return _Shaped(line[ok], close[ok], hash_[ok], id_digits[ok], text[ok], length[ok], is_fd[ok])


def _first_hash(lines: Lines) -> tuple[Int64s, Int64s]:
    """Return the lines with a ``#`` far enough from their start, and the first one's position."""
    begin, end = int(lines.start[0]), int(lines.stop[-1])
    found = np.flatnonzero(lines.buffer[begin:end] == HASH) + begin
    if len(found) != len(lines):
        first = np.searchsorted(found, lines.start)
        found = np.append(found, end)[first]
    is_inside = (found > lines.start + 9) & (found < lines.stop)
    if bool(is_inside.all()):
        return np.arange(len(lines)), found
    line = np.flatnonzero(is_inside)
    return line, found[line]


def _closing_bracket(lines: Lines, start: Int64s) -> Int64s:
    """Return the position of each line's first ``)``, else its start.

    The position within a line is nearly constant in a log.
    """
    close = start.copy()
    open_ = np.arange(len(start))
    for _ in range(_TIME_WIDTHS):
        if not len(open_):
            break
        first = int(start[open_[0]])
        distance = lines.buffer[first : first + 32].tobytes().find(b")")
        if distance < 0:
            open_ = open_[1:]
            continue
        here = lines.buffer[start[open_] + distance] == ord(")")
        close[open_[here]] += distance
        open_ = open_[~here]
    return close


def _has_direction(lines: Lines, stop: Int64s) -> Bools:
    letter = lines.buffer[stop - 1]
    found: Bools = (letter == ord("R")) | (letter == ord("T"))
    found &= lines.buffer[stop - 2] == BLANK
    return found


def _time_ns(found: re.Match[bytes]) -> int | None:
    """Convert groups 1 and 2 to nanoseconds, without finer digits; None if out of range."""
    seconds, decimals = found[1], found[2]
    if len(seconds) > 10 or int(seconds) > SECONDS_MAX or len(decimals) > 30:
        return None
    return int(seconds) * NANOS + int(decimals[:9].ljust(9, b"0"))


def _frame_of_log_line(found: re.Match[bytes]) -> Outcome:
    t_ns, bus = _time_ns(found), found[3]
    flags, fd_text, remote, text = found[5], found[6], found[7], found[8]
    payload = bytes.fromhex((fd_text or text or b"").decode("ascii"))
    if t_ns is None or not IS_INTERFACE.fullmatch(bus):
        return DamagedLine(OUT_OF_RANGE if t_ns is None else NOT_A_FRAME)
    kind = DATA if remote is None else REMOTE
    return _frame(bus, t_ns, found[4], kind, payload, flags is not None)


def _frame_of_screen_line(found: re.Match[bytes]) -> Outcome:
    t_ns, bus, length, text = _time_ns(found), found[3], found[5], found[6]
    kind = REMOTE if text == b"remote request" else DATA
    payload = b"" if kind == REMOTE else bytes.fromhex(text.decode("ascii"))
    if t_ns is None or not IS_INTERFACE.fullmatch(bus):
        return DamagedLine(OUT_OF_RANGE if t_ns is None else NOT_A_FRAME)
    if kind == DATA and int(length) != len(payload):
        return DamagedLine(BAD_LENGTH)
    return _frame(bus, t_ns, found[4], kind, payload, is_fd=len(length) == 2)


def _frame(
    bus: bytes, t_ns: int, id_text: bytes, kind: int, payload: bytes, is_fd: bool
) -> Outcome:
    identifier = int(id_text, 16)
    is_long = len(id_text) == 8
    if identifier > (0x3FFFFFFF if is_long else 0x7FF):
        return DamagedLine(BAD_IDENTIFIER)
    if len(payload) > 64 or not (IS_FD_LENGTH[len(payload)] if is_fd else len(payload) <= 8):
        return DamagedLine("invalid number of payload bytes")
    is_error = bool(identifier & ERROR_FLAG)
    return ParsedFrame(
        bus.decode("ascii"),
        t_ns,
        identifier & 0x1FFFFFFF,
        is_long and not is_error,
        ERROR if is_error else kind,
        len(payload),
        payload,
        is_fd,
    )
