"""Search for records outside chunks after unreadable bytes.

A record is accepted only together with its successors: ``LINKS`` consecutive records must be
plausible, or fewer that end exactly where a known record starts. A message is plausible if its
channel is known and its log time is within the recording. A schema or channel is plausible if its
fields fill the record exactly, or are legible (``is_definition``).
"""

from collections.abc import Iterable, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.readers.mcap.bytes import ByteFile
from crosscue.replay.readers.mcap.chunks.rows import Definition, Rows
from crosscue.replay.readers.mcap.records import (
    COMPRESSIONS,
    DATA_END_SIZE,
    MAX_HEAD,
    MESSAGE_FIXED,
    MESSAGE_HEAD,
    PREFIX,
    BrokenRecordError,
    FieldParser,
    Heads,
    Op,
    check_metadata,
    heads_at,
    read_chunk_head,
)

# Number of consecutive plausible records that are accepted wherever they end.
LINKS: Final = 3
# Number of consecutive records of unknown kinds that are accepted whatever follows them.
UNKNOWN_LINKS: Final = 8
# Maximum difference of a log time from earlier messages, if no statistics bound it.
DAY_NS: Final = 86_400 * 10**9
LATEST: Final = (1 << 63) - 1
MAX_UINT64: Final = (1 << 64) - 1
PIECE_MIN: Final = 4 << 10
PIECE_MAX: Final = 1 << 20
MAX_DEFINITION: Final = 1 << 20


class Plausible:
    """Criteria for plausible messages, learned from a recording's known messages."""

    def __init__(self, channels: Iterable[int] = (), span: tuple[int, int] | None = None) -> None:
        """Set the criteria known before reading.

        Args:
            channels: Numbers of declared channels.
            span: First and last log time in the statistics; None if unknown.
        """
        self._channels: NDArray[np.bool_] = np.zeros(1 << 16, dtype=np.bool_)
        self._channels[list(channels)] = True
        self._declared = span
        self._met: tuple[int, int] | None = None
        self._is_close = False

    def declare(self, found: Definition) -> None:
        """Learn the number of a channel."""
        if found.opcode == Op.CHANNEL and len(found.content) >= 2:
            self._channels[int.from_bytes(found.content[:2], "little")] = True

    def learn(self, rows: Rows) -> None:
        """Learn from the channels and messages of a run."""
        for found in rows.definitions:
            self.declare(found)
        if len(rows) and self._declared is None:
            middle = int(np.sort(rows.log)[len(rows) // 2])
            near = rows.log[_within(rows.log, middle - DAY_NS, middle + DAY_NS)]
            self._met = (int(near.min()), int(near.max())) if len(near) else None
        if len(rows):
            apart = rows.log.astype(np.float64) - rows.publish.astype(np.float64)
            self._is_close = bool(2 * np.count_nonzero(np.abs(apart) <= DAY_NS) > len(rows))

    @property
    def has_channels(self) -> bool:
        """True if a channel is known."""
        return bool(self._channels.any())

    @property
    def is_declared(self) -> bool:
        """True if the time range is declared, and not only estimated from other messages."""
        return self._declared is not None

    def span(self) -> tuple[int, int]:
        """Range of plausible log times, both ends inclusive."""
        if self._declared is not None:
            return self._declared
        if self._met is None:
            return 0, LATEST
        return self._met[0] - DAY_NS, min(self._met[1] + DAY_NS, LATEST)

    def messages(self, heads: Heads | Rows) -> NDArray[np.bool_]:
        """Return a mask of the plausible messages, shape (N,).

        The publish time is checked if earlier messages were published close to their log times.
        """
        first, last = self.span()
        is_plausible: NDArray[np.bool_] = _within(heads.log, first, last)
        if self.has_channels:
            is_plausible &= self._channels[heads.channel]
        if self._is_close:
            is_plausible &= _within(heads.publish, first - DAY_NS, last + DAY_NS)
        return is_plausible


def _within(log: NDArray[np.uint64], first: int, last: int) -> NDArray[np.bool_]:
    """Return a mask of the times between ``first`` and ``last``, both inclusive."""
    low, high = np.uint64(max(first, 0)), np.uint64(min(max(last, 0), MAX_UINT64))
    is_in: NDArray[np.bool_] = (log >= low) & (log <= high)
    return is_in


class McapResync:
    """Finds plausible records in a data section."""

    def __init__(
        self, file: ByteFile, end: int, has_end: bool, known: Sequence[int], plausible: Plausible
    ) -> None:
        """Prepare a search in a data section.

        Args:
            file: The bytes.
            end: End of the section or of the file.
            has_end: True if the section's end is known.
            known: Offsets of chunks in a trusted summary.
            plausible: Criteria for messages.
        """
        self._file = file
        self._end = end
        self._has_end = has_end
        self._known = frozenset(known)
        self.plausible = plausible

    def last_trusted(self, rows: Rows) -> int:
        """Return the start of the last plausible message of a run that leads into damage.

        Its length led into the damage, so it is the first record that cannot be trusted.
        """
        good = np.flatnonzero(self.plausible.messages(rows))
        return int(rows.offset[good[-1]]) if len(good) else 0

    def is_message(self, at: int, length: int) -> bool:
        """Return whether a record of any kind has the structure of a plausible message."""
        raw = self._file.peek(at, MESSAGE_HEAD.itemsize)
        if length < MESSAGE_FIXED or len(raw) < MESSAGE_HEAD.itemsize:
            return False
        head = heads_at(np.frombuffer(raw, dtype=np.uint8), np.zeros(1, np.int64))
        return bool(self.plausible.messages(head)[0])

    def is_hidden(self, at: int, length: int) -> bool:
        """Return whether a record of another kind may be a message whose kind was damaged.

        Only messages of a known channel count: none can precede the first channel.
        """
        return self.plausible.has_channels and self.is_message(at, length)

    def continues(self, at: int, links: int = LINKS) -> bool:
        """Return whether ``links`` plausible records, or fewer up to an anchor, start at ``at``."""
        for _ in range(links):
            if self._is_anchor(at):
                return True
            after = self._after(at)
            if after is None:
                return False
            at = after
        return True

    def follows_unknown(self, at: int) -> bool:
        """Return whether a plausible record starts at ``at``, or after others of unknown kinds."""
        for _ in range(UNKNOWN_LINKS):
            if self.continues(at, 1):
                return True
            raw = self._file.peek(at, PREFIX.size)
            if len(raw) < PREFIX.size:
                return False
            opcode, length = PREFIX.unpack(raw)
            if opcode <= Op.DATA_END or self.is_hidden(at, length):
                return False
            at += PREFIX.size + length
        return True

    def find(self, at: int, end: int) -> int | None:
        """Return the next offset from ``at`` on and before ``end`` with plausible records."""
        piece = PIECE_MIN
        while at < end:
            window = self._file.read(at, min(piece + MESSAGE_HEAD.itemsize, self._end - at))
            for offset in self._candidates(window, min(piece, end - at)):
                if not self._is_anchor(at + offset) and self.continues(at + offset):
                    return at + offset
            at, piece = at + piece, min(2 * piece, PIECE_MAX)
        return None

    def swallowed(self, at: int, rows: Rows) -> tuple[int, int] | None:
        """Find the first message of a run whose end consists of other records, if any.

        Returns:
            Index of the message, and the offset in the buffer of the first of these records.
        """
        found = self._messages(rows.buffer, _kinds(rows.buffer, rows.end, Op.MESSAGE, Op.MESSAGE))
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
        return raw == PREFIX.pack(Op.DATA_END, DATA_END_SIZE - PREFIX.size)

    def _candidates(self, window: NDArray[np.uint8], limit_at: int) -> list[int]:
        """Return offsets below ``limit_at`` at which a message, schema or channel may start."""
        at = _kinds(window, limit_at, Op.SCHEMA, Op.MESSAGE)
        is_message = window[at] == Op.MESSAGE
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
        """Return the end of the record at ``at`` if it is plausible, else None."""
        raw = self._file.peek(at, PREFIX.size)
        if len(raw) < PREFIX.size:
            return None
        opcode, length = PREFIX.unpack(raw)
        after: int = at + PREFIX.size + length
        if after > self._end:
            return None
        is_message = opcode == Op.MESSAGE
        is_good = self.is_message(at, length) if is_message else self._is_other(at, opcode, length)
        return after if is_good else None

    def _is_other(self, at: int, opcode: int, length: int) -> bool:
        if opcode == Op.CHUNK:
            return self._is_chunk(at, length)
        if opcode == Op.ATTACHMENT:
            return length >= 36
        if opcode not in (Op.SCHEMA, Op.CHANNEL, Op.METADATA) or length > MAX_DEFINITION:
            return False
        content = self._file.read(at + PREFIX.size, length).tobytes()
        if opcode != Op.METADATA:
            return is_definition(Definition(at, opcode, content))
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
    """Return offsets below ``limit_at`` of possible records of these kinds and plausible length."""
    heads = window[: max(min(limit_at, len(window) - MESSAGE_HEAD.itemsize + 1), 0)]
    at: NDArray[np.int64] = np.flatnonzero((heads >= first) & (heads <= last)).astype(np.int64)
    for byte in (6, 7, 8):  # no record has a length of 2^40 bytes
        at = at[window[at + byte] == 0]
    return at


def is_definition(found: Definition) -> bool:
    """Return whether a record is a schema or channel, and not a message whose kind was damaged.

    Its fields fill the record exactly; or, because the format may be extended by fields at the
    record's end, they end inside it and are legible text. A message read by these fields has its
    sequence number and times as lengths and names, which are neither.
    """
    fields = FieldParser(found.content)
    try:
        number = fields.number(2)
        if found.opcode == Op.CHANNEL:
            fields.take(2)
        name, encoding = (bytes(fields.take(fields.number(4))) for _ in range(2))
        fields.take(fields.number(4))
        if found.opcode == Op.SCHEMA and not number:
            return False
        if fields.at == len(found.content):
            return True
        return bool(name) and (name + encoding).decode().isprintable()
    except (BrokenRecordError, UnicodeDecodeError):
        return False
