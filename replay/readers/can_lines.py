"""A text file as chunks of whole lines, with the ranges of lines, and of their words."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from io import FileIO
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.columns import Bytes, Int64s

from .digits import BACK, FRONT, Words, words_of

CHUNK_BYTES: Final = 1 << 20
NEWLINE: Final = 10
RETURN: Final = 13
SPACE: Final = 32
TAB: Final = 9


@dataclass(frozen=True, slots=True, eq=False)
class Lines:
    """The whole lines of one chunk; valid until the next chunk is asked for.

    Attributes:
        buffer: The chunk with ``FRONT`` bytes before it and ``BACK`` after it.
        words: ``words_of(buffer)``.
        start: Shape (N,), int64: first character of each line.
        stop: Shape (N,), int64: one past its last character; line ends are left out.
        first_number: Number of the first line in the file, counted from 1.
        done: How many lines are to be taken from here; one fewer than there are when the last one
            is only to be looked at, since it comes again as the first of the next chunk.
    """

    buffer: Bytes
    words: Words
    start: Int64s
    stop: Int64s
    first_number: int
    done: int

    def __len__(self) -> int:
        return len(self.start)

    def text(self, i: int) -> bytes:
        """Line ``i`` without its end."""
        return self.buffer[int(self.start[i]) : int(self.stop[i])].tobytes()


@dataclass(frozen=True, slots=True)
class Overlong:
    """A stretch without a line end that no line of a CAN log can be.

    Attributes:
        number: Line number.
        byte_count: How long it is at least.
    """

    number: int
    byte_count: int


@dataclass(frozen=True, slots=True)
class Tail:
    """What follows the last line end, not empty.

    Attributes:
        number: Line number.
        text: The characters.
    """

    number: int
    text: bytes


def lines_of(path: Path, chunk_bytes: int = CHUNK_BYTES) -> Iterator[Lines | Overlong | Tail]:
    """The file's lines in order, then what follows the last line end.

    The last whole line of a chunk comes again as the first of the next one, so that every line is
    given together with the one after it; memory is one chunk whatever the file holds.

    Raises:
        OSError: The file cannot be opened or read.
    """
    buffer = np.zeros(FRONT + chunk_bytes + BACK, np.uint8)
    buffer[FRONT + chunk_bytes :] = NEWLINE
    words = words_of(buffer)
    kept, number, dropping, is_end = 0, 1, 0, False
    with path.open("rb", buffering=0) as file:
        while not is_end:
            end, is_end = _fill(file, buffer, FRONT + kept, FRONT + chunk_bytes)
            newline = np.flatnonzero(buffer[FRONT:end] == NEWLINE) + FRONT
            if dropping and len(newline):
                yield Overlong(number, dropping)
                number, dropping, is_end = number + 1, 0, False
                kept = _keep(buffer, int(newline[0]) + 1, end)
            elif is_end:
                break
            elif len(newline) < 2:
                if len(newline):
                    yield _lines(buffer, words, newline, number, 1)
                    number += 1
                begin = int(newline[0]) + 1 if len(newline) else FRONT
                dropping, kept = dropping + end - begin, 0
            else:
                yield _lines(buffer, words, newline, number, len(newline) - 1)
                number += len(newline) - 1
                kept = _keep(buffer, int(newline[-2]) + 1, end)
    if dropping:
        yield Overlong(number, dropping + end - FRONT)
        return
    buffer[end : end + BACK] = NEWLINE
    if len(newline):
        yield _lines(buffer, words, newline, number, len(newline))
        number += len(newline)
    text = buffer[int(newline[-1]) + 1 if len(newline) else FRONT : end].tobytes()
    if text:
        yield Tail(number, text)


def _fill(file: FileIO, buffer: Bytes, begin: int, end: int) -> tuple[int, bool]:
    """Read until ``end`` or the file's end: where the bytes stop, and whether it is the file's."""
    while begin < end:
        got = file.readinto(buffer[begin:end].data) or 0
        if not got:
            return begin, True
        begin += got
    return begin, False


def _keep(buffer: Bytes, start: int, end: int) -> int:
    kept = end - start
    buffer[FRONT : FRONT + kept] = buffer[start:end].copy()
    return kept


def _lines(buffer: Bytes, words: Words, newline: Int64s, number: int, done: int) -> Lines:
    start = np.empty(len(newline), np.int64)
    start[0] = FRONT
    start[1:] = newline[:-1] + 1
    stop = newline - ((buffer[newline - 1] == RETURN) & (newline > start))
    return Lines(buffer, words, start, stop, number, done)


class Field(NamedTuple):
    """One word of each of N lines, as ranges; empty, at the line's end, where there is none."""

    start: Int64s
    stop: Int64s

    @property
    def size(self) -> Int64s:
        """Characters of each word."""
        return self.stop - self.start

    def take(self, index: NDArray[np.intp] | NDArray[np.bool_]) -> Field:
        """The words picked by ``index``."""
        return Field(self.start[index], self.stop[index])


_ONES: Final = np.uint64(0x0101010101010101)
_HIGHS: Final = _ONES * np.uint64(0x80)
_EXCLAMATION: Final = _ONES * np.uint64(0x21)
_TO_HIGH: Final = _ONES * np.uint64(0x80 - 0x21)
_STEPS_MAX: Final = 64


def next_fields(lines: Lines, at: Int64s, limit: Int64s, count: int) -> list[Field]:
    """The next ``count`` words of lines, from ``at`` on and before ``limit``.

    Eight characters are looked at in one step (Warren, Hacker's Delight, 6-1). Anything up to the
    blank counts as a gap, so lines with other control characters must be kept out, by
    ``clean_lines``.
    """
    fields = []
    for _ in range(count):
        start = _seek(lines.words, at, limit, _word_bits)
        at = _seek(lines.words, start, limit, _gap_bits)
        fields.append(Field(start, at))
    return fields


def skip_gap(lines: Lines, at: Int64s, limit: Int64s) -> Int64s:
    """Where the next word begins, or ``limit``."""
    return _seek(lines.words, at, limit, _word_bits)


def _gap_bits(word: Words) -> Words:
    """The lowest set bit marks the first character that is a gap."""
    bits: Words = (word - _EXCLAMATION) & ~word & _HIGHS
    return bits


def _word_bits(word: Words) -> Words:
    """The lowest set bit marks the first character that is none."""
    bits: Words = ((word + _TO_HIGH) | word) & _HIGHS
    return bits


def _seek(words: Words, at: Int64s, limit: Int64s, bits_of: Callable[[Words], Words]) -> Int64s:
    step = _first_byte(bits_of(words[at]))
    found: Int64s = np.minimum(at + step, limit)
    open_ = np.flatnonzero((step == 8) & (found < limit))
    for _ in range(_STEPS_MAX):
        if not len(open_):
            return found
        further = found[open_]
        step = _first_byte(bits_of(words[further]))
        found[open_] = np.minimum(further + step, limit[open_])
        open_ = open_[(step == 8) & (found[open_] < limit[open_])]
    found[open_] = limit[open_]
    return found


def _first_byte(bits: Words) -> Int64s:
    below: NDArray[np.uint8] = np.bitwise_count((bits & (~bits + np.uint64(1))) - np.uint64(1))
    first: Int64s = (below >> 3).astype(np.int64)
    return first


def clean_lines(lines: Lines) -> Int64s:
    """Indexes of the lines that are not empty and hold no control character but tabs."""
    begin, end = int(lines.start[0]), int(lines.stop[-1]) + 1
    text = lines.buffer[begin:end]
    dirty = (text < SPACE) & ((text < TAB) | (text > RETURN))
    keep = lines.stop > lines.start
    if bool(dirty.any()):
        place = np.flatnonzero(dirty) + begin
        keep[np.searchsorted(lines.start, place, side="right") - 1] = False
    return np.flatnonzero(keep)
