"""Frames whose bytes are separated by blanks, as in ASC and TRC logs."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from crosscue.replay.columns import DATA, CanFrames, Int64s
from crosscue.replay.readers.can_rows import NO_ROWS, FrameRows, merge_rows

from .dialect import Fast, payloads, picked
from .digits import LABEL_MAX, Bools, hexadecimal, labels
from .lines import SPACE, Lines, WordRanges


@dataclass(frozen=True, slots=True, eq=False)
class Spaced:
    """Positions of the fields of N data frames; all arrays have shape (N,).

    Attributes:
        line: Index of the line.
        bus: The word that names the bus; None if the format has only one bus.
        identifier: The hexadecimal digits of the identifier.
        is_extended: True for 29-bit identifiers.
        length: Number of payload bytes, 0 to 64.
        payload: First character of the payload; undefined for a length of 0.
        is_fd: True for CAN FD.
    """

    line: Int64s
    bus: WordRanges | None
    identifier: WordRanges
    is_extended: Bools
    length: Int64s
    payload: Int64s
    is_fd: Bools


NOTHING_FAST: Final = Fast(NO_ROWS, ())


def spaced_frames(lines: Lines, at: Spaced, t_ns: Int64s, ok: Bools) -> Fast:
    """Return the frames at these positions with valid digits, gaps, ranges and names.

    Args:
        lines: The chunk.
        at: Positions of the fields.
        t_ns: Shape (N,): times.
        ok: Shape (N,): mask of the frames that are valid so far.
    """
    if not len(at.line):
        return NOTHING_FAST
    identifier, id_ok = hexadecimal(lines.words, at.identifier.stop, at.identifier.size)
    ok = ok & id_ok & (identifier <= np.where(at.is_extended, 0x1FFFFFFF, 0x7FF))
    payload, payload_ok = payloads(lines, at.payload, at.length, at.is_fd, SPACE)
    stop = payload_stop(at)
    ok &= payload_ok & (lines.buffer[stop] <= SPACE) & (stop <= lines.stop[at.line])
    spelled: tuple[bytes, ...]
    if at.bus is None:
        bus, spelled = np.zeros(len(at.line), np.int64), (b"1",)
    else:
        bus, spelled = labels(lines.words, at.bus.start, at.bus.size)
        is_name = np.array([is_bus_name(one) for one in spelled] + [False])
        ok &= (at.bus.size <= LABEL_MAX) & is_name[bus]
    frames = CanFrames(
        identifier.astype(np.uint32),
        at.is_extended,
        np.full(len(at.line), DATA, np.uint8),
        at.length.astype(np.uint8),
        payload,
        at.is_fd,
    )
    return picked(ok, FrameRows(at.line, bus, t_ns, frames), spelled)


def payload_stop(at: Spaced) -> Int64s:
    """Return the position after the last payload digit, where a gap is required."""
    return at.payload + np.maximum(3 * at.length - 1, 0)


def is_bus_name(spelled: bytes) -> bool:
    """Return whether a bus name is printable ASCII, as all bus names are."""
    return bool(spelled) and all(SPACE < c < 127 for c in spelled)


def is_direction(lines: Lines, word: WordRanges) -> Bools:
    """Return whether each word is ``Rx`` or ``Tx``."""
    letter = lines.buffer[word.start]
    found: Bools = (letter == ord("R")) | (letter == ord("T"))
    found &= (lines.buffer[word.start + 1] == ord("x")) & (word.size == 2)
    return found


def joined_fast(parts: Sequence[Fast]) -> Fast:
    """Merge the frames of a chunk by line; each part has its own bus names."""
    rows = [NO_ROWS]
    names: tuple[str, ...] = ()
    for part in parts:
        rows.append(replace(part.rows, bus=part.rows.bus + len(names)))
        names += part.names
    return Fast(merge_rows(rows), names)
