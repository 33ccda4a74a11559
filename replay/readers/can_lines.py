"""A text file as chunks of whole lines, with the ranges of lines and words in each chunk."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from io import FileIO
from pathlib import Path
from typing import Final

import numpy as np

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


@dataclass(frozen=True, slots=True, eq=False)
class Tokens:
    """The words of ``Lines``, split at white space.

    Attributes:
        start: Shape (T,), int64: first character of each word.
        stop: Shape (T,), int64: one past its last.
        first: Shape (N,), int64: index of each line's first word.
        count: Shape (N,), int64: words of each line.
    """

    start: Int64s
    stop: Int64s
    first: Int64s
    count: Int64s


def tokens_of(lines: Lines, separator: int | None = None) -> Tokens:
    """Split all lines at spaces and tabs, or at one ``separator`` as well."""
    begin, end = int(lines.start[0]), int(lines.stop[-1]) + 1
    text = lines.buffer[begin - 1 : end + 1].copy()
    text[0] = text[-1] = text[-2] = NEWLINE
    is_gap = (text == SPACE) | ((text >= TAB) & (text <= RETURN))
    if separator is not None:
        is_gap |= text == separator
    edge = np.flatnonzero(is_gap[1:] != is_gap[:-1]) + begin
    start, stop = edge[::2], edge[1::2]
    first = np.searchsorted(start, lines.start)
    count = np.diff(first, append=len(start))
    return Tokens(start, stop, first, count)
