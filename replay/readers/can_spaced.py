"""Frames whose bytes are words of their own, as ASC, TRC and BUSMASTER logs write them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from crosscue.replay.columns import DATA, CanFrames, Int64s

from .can_lines import SPACE, Lines, Tokens
from .can_text import NO_ROWS, Fast, payloads, picked
from .digits import LABEL_MAX, Bools, hexadecimal, labels


@dataclass(frozen=True, slots=True, eq=False)
class Spaced:
    """Where the fields of N data frames lie; all arrays have shape (N,).

    Attributes:
        line: Which line.
        bus: Index of the word that names the bus; None when the format has one bus only.
        identifier: Index of the word with the hexadecimal identifier.
        id_tail: How many characters at the identifier's end are no digits (``x``).
        is_extended: 29-bit identifier.
        length: Payload bytes, 0 to 64.
        payload: Index of the first payload word; means nothing for a length of 0.
        is_fd: CAN FD.
    """

    line: Int64s
    bus: Int64s | None
    identifier: Int64s
    id_tail: Int64s | int
    is_extended: Bools
    length: Int64s
    payload: Int64s
    is_fd: Bools


NO_FRAMES_FAST = Fast(NO_ROWS, ())


def spaced_frames(lines: Lines, tokens: Tokens, at: Spaced, t_ns: Int64s, ok: Bools) -> Fast:
    """The frames at these places that hold up: digits, gaps, ranges, names.

    Args:
        lines: The chunk.
        tokens: Its words.
        at: Where the fields lie; every index must be a word of its line.
        t_ns: Shape (N,): times.
        ok: Shape (N,): what is known to be right so far.
    """
    if not len(at.line):
        return NO_FRAMES_FAST
    id_stop = tokens.stop[at.identifier] - at.id_tail
    identifier, id_ok = hexadecimal(lines.words, id_stop, id_stop - tokens.start[at.identifier])
    ok = ok & id_ok & (identifier <= np.where(at.is_extended, 0x1FFFFFFF, 0x7FF))
    start = np.where(at.length > 0, tokens.start[np.minimum(at.payload, len(tokens.start) - 1)], 0)
    payload, payload_ok = payloads(lines, start, at.length, at.is_fd, SPACE)
    # One past the last digit pair there must be a gap, or the last word is longer than a byte.
    after = lines.buffer[np.where(at.length > 0, start + 3 * at.length - 1, lines.stop[at.line])]
    ok &= payload_ok & (after <= SPACE)
    spelled: tuple[bytes, ...]
    if at.bus is None:
        bus, spelled = np.zeros(len(at.line), np.int64), (b"1",)
    else:
        name_start = tokens.start[at.bus]
        count = tokens.stop[at.bus] - name_start
        bus, spelled = labels(lines.words, name_start, count)
        is_name = np.array([is_bus_name(one) for one in spelled] + [False])
        ok &= (count <= LABEL_MAX) & is_name[bus]
    names = tuple(one.decode("ascii", "replace") for one in spelled)
    frames = CanFrames(
        identifier.astype(np.uint32),
        at.is_extended,
        np.full(len(at.line), DATA, np.uint8),
        at.length.astype(np.uint8),
        payload,
        at.is_fd,
    )
    return Fast(picked(ok, at.line, bus, t_ns, frames), names)


def is_bus_name(spelled: bytes) -> bool:
    """Printable ASCII, as all bus names are."""
    return bool(spelled) and all(SPACE < c < 127 for c in spelled)
