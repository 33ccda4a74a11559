"""Division of a text file into chunks of complete lines, and of lines into words."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from io import FileIO
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.columns import Bytes, Int64s

from .digits import BACK, FRONT, Words, byte_words

CHUNK_BYTES: Final = 1 << 20
NEWLINE: Final = 10
RETURN: Final = 13
SPACE: Final = 32
TAB: Final = 9
_LAST_PRINTABLE: Final = 126


@dataclass(frozen=True, slots=True, eq=False)
class Lines:
    """The complete lines of one chunk; valid until the next chunk is read.

    Attributes:
        buffer: The chunk with ``FRONT`` bytes before it and ``BACK`` after it.
        words: ``byte_words(buffer)``.
        start: Shape (N,), int64: first character of each line.
        stop: Shape (N,), int64: one past its last character, without the line end.
        first_number: Number of the first line in the file, counted from 1.
        done: Number of lines to use. The last line of a chunk may be for examination only, because
            it is repeated as the first line of the next chunk.
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
        """Return line ``i`` without its line end."""
        return self.buffer[int(self.start[i]) : int(self.stop[i])].tobytes()


@dataclass(frozen=True, slots=True)
class Overlong:
    """A range without a line end that is too long for a line of a CAN log.

    Attributes:
        number: Line number.
        byte_count: Minimum length in bytes.
    """

    number: int
    byte_count: int


@dataclass(frozen=True, slots=True)
class Tail:
    """The characters after the last line end, not empty.

    Attributes:
        number: Line number.
        text: The characters.
    """

    number: int
    text: bytes


def read_lines(path: Path, chunk_bytes: int = CHUNK_BYTES) -> Iterator[Lines | Overlong | Tail]:
    """Yield the file's lines in order, then the characters after the last line end.

    The last complete line of a chunk is repeated as the first line of the next chunk, so that every
    line is available together with the following one. Memory is bounded by one chunk.

    Raises:
        OSError: The file cannot be opened or read.
    """
    buffer = np.zeros(FRONT + chunk_bytes + BACK, np.uint8)
    buffer[FRONT + chunk_bytes :] = NEWLINE
    words = byte_words(buffer)
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
    """Read until ``end`` or the file's end; return the end, and whether it is the file's end."""
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


class WordRanges(NamedTuple):
    """One word of each of N lines, as ranges; an empty range at the line's end if missing."""

    start: Int64s
    stop: Int64s

    @property
    def size(self) -> Int64s:
        """Number of characters of each word."""
        return self.stop - self.start

    def take(self, index: NDArray[np.intp] | NDArray[np.bool_]) -> WordRanges:
        """Return the selected words."""
        return WordRanges(self.start[index], self.stop[index])


_ONES: Final = np.uint64(0x0101010101010101)
_HIGHS: Final = _ONES * np.uint64(0x80)
_ONE: Final = np.uint64(1)
_TO_HIGH: Final = _ONES * np.uint64(0x80 - 0x21)
_SEVEN: Final = np.uint64(7)
_FIFTY_SIX: Final = np.uint64(56)
# Multiplier that maps ``1 << 8 * k`` to a word with the highest byte ``k``.
_PLACES: Final = np.uint64(0x0001020304050607)
# Multiplier that packs eight bytes of 0 or 1 into the highest byte, the first byte lowest.
_TO_BITS: Final = np.uint64(0x0102040810204080)
_BITMAP_WORDS: Final = 6
_IN_BITMAP: Final = np.uint64((1 << 8 * _BITMAP_WORDS) - 1)
_STEPS_MAX: Final = 64


def next_fields(lines: Lines, at: Int64s, limit: Int64s, count: int) -> list[WordRanges]:
    """Find the next ``count`` words of lines, from ``at`` on and before ``limit``.

    A bitmap marks which of the next characters belong to a word. Words are found in the bitmap with
    the lowest-bit operations of Warren, Hacker's Delight, 2-1. All characters up to the blank count
    as gaps, so lines with other control characters must be excluded first, with ``clean_lines``.
    """
    inside = _bitmap(lines.words, at)
    fields = []
    past = at
    for _ in range(count):
        begin = inside & (~inside + _ONE)
        before = begin - _ONE
        outside = ~(inside | before) & _IN_BITMAP
        done = (outside & (~outside + _ONE)) - _ONE
        inside &= ~done
        start, stop = at + np.bitwise_count(before), at + np.bitwise_count(done)
        if not bool(outside.all()):
            open_ = np.flatnonzero(outside == 0)
            start[open_] = _seek(lines.words, past[open_], limit[open_], _word_bits)
            stop[open_] = _seek(lines.words, start[open_], limit[open_], _gap_bits)
        past = np.minimum(stop, limit)
        fields.append(WordRanges(np.minimum(start, limit), past))
    return fields


def _bitmap(words: Words, at: Int64s) -> Words:
    """Return a bitmap in which bit k is set if character ``at + k`` (k < 48) is not a gap."""
    bits = np.zeros(len(at), np.uint64)
    for k in range(_BITMAP_WORDS):
        eight = ((_word_bits(words[at + 8 * k]) >> _SEVEN) * _TO_BITS) >> _FIFTY_SIX
        bits |= eight << np.uint64(8 * k)
    return bits


def skip_gap(lines: Lines, at: Int64s, limit: Int64s) -> Int64s:
    """Return the start of the next word, or ``limit``."""
    return _seek(lines.words, at, limit, _word_bits)


def _word_bits(word: Words) -> Words:
    """Set the high bit of every character that is not a gap."""
    bits: Words = (((word & ~_HIGHS) + _TO_HIGH) | word) & _HIGHS
    return bits


def _gap_bits(word: Words) -> Words:
    """Set the high bit of every character that is a gap."""
    return _word_bits(word) ^ _HIGHS


def _seek(words: Words, at: Int64s, limit: Int64s, bits_of: Callable[[Words], Words]) -> Int64s:
    """Return the first position from ``at`` on that ``bits_of`` marks, or ``limit``."""
    bits = bits_of(words[at])
    found: Int64s = at + _index(bits & (~bits + _ONE))
    open_ = np.flatnonzero(bits == 0)
    for _ in range(_STEPS_MAX):
        if not len(open_):
            return np.minimum(found, limit)
        further = found[open_] + 8
        bits = bits_of(words[np.minimum(further, limit[open_])])
        found[open_] = further + _index(bits & (~bits + _ONE))
        open_ = open_[(bits == 0) & (further < limit[open_])]
    found[open_] = limit[open_]
    return np.minimum(found, limit)


def _index(bit: Words) -> Int64s:
    """Return the index of the character whose high bit is set; 0 for none."""
    index: Int64s = (((bit >> _SEVEN) * _PLACES) >> _FIFTY_SIX).view(np.int64)
    return index


def clean_lines(lines: Lines) -> Int64s:
    """Return the indices of the non-empty lines with only printable ASCII and tabs."""
    begin, end = int(lines.start[0]), int(lines.stop[-1]) + 1
    text = lines.buffer[begin:end]
    dirty = (text > _LAST_PRINTABLE) | ((text < SPACE) & ((text < TAB) | (text > RETURN)))
    keep = lines.stop > lines.start
    if bool(dirty.any()):
        place = np.flatnonzero(dirty) + begin
        keep[np.searchsorted(lines.start, place, side="right") - 1] = False
    return np.flatnonzero(keep)
