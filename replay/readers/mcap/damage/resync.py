"""Where records outside chunks go on after a place where they cannot be followed.

A record is believed only together with those behind it: ``LINKS`` in a row must be plausible, or
fewer that lead exactly to a place known to begin something else. A message is plausible if its
channel is known and its log time is within the recording; a schema or channel, if its fields fill
it exactly.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.readers.mcap.bytes import ByteFile
from crosscue.replay.readers.mcap.chunks.rows import Definition, Rows
from crosscue.replay.readers.mcap.records import (
    ATTACHMENT,
    CHANNEL,
    CHUNK,
    COMPRESSIONS,
    DATA_END,
    DATA_END_SIZE,
    MAX_HEAD,
    MESSAGE,
    MESSAGE_FIXED,
    MESSAGE_HEAD,
    METADATA,
    PREFIX,
    SCHEMA,
    BrokenRecordError,
    Heads,
    check_metadata,
    heads_at,
    read_channel,
    read_chunk_head,
    read_schema,
)

LINKS: Final = 3
"""Plausible records in a row that are believed wherever they end."""
DAY_NS: Final = 86_400 * 10**9
"""How far from the messages before it a log time may lie, where no statistics bound it."""
LATEST: Final = (1 << 63) - 1
MAX_UINT64: Final = (1 << 64) - 1
PIECE_MIN: Final = 4 << 10
PIECE_MAX: Final = 1 << 20
MAX_DEFINITION: Final = 1 << 20


class Plausible:
    """What is known of a recording's messages, against which found ones are held."""

    def __init__(self, channels: Iterable[int] = (), span: tuple[int, int] | None = None) -> None:
        """What is known before reading.

        Args:
            channels: Numbers of declared channels.
            span: First and last log time as the statistics say; None if they do not.
        """
        self._channels: NDArray[np.bool_] = np.zeros(1 << 16, dtype=np.bool_)
        self._channels[list(channels)] = True
        self._declared = span
        self._met: tuple[int, int] | None = None
        self._is_close = False

    def learn(self, rows: Rows) -> None:
        """Take in the channels and messages of a run."""
        for found in rows.definitions:
            if found.opcode == CHANNEL and len(found.content) >= 2:
                self._channels[int.from_bytes(found.content[:2], "little")] = True
        if len(rows) and self._declared is None:
            middle = int(np.sort(rows.log)[len(rows) // 2])
            near = rows.log[_within(rows.log, middle - DAY_NS, middle + DAY_NS)]
            self._met = (int(near.min()), int(near.max())) if len(near) else None
        if len(rows):
            apart = rows.log.astype(np.float64) - rows.publish.astype(np.float64)
            self._is_close = bool(2 * np.count_nonzero(np.abs(apart) <= DAY_NS) > len(rows))

    @property
    def is_declared(self) -> bool:
        """Is it declared, and not only guessed from other messages, when messages may stand?"""
        return self._declared is not None

    def span(self) -> tuple[int, int]:
        """Log times between which a message is plausible, both included."""
        if self._declared is not None:
            return self._declared
        if self._met is None:
            return 0, LATEST
        return self._met[0] - DAY_NS, min(self._met[1] + DAY_NS, LATEST)

    def messages(self, heads: Heads | Rows) -> NDArray[np.bool_]:
        """Shape (N,): which messages are plausible.

        The publish time counts where messages before were published about when they were logged.
        """
        first, last = self.span()
        is_plausible: NDArray[np.bool_] = _within(heads.log, first, last)
        if self._channels.any():
            is_plausible &= self._channels[heads.channel]
        if self._is_close:
            is_plausible &= _within(heads.publish, first - DAY_NS, last + DAY_NS)
        return is_plausible


def _within(log: NDArray[np.uint64], first: int, last: int) -> NDArray[np.bool_]:
    """Which times are between two, both included."""
    low, high = np.uint64(max(first, 0)), np.uint64(min(max(last, 0), MAX_UINT64))
    is_in: NDArray[np.bool_] = (log >= low) & (log <= high)
    return is_in


class Resync:
    """Finds records of one data section by what they must look like."""

    def __init__(
        self, file: ByteFile, end: int, has_end: bool, known: Sequence[int], plausible: Plausible
    ) -> None:
        """A search over one data section.

        Args:
            file: The bytes.
            end: Where the section, or the file, ends.
            has_end: The section's end is known.
            known: Where chunks begin, as a trusted summary says.
            plausible: What a message must look like.
        """
        self._file = file
        self._end = end
        self._has_end = has_end
        self._known = frozenset(known)
        self.plausible = plausible

    def last_trusted(self, rows: Rows) -> int:
        """Where, within a run that leads into damage, the last plausible message begins.

        Its length led into the damage, so it is the first record that cannot be trusted.
        """
        good = np.flatnonzero(self.plausible.messages(rows))
        return int(rows.offset[good[-1]]) if len(good) else 0

    def is_message(self, at: int, length: int) -> bool:
        """Is a record built like a plausible message, whatever kind it says it is?"""
        raw = self._file.peek(at, MESSAGE_HEAD.itemsize)
        if length < MESSAGE_FIXED or len(raw) < MESSAGE_HEAD.itemsize:
            return False
        head = heads_at(np.frombuffer(raw, dtype=np.uint8), np.zeros(1, np.int64))
        return bool(self.plausible.messages(head)[0])

    def continues(self, at: int, links: int = LINKS) -> bool:
        """Do ``links`` plausible records follow ``at``, or fewer up to where something begins?"""
        for _ in range(links):
            if self._is_anchor(at):
                return True
            after = self._after(at)
            if after is None:
                return False
            at = after
        return True

    def find(self, at: int, end: int) -> int | None:
        """Where plausible records begin again, from ``at`` on and before ``end``."""
        piece = PIECE_MIN
        while at < end:
            window = self._file.read(at, min(piece + MESSAGE_HEAD.itemsize, self._end - at))
            for offset in self._candidates(window, min(piece, end - at)):
                if not self._is_anchor(at + offset) and self.continues(at + offset):
                    return at + offset
            at, piece = at + piece, min(2 * piece, PIECE_MAX)
        return None

    def swallowed(self, at: int, rows: Rows) -> tuple[int, int] | None:
        """The first message of a run in which other records stand up to its very end, if any.

        Returns:
            Which message, and the offset in the buffer at which the first of the others begins.
        """
        found = self._messages(rows.buffer, _kinds(rows.buffer, rows.end, MESSAGE, MESSAGE))
        found = found[~np.isin(found, rows.offset)]
        holder = np.searchsorted(rows.offset, found) - 1
        for begin, i in zip(found.tolist(), holder.tolist(), strict=True):
            stop = int(rows.stop[i]) if i >= 0 else 0
            inner = int(rows.offset[i]) + MESSAGE_HEAD.itemsize
            if inner <= begin < stop and self._fills(at + begin, at + stop):
                return i, begin
        return None

    def _fills(self, at: int, stop: int) -> bool:
        while at < stop:
            after = self._after(at)
            if after is None:
                return False
            at = after
        return at == stop

    def _is_anchor(self, at: int) -> bool:
        if at == self._end or at in self._known:
            return True
        if self._has_end:
            return False
        raw = bytes(self._file.peek(at, PREFIX.size))
        return raw == PREFIX.pack(DATA_END, DATA_END_SIZE - PREFIX.size)

    def _candidates(self, window: NDArray[np.uint8], limit_at: int) -> list[int]:
        """Offsets, below ``limit_at``, at which a message, schema or channel may begin."""
        at = _kinds(window, limit_at, SCHEMA, MESSAGE)
        is_message = window[at] == MESSAGE
        found = np.concatenate((self._messages(window, at[is_message]), at[~is_message]))
        found.sort()
        offsets: list[int] = found.tolist()
        return offsets

    def _messages(self, window: NDArray[np.uint8], at: NDArray[np.int64]) -> NDArray[np.int64]:
        if not len(at):
            return at
        head = heads_at(window, at)
        kept: NDArray[np.int64] = at[(head.size >= MESSAGE_FIXED) & self.plausible.messages(head)]
        return kept

    def _after(self, at: int) -> int | None:
        """Where the record at ``at`` ends if it is plausible."""
        raw = self._file.peek(at, PREFIX.size)
        if len(raw) < PREFIX.size:
            return None
        opcode, length = PREFIX.unpack(raw)
        after: int = at + PREFIX.size + length
        if after > self._end:
            return None
        is_plausible = (
            self.is_message(at, length) if opcode == MESSAGE else self._is_other(at, opcode, length)
        )
        return after if is_plausible else None

    def _is_other(self, at: int, opcode: int, length: int) -> bool:
        if opcode == CHUNK:
            return self._is_chunk(at, length)
        if opcode == ATTACHMENT:
            return length >= 36
        if opcode not in (SCHEMA, CHANNEL, METADATA) or length > MAX_DEFINITION:
            return False
        content = self._file.read(at + PREFIX.size, length).tobytes()
        if opcode != METADATA:
            return is_exact(Definition(at, opcode, content))
        try:
            check_metadata(content)
        except BrokenRecordError:
            return False
        return length > 8

    def _is_chunk(self, at: int, length: int) -> bool:
        try:
            head = read_chunk_head(self._file.peek(at, MAX_HEAD)[PREFIX.size :])
        except BrokenRecordError:
            return False
        return head.compression in COMPRESSIONS and length == head.body_at + head.body_size


def _kinds(window: NDArray[np.uint8], limit_at: int, first: int, last: int) -> NDArray[np.int64]:
    """Offsets, below ``limit_at``, of records of one of these kinds that may have a sane length."""
    heads = window[: max(min(limit_at, len(window) - MESSAGE_HEAD.itemsize + 1), 0)]
    at: NDArray[np.int64] = np.flatnonzero((heads >= first) & (heads <= last)).astype(np.int64)
    for byte in (6, 7, 8):  # no record has a length of 2^40 bytes
        at = at[window[at + byte] == 0]
    return at


def is_exact(found: Definition) -> bool:
    """Do the fields of a schema or channel fill its record exactly?"""
    try:
        return _fills(found)
    except BrokenRecordError:
        return False


def _fills(found: Definition) -> bool:
    if found.opcode == CHANNEL:
        channel = read_channel(found.content)
        texts = len(channel.topic.encode()) + len(channel.message_encoding.encode())
        rest = len(found.content) - 16 - texts
        declared = found.content[12 + texts : 16 + texts]
        return bool(channel.topic) and rest == int.from_bytes(declared, "little")
    schema = read_schema(found.content)
    texts = len(schema.name.encode()) + len(schema.encoding.encode())
    return bool(schema.id and schema.name) and len(found.content) == 14 + texts + len(schema.text)
