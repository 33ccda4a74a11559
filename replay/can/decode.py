"""Decode the frames of one bus into columns of signals, and account for every frame.

Each frame is looked up by its identifier and kind, checked against its message's length, and
decoded together with all frames of that message in the block. A frame that cannot be decoded is
counted by identifier and reason, in the ledger and in ``BusDecoder.counts``.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.columns import (
    DATA,
    ERROR,
    LENGTH_UNKNOWN,
    REMOTE,
    Block,
    CanFrames,
    Int64s,
    Table,
)
from crosscue.replay.ledger import NOT_ASKED_TOPIC, Ledger

from .database import CanDatabase, spell_id
from .extract import MessageExtractor
from .grouping import STANDARD_IDS, Grouped, GroupedDecoder, MessageRules
from .layout import CanMessage

UNKNOWN_ID: Final = "id not in the database"
REMOTE_FRAME: Final = "remote frame"
ERROR_FRAME: Final = "error frame"
TOO_SHORT: Final = "frame shorter than its message"
TOO_LONG: Final = "frame longer than its message"
WRONG_FORMAT: Final = "CAN FD frame of a classic message"
NO_BRANCH: Final = "multiplexer value without a branch"
RARE_REASONS: Final = (ERROR_FRAME, REMOTE_FRAME, UNKNOWN_ID, WRONG_FORMAT, TOO_SHORT, TOO_LONG)
# Key for all further identifiers once ``COUNTS_KEPT`` are counted separately.
OTHERS: Final = (-1, False)
COUNTS_KEPT: Final = 20_000

Wanted: TypeAlias = Collection[str] | Collection[tuple[str, str]]
CountKey: TypeAlias = tuple[int, bool, str]


@dataclass(frozen=True, slots=True)
class _Entry:
    """The decoder's entry for one message of the database."""

    message: CanMessage
    extractor: MessageExtractor | None
    refusal: str


class BusDecoder:
    """Decoder of the frames of one bus, which processes a block at a time.

    Rows of a message keep the order and the times of their frames. A column is float64, or int64 or
    uint64 where integers may exceed 2**53. In messages with multiplexers, a signal that is absent
    from a row is NaN there. An integer column holds 0 there instead, and the bool column
    ``SIGNAL_is_present`` marks the rows where the value is real. Choices remain numbers.

    Attributes:
        counts: Number of frames not decoded, by (identifier, is extended, reason).
    """

    def __init__(
        self,
        database: CanDatabase,
        bus: str,
        ledger: Ledger,
        wanted: Wanted | None = None,
        *,
        allow_longer: bool = False,
        elsewhere: Collection[int] = (),
    ) -> None:
        """Prepare the columns.

        Args:
            database: The messages of this bus.
            bus: Topic of the frames, and first part of the topics of the decoded rows.
            ledger: Records every frame that is not decoded; the reader has counted those found.
            wanted: Message names, or (message, signal) pairs; None for everything.
            allow_longer: Decode frames that have more bytes than their message, and ignore the
                rest; for logs that pad frames.
            elsewhere: 11-bit identifiers that another decoder of this bus reads and accounts for.
                They are not counted as unknown where the database lacks them.

        Raises:
            ValueError: ``wanted`` names a message or signal that the database lacks.
        """
        self._bus = bus
        self._ledger = ledger
        self._elsewhere = frozenset(elsewhere)
        self.counts: dict[CountKey, int] = {}
        chosen = _chosen(database, wanted)
        entries = [_entry(database, message, chosen) for message in database.messages]
        # The grouping expects decodable messages first.
        self._entries = tuple(sorted(entries, key=lambda entry: bool(entry.refusal)))
        self._refused = np.array([False, *(bool(entry.refusal) for entry in self._entries)])
        self._rules = [_rules(entry, allow_longer) for entry in self._entries]
        self._decoder = GroupedDecoder(self._rules)

    def __call__(self, block: Block) -> list[Block]:
        """Decode the frames of a block.

        Args:
            block: Its rows are ``CanFrames``.

        Returns:
            One block for each message present, with topic ``BUS/MESSAGE``.

        Raises:
            ValueError: The rows are not ``CanFrames``.
        """
        frames = block.rows
        if not isinstance(frames, CanFrames):
            raise ValueError(f"{block.topic}: expected CanFrames, got {type(frames).__name__}")
        grouped = self._decoder.group(frames)
        if len(grouped.order) < len(frames):
            self._account(frames, grouped, block.log_ns)
        times = _Times(block, grouped.order)
        decoded = []
        for number in (np.flatnonzero(np.diff(grouped.stops)) + 1).tolist():
            entry = self._entries[number - 1]
            columns, strange = self._decoder.columns(number)
            topic = f"{self._bus}/{entry.message.topic_name}"
            assert entry.extractor is not None
            one = times.block(topic, grouped.rows(number), columns, entry.extractor.units)
            if strange is not None:
                key, count = (*entry.message.key, NO_BRANCH), int(strange.sum())
                if not self._add(key, count):
                    self._report(key, count, one.log_ns, strange)
                one = one.take(~strange)
            if len(one):
                decoded.append(one)
        return decoded

    def _account(self, frames: CanFrames, grouped: Grouped, log_ns: Int64s) -> None:
        """Count the frames that cannot be decoded, each under the first reason that applies."""
        number, ids, is_data = grouped.number, frames.arbitration_id, frames.kind == DATA
        left = len(frames) - len(grouped.order)
        for identifier in np.flatnonzero(grouped.unknown).tolist():
            count = int(grouped.unknown[identifier])
            left -= count
            if identifier in self._elsewhere:
                continue
            if not self._add((identifier, False, UNKNOWN_ID), count):
                mine = is_data & (ids == identifier) & ~frames.is_extended
                self._report((identifier, False, UNKNOWN_ID), count, log_ns, mine)
        for at in np.flatnonzero(self._refused & (grouped.seen > 0)).tolist():
            entry, count = self._entries[at - 1], int(grouped.seen[at])
            left -= count
            key = (*entry.message.key, entry.refusal)
            if not self._add(key, count):
                self._report(key, count, log_ns, is_data & (number == at))
        if left:
            self._account_rare(frames, grouped, log_ns)

    def _account_rare(self, frames: CanFrames, grouped: Grouped, log_ns: Int64s) -> None:
        """Count frames of unfit size, frames that are not data, and unknown 29-bit identifiers."""
        number, ids, is_data = grouped.number, frames.arbitration_id, frames.kind == DATA
        is_plain_unknown = (number == 0) & ~frames.is_extended & (ids < STANDARD_IDS)
        rows = np.flatnonzero(
            ~grouped.is_good & ~(is_data & (is_plain_unknown | self._refused[number]))
        )
        which = self._first_reason(frames.take(rows), number[rows])
        key = ids[rows].astype(np.int64)
        key |= (frames.is_extended[rows].astype(np.int64) << 32) | (which << 33)
        values, first, counts = np.unique(key, return_index=True, return_counts=True)
        for value, at, count in zip(
            values.tolist(), rows[first].tolist(), counts.tolist(), strict=True
        ):
            whose = (value & 0xFFFF_FFFF, bool(value >> 32 & 1), RARE_REASONS[value >> 33])
            if not self._add(whose, count):
                self._report(whose, count, log_ns, np.arange(len(log_ns)) == at)

    def _first_reason(self, frames: CanFrames, number: NDArray[np.uint16]) -> Int64s:
        """Return, for each frame, the index in ``RARE_REASONS`` of the first that applies."""
        refuses_fd = np.array([False, *(rule.longest[1] < 0 for rule in self._rules)])
        shortest = np.array([0, *(rule.message.length for rule in self._rules)])
        carried = np.minimum(frames.length, frames.data.shape[1])
        holds = [
            frames.kind == ERROR,
            frames.kind == REMOTE,
            number == 0,
            frames.is_fd & refuses_fd[number],
            carried < shortest[number],
        ]
        return np.select(holds, [np.int64(i) for i in range(len(holds))], np.int64(len(holds)))

    def _add(self, key: CountKey, count: int) -> bool:
        """Count more frames of a kind already reported; return False if it was not reported."""
        if key not in self.counts:
            return False
        self.counts[key] += count
        self._ledger.skip_more(self._bus, key[2], count)
        return True

    def _report(self, key: CountKey, count: int, log_ns: Int64s, rows: NDArray[np.bool_]) -> None:
        """Count frames and record a detail of the first of a kind, to bound the ledger's size."""
        detail = f"{spell_id(*key[:2])}, first of them"
        if len(self.counts) >= COUNTS_KEPT:
            key = (*OTHERS, key[2])
        self.counts[key] = self.counts.get(key, 0) + count
        self._ledger.skip(self._bus, key[2], count, detail, int(log_ns[np.argmax(rows)]))


class _Times:
    """The times of a block in another order, from which blocks of single messages are built."""

    def __init__(self, block: Block, order: NDArray[np.intp]) -> None:
        self._log = block.log_ns.take(order)
        self._publish = None if block.publish_ns is None else block.publish_ns.take(order)
        self._header = None if block.header_ns is None else block.header_ns.take(order)

    def block(
        self,
        topic: str,
        rows: slice,
        columns: Mapping[str, NDArray[np.generic]],
        units: Mapping[str, str],
    ) -> Block:
        """Return the rows of one message with their times."""
        return Block(
            topic,
            self._log[rows],
            Table(columns, units),
            None if self._publish is None else self._publish[rows],
            None if self._header is None else self._header[rows],
        )


_Chosen: TypeAlias = Mapping[tuple[int, bool], set[str]]


def _chosen(database: CanDatabase, wanted: Wanted | None) -> _Chosen | None:
    """Return the names of the selected signals by message identifier; None for all."""
    if wanted is None:
        return None
    chosen: dict[tuple[int, bool], set[str]] = {}
    for item in wanted:
        name, signal = (item, None) if isinstance(item, str) else item
        message = database.named(name)
        signals = chosen.setdefault(message.key, set())
        if signal is None:
            signals |= {s.name for s in message.signals}
        else:
            signals.add(message.signal(signal).name)
    return chosen


def _entry(database: CanDatabase, message: CanMessage, chosen: _Chosen | None) -> _Entry:
    if chosen is not None and message.key not in chosen:
        return _Entry(message, None, NOT_ASKED_TOPIC)
    if message.problem:
        return _Entry(message, None, message.problem)
    wanted = None if chosen is None else chosen[message.key]
    return _Entry(message, database.extractor(message, wanted), "")


def _rules(entry: _Entry, allow_longer: bool) -> MessageRules:
    message = entry.message
    if entry.extractor is None:
        return MessageRules(message, None, (-1, -1))
    if allow_longer:
        classic = flexible = LENGTH_UNKNOWN
    else:
        classic, flexible = message.longest_frame(False), message.longest_frame(True)
    return MessageRules(
        message, entry.extractor, (classic, -1 if message.is_fd is False else flexible)
    )
