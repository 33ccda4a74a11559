"""Decode the frames of one bus into columns of signals, and account for every frame.

Each frame is looked up by its identifier and kind, checked against its message's length, and
decoded together with all frames of that message in the block. A frame that cannot be decoded is
counted by identifier and reason, in the ledger and in ``BusDecoder.counts``.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, TypeAlias

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
from .extract import Column, MessageExtractor, Words
from .layout import CanMessage

STANDARD_IDS: Final = 2048
# Max number of messages for which searching for each is faster than sorting (0.11 ms against 0.21
# ms for 10 messages in 58,000 frames).
FEW: Final = 16

Columns: TypeAlias = dict[str, Column]
Strange: TypeAlias = NDArray[np.bool_] | None


@dataclass(frozen=True, slots=True)
class MessageRules:
    """Requirements on the frames of one message.

    Attributes:
        message: The message.
        extractor: Extractor of its signals, or None if it is not decoded.
        longest: Max bytes of a classic frame and of an FD frame; -1 where no frame fits.
        refusal: Reason why it is not decoded, or empty.
    """

    message: CanMessage
    extractor: MessageExtractor | None
    longest: tuple[int, int]
    refusal: str = ""


@dataclass(frozen=True, slots=True)
class RuleArrays:
    """The rules of all messages as arrays; message number 0 means no message.

    Attributes:
        standard: Shape (2049,): message number of each 11-bit identifier; the last element is for
            larger identifiers.
        extended_ids: Sorted 29-bit identifiers.
        extended_numbers: Message numbers of ``extended_ids``.
        fits: By width of the payload array: shape (2, M + 1, 256), True where a classic or FD frame
            of this message and length can be decoded.
    """

    standard: NDArray[np.uint16]
    extended_ids: NDArray[np.uint32]
    extended_numbers: NDArray[np.uint16]
    fits: dict[int, NDArray[np.bool_]]

    @classmethod
    def of(cls, rules: Sequence[MessageRules]) -> RuleArrays:
        """Build the tables; messages are numbered from 1."""
        standard = np.zeros(STANDARD_IDS + 1, dtype=np.uint16)
        fits = {width: np.zeros((2, len(rules) + 1, 256), dtype=np.bool_) for width in (8, 64)}
        extended = []
        for number, rule in enumerate(rules, start=1):
            if rule.message.is_extended:
                extended.append((rule.message.arbitration_id, number))
            else:
                standard[rule.message.arbitration_id] = number
        decoded = [rule.extractor is not None for rule in rules]
        sizes = np.array([rule.message.length for rule in rules], dtype=np.int64)
        longest = np.array([rule.longest for rule in rules], dtype=np.int64).reshape(-1, 2)
        fitting = _fitting_lengths(sizes, longest.T) & np.array(decoded, dtype=np.bool_)[:, None]
        for width, table in fits.items():
            table[:, 1:] = fitting & (sizes <= width)[:, None]
        extended.sort()
        ids = np.array([i for i, _ in extended], dtype=np.uint32)
        numbers = np.array([n for _, n in extended], dtype=np.uint16)
        return cls(standard, ids, numbers, fits)


def _fitting_lengths(sizes: NDArray[np.int64], longest: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return a mask of the lengths that fit, shape (2, M, 256), from shapes (M,) and (2, M)."""
    length, max_length = np.arange(256), longest[:, :, None]
    fits: NDArray[np.bool_] = (length >= sizes[:, None]) & (length <= max_length)
    # A log that does not record lengths cannot contradict the database.
    fits[:, :, LENGTH_UNKNOWN] |= longest >= 0
    return fits


@dataclass(frozen=True, slots=True)
class Grouped:
    """The frames of a block, grouped by message.

    Attributes:
        number: Shape (N,): number of each frame's message, 0 for none.
        is_good: Shape (N,): True if the frame can be decoded.
        order: Shape (G,): indices of the G good frames, those of message 1 first.
        stops: Shape (M + 1,): end of each message in ``order``; 0 for message 0.
        seen: Shape (M + 1,): number of data frames of each message, good or not.
        unknown: Shape (2048,): number of data frames of no message, by 11-bit identifier.
    """

    number: NDArray[np.uint16]
    is_good: NDArray[np.bool_]
    order: NDArray[np.intp]
    stops: NDArray[np.intp]
    seen: NDArray[np.intp]
    unknown: NDArray[np.intp]

    def rows(self, number: int) -> slice:
        """Return the slice of ``order`` that holds a message's frames."""
        return slice(int(self.stops[number - 1]), int(self.stops[number]))


class GroupedDecoder:
    """Decoder that groups the frames of a block by message, and extracts the columns of each."""

    def __init__(self, rules: Sequence[MessageRules]) -> None:
        """Prepare the tables; rules without an extractor must be last."""
        self._rules = rules
        self._decodable = sum(rule.extractor is not None for rule in rules)
        self._tables = RuleArrays.of(rules)
        self._numbers = np.arange(len(rules) + 1, dtype=np.uint16)
        self._grouped: Grouped | None = None
        self._words: Words = np.zeros((0, 1), dtype=np.uint64)

    def group(self, frames: CanFrames) -> Grouped:
        """Look up, check and sort frames."""
        number = self._number(frames)
        is_data = frames.kind == DATA
        is_good = (number > 0) & (number <= self._decodable)
        order, stops = self._sort(number)
        seen = np.diff(stops, prepend=0)
        if not self._all_fit(frames, order, stops):
            is_good = self._fits(frames, number) & is_data
            seen = np.bincount(number[is_data], minlength=len(self._rules) + 1)
            order, stops = self._sort(np.where(is_good, number, np.uint16(0)))
        order = order[stops[0] : stops[self._decodable]]
        stops = np.minimum(stops, stops[self._decodable]) - stops[0]
        words: Words = np.ascontiguousarray(frames.data).view("<u8").astype(np.uint64, copy=False)
        self._words = words.take(order, axis=0)
        unknown = is_data & (number == 0) & ~frames.is_extended
        by_id = np.bincount(
            np.minimum(frames.arbitration_id[unknown], STANDARD_IDS), minlength=STANDARD_IDS
        )
        self._grouped = Grouped(number, is_good, order, stops, seen, by_id[:STANDARD_IDS])
        return self._grouped

    def _sort(self, number: NDArray[np.uint16]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Return the frames in order of ``number``, and the end of each number."""
        if len(self._numbers) <= FEW:
            each = [np.flatnonzero(number == one) for one in self._numbers]
            return np.concatenate(each), np.cumsum([len(rows) for rows in each])
        order = np.argsort(number, kind="stable")  # a radix sort on 16 bits
        return order, np.searchsorted(number.take(order), self._numbers, side="right")

    def _all_fit(self, frames: CanFrames, order: NDArray[np.intp], stops: NDArray[np.intp]) -> bool:
        """Check from the extreme lengths alone that all decodable frames fit, the usual case."""
        if frames.kind.any() or frames.is_fd.any():
            return False
        ends = stops[: self._decodable + 1]
        groups = np.flatnonzero(np.diff(ends))
        if not len(groups):
            return True
        lengths = frames.length.take(order[: ends[-1]])
        shortest = np.minimum.reduceat(lengths, ends[groups])
        max_length = np.maximum.reduceat(lengths, ends[groups])
        fits = self._tables.fits[frames.data.shape[1]][0, groups + 1]
        at = np.arange(len(groups))
        # All lengths between two fitting lengths fit, except the number that means "unknown".
        in_one_piece = (max_length < LENGTH_UNKNOWN) | (shortest == LENGTH_UNKNOWN)
        return bool((fits[at, shortest] & fits[at, max_length] & in_one_piece).all())

    def columns(self, number: int) -> tuple[Columns, Strange]:
        """Return the columns of one message of the last group of frames."""
        extractor = self._rules[number - 1].extractor
        assert extractor is not None
        assert self._grouped is not None
        return extractor(self._words[self._grouped.rows(number)])

    def _number(self, frames: CanFrames) -> NDArray[np.uint16]:
        tables = self._tables
        number = tables.standard.take(frames.arbitration_id, mode="clip")
        if not frames.is_extended.any():
            return number
        rows = np.flatnonzero(frames.is_extended)
        if not len(tables.extended_ids):
            number[rows] = 0
            return number
        ids = frames.arbitration_id[rows]
        place = np.searchsorted(tables.extended_ids, ids)
        place[place == len(tables.extended_ids)] = 0
        is_known = tables.extended_ids[place] == ids
        number[rows] = np.where(is_known, tables.extended_numbers[place], np.uint16(0))
        return number

    def _fits(self, frames: CanFrames, number: NDArray[np.uint16]) -> NDArray[np.bool_]:
        fits: NDArray[np.bool_] = self._tables.fits[frames.data.shape[1]][
            frames.is_fd.view(np.uint8), number, frames.length
        ]
        return fits


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
        rules = [_rules(database, message, chosen, allow_longer) for message in database.messages]
        # The grouping expects decodable messages first.
        self._rules = sorted(rules, key=lambda rule: bool(rule.refusal))
        self._refused = np.array([False, *(bool(rule.refusal) for rule in self._rules)])
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
        names = ("log_ns", "publish_ns", "header_ns")
        clocks: dict[str, Any] = {name: getattr(block, name) for name in names}
        times = {n: one.take(grouped.order) for n, one in clocks.items() if one is not None}
        decoded = []
        for number in (np.flatnonzero(np.diff(grouped.stops)) + 1).tolist():
            rule = self._rules[number - 1]
            columns, strange = self._decoder.columns(number)
            topic = f"{self._bus}/{rule.message.topic_name}"
            assert rule.extractor is not None
            at = grouped.rows(number)
            rows = Table(columns, rule.extractor.units)
            one = Block(topic, rows=rows, **{name: ns[at] for name, ns in times.items()})
            if strange is not None:
                key, count = (*rule.message.key, NO_BRANCH), int(strange.sum())
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
            rule, count = self._rules[at - 1], int(grouped.seen[at])
            left -= count
            key = (*rule.message.key, rule.refusal)
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


def _rules(
    database: CanDatabase, message: CanMessage, chosen: _Chosen | None, allow_longer: bool
) -> MessageRules:
    refusal = message.problem
    if chosen is not None and message.key not in chosen:
        refusal = NOT_ASKED_TOPIC
    if refusal:
        return MessageRules(message, None, (-1, -1), refusal)
    wanted = None if chosen is None else chosen[message.key]
    if allow_longer:
        classic = flexible = LENGTH_UNKNOWN
    else:
        classic, flexible = message.longest_frame(False), message.longest_frame(True)
    longest = (classic, -1 if message.is_fd is False else flexible)
    return MessageRules(message, database.extractor(message, wanted), longest)
