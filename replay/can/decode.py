"""Frames of one bus to the signals of its messages, in columns, with an exact account.

Each frame is looked up by its identifier and kind, checked against its message's length, and
decoded together with all frames of that message in the block. A frame that cannot be decoded is
counted by identifier and reason, in the ledger and in ``BusDecoder.counts``.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Final, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.columns import DATA, ERROR, LENGTH_UNKNOWN, REMOTE, Block, CanFrames, Table
from crosscue.replay.ledger import NOT_ASKED_TOPIC, Ledger

from .database import CanDatabase, spell_id
from .extract import PRESENT_SUFFIX, Extractor, Words
from .layout import Arithmetic, CanMessage

UNKNOWN_ID: Final = "id not in the database"
REMOTE_FRAME: Final = "remote frame"
ERROR_FRAME: Final = "error frame"
TOO_SHORT: Final = "frame shorter than its message"
TOO_LONG: Final = "frame longer than its message"
WRONG_FORMAT: Final = "CAN FD frame, but the database says classic"
NO_BRANCH: Final = "multiplexer value without a branch"
OTHERS: Final = (-1, False)
"""Stands for all further identifiers once ``COUNTS_KEPT`` have been told apart."""
COUNTS_KEPT: Final = 20_000

Engine: TypeAlias = Literal["auto", "numpy", "numba"]
Wanted: TypeAlias = Collection[str] | Collection[tuple[str, str]]
CountKey: TypeAlias = tuple[int, bool, str]

_STANDARD_IDS: Final = 2048


@dataclass(frozen=True, slots=True)
class DecodeSettings:
    """How strictly and by what means frames are decoded.

    Attributes:
        allow_longer: Decode frames with more bytes than their message has, ignoring the rest; for
            logs that lost the true length (comma2k19 stores 8 bytes always).
        engine: ``numpy``, ``numba``, or ``auto``.
    """

    allow_longer: bool = False
    engine: Engine = "auto"


@dataclass(frozen=True, slots=True)
class _Entry:
    """What the decoder knows about one message of the database."""

    message: CanMessage
    extractor: Extractor | None
    units: Mapping[str, str]
    refusal: str


class BusDecoder:
    """Decodes the frames of one bus, a block at a time.

    Rows of a message keep the order and the times of their frames. A column is float64, or int64 or
    uint64 where whole numbers may pass 2**53. In messages with multiplexers a signal that is not in
    a row is NaN there; a signal whose column is an integer one is 0 there, and the bool column
    ``SIGNAL_is_present`` says where it is real. Choices stay numbers.

    Attributes:
        counts: From (identifier, is extended, reason) to the frames not decoded.
    """

    def __init__(
        self,
        database: CanDatabase,
        bus: str,
        ledger: Ledger,
        wanted: Wanted | None = None,
        settings: DecodeSettings = DecodeSettings(),
    ) -> None:
        """Prepare the columns.

        Args:
            database: The messages of this bus.
            bus: Topic of the frames, and first part of the topics of the rows given.
            ledger: Told of every frame that is not decoded; the reader has counted those found.
            wanted: Message names, or (message, signal) pairs; None for everything.
            settings: How strictly and by what means.

        Raises:
            ValueError: ``wanted`` names a message or signal that the database lacks.
        """
        self._bus = bus
        self._ledger = ledger
        self._settings = settings
        self.counts: dict[CountKey, int] = {}
        chosen = _chosen(database, wanted)
        self._entries = tuple(_entry(message, chosen) for message in database.messages)
        self._lookup = _Lookup(tuple(e.message for e in self._entries))
        self._limits = _LengthLimits(self._entries, settings)

    def columns_of(self, message: str) -> dict[str, np.dtype[np.generic]]:
        """Names and types of the columns that rows of ``message`` have.

        Raises:
            ValueError: The database has no such message, or it is not decoded.
        """
        for entry in self._entries:
            if message in (entry.message.name, entry.message.topic_name) and entry.extractor:
                return _dtypes(entry.extractor)
        raise ValueError(f"{self._bus}: no message {message!r} is decoded")

    def __call__(self, block: Block) -> list[Block]:
        """Decode the frames of a block.

        Args:
            block: Its rows are ``CanFrames``.

        Returns:
            One block for each message present, called ``BUS/MESSAGE``.

        Raises:
            ValueError: The rows are something else.
        """
        frames = block.rows
        if not isinstance(frames, CanFrames):
            raise ValueError(f"{block.topic}: want CanFrames, got {type(frames).__name__}")
        slot = self._lookup(frames)
        good = self._limits(frames, slot)
        if not good.all():
            self._account(frames, slot, ~good, block.log_ns)
            slot = np.where(good, slot, np.uint16(0))
        return self._decode(block, frames, slot)

    def _decode(self, block: Block, frames: CanFrames, slot: NDArray[np.uint16]) -> list[Block]:
        counts = np.bincount(slot, minlength=len(self._entries) + 1)
        order = np.argsort(slot, kind="stable")  # a radix sort on 16 bits
        stops = np.cumsum(counts)
        words = _words(frames)[order]
        times = _Times(block, order)
        decoded = []
        for number in np.flatnonzero(counts[1:]) + 1:
            rows = slice(int(stops[number - 1]), int(stops[number]))
            entry = self._entries[number - 1]
            assert entry.extractor is not None
            columns, strange = entry.extractor(words[rows])
            one = times.block(f"{self._bus}/{entry.message.topic_name}", rows, columns, entry.units)
            if strange is not None:
                self._skip(entry.message.key, NO_BRANCH, one.log_ns[strange])
                one = one.take(~strange)
            if len(one):
                decoded.append(one)
        return decoded

    def _account(
        self,
        frames: CanFrames,
        slot: NDArray[np.uint16],
        bad: NDArray[np.bool_],
        log_ns: NDArray[np.int64],
    ) -> None:
        rows = np.flatnonzero(bad)
        reasons, reason_of_row = self._reasons(frames, slot, rows)
        identifier = frames.arbitration_id[rows].astype(np.int64)
        extended = frames.is_extended[rows]
        key = identifier | (extended.astype(np.int64) << 32) | (reason_of_row << 33)
        for value, first, count in zip(*_tally(key), strict=True):
            reason = reasons[int(value) >> 33]
            whose = int(value) & 0xFFFF_FFFF, bool(int(value) >> 32 & 1)
            self._tell(whose, reason, int(count), int(log_ns[rows[first]]))

    def _reasons(
        self, frames: CanFrames, slot: NDArray[np.uint16], rows: NDArray[np.intp]
    ) -> tuple[list[str], NDArray[np.int64]]:
        """All reasons, and the number of the one that holds for each of ``rows``."""
        reasons = [ERROR_FRAME, REMOTE_FRAME, UNKNOWN_ID, WRONG_FORMAT, TOO_SHORT, TOO_LONG]
        refusals = sorted({e.refusal for e in self._entries if e.refusal})
        refused = np.zeros(len(self._entries) + 1, dtype=np.int64)
        for number, entry in enumerate(self._entries, start=1):
            if entry.refusal:
                refused[number] = len(reasons) + refusals.index(entry.refusal)
        numbers, kind, length = slot[rows], frames.kind[rows], frames.length[rows]
        limits = self._limits
        which = np.select(
            [
                kind == ERROR,
                kind == REMOTE,
                numbers == 0,
                refused[numbers] > 0,
                frames.is_fd[rows] & limits.refuses_fd[numbers],
                length < limits.shortest[numbers],
            ],
            [np.int64(0), np.int64(1), np.int64(2), refused[numbers], np.int64(3), np.int64(4)],
            np.int64(5),
        )
        return reasons + refusals, which

    def _skip(self, whose: tuple[int, bool], reason: str, log_ns: NDArray[np.int64]) -> None:
        self._tell(whose, reason, len(log_ns), int(log_ns[0]))

    def _tell(self, whose: tuple[int, bool], reason: str, count: int, t_ns: int) -> None:
        """Count frames; only the first of a kind leaves a detail, or a busy bus would fill all."""
        key: CountKey = (*whose, reason)
        is_new = key not in self.counts
        if is_new and len(self.counts) >= COUNTS_KEPT:
            key = (*OTHERS, reason)
        self.counts[key] = self.counts.get(key, 0) + count
        if is_new:
            detail = f"{spell_id(*whose)}, first of them"
            self._ledger.skip(self._bus, reason, count, detail, t_ns)
        else:
            self._ledger.topic(self._bus).skipped[reason] += count


class _Lookup:
    """From frames to the number of their message, from 1; 0 for none."""

    def __init__(self, messages: tuple[CanMessage, ...]) -> None:
        # One place more than there are identifiers: whatever is larger ends there, unknown.
        self._standard = np.zeros(_STANDARD_IDS + 1, dtype=np.uint16)
        extended = []
        for number, message in enumerate(messages, start=1):
            if message.is_extended:
                extended.append((message.arbitration_id, number))
            else:
                self._standard[message.arbitration_id] = number
        extended.sort()
        self._ids = np.array([i for i, _ in extended], dtype=np.uint32)
        self._numbers = np.array([n for _, n in extended], dtype=np.uint16)

    def __call__(self, frames: CanFrames) -> NDArray[np.uint16]:
        slot = self._standard.take(frames.arbitration_id, mode="clip")
        if frames.is_extended.any():
            rows = np.flatnonzero(frames.is_extended)
            slot[rows] = self._of_extended(frames.arbitration_id[rows])
        return slot

    def _of_extended(self, ids: NDArray[np.uint32]) -> NDArray[np.uint16]:
        if not len(self._ids):
            return np.zeros(len(ids), dtype=np.uint16)
        place = np.searchsorted(self._ids, ids)
        place[place == len(self._ids)] = 0
        return np.where(self._ids[place] == ids, self._numbers[place], np.uint16(0))


class _LengthLimits:
    """Which frames have a fitting length; nothing fits a message that is refused."""

    def __init__(self, entries: tuple[_Entry, ...], settings: DecodeSettings) -> None:
        n = len(entries) + 1
        self.shortest = np.full(n, 256, dtype=np.int16)
        self.refuses_fd = np.zeros(n, dtype=np.bool_)
        self._longest = np.full((2, n), -1, dtype=np.int16)
        for number, entry in enumerate(entries, start=1):
            if entry.refusal:
                continue
            message = entry.message
            self.shortest[number] = min(message.length, 256)
            for is_fd in (False, True):
                longest = 255 if settings.allow_longer else message.longest_frame(is_fd)
                self._longest[int(is_fd), number] = min(longest, 255)
            if message.is_fd is False:
                self.refuses_fd[number] = True
                self._longest[1, number] = -1

    def __call__(self, frames: CanFrames, slot: NDArray[np.uint16]) -> NDArray[np.bool_]:
        """True for the frames that can be decoded."""
        longest = self._longest[0][slot]
        if frames.is_fd.any():
            longest = np.where(frames.is_fd, self._longest[1][slot], longest)
        good: NDArray[np.bool_] = frames.length >= self.shortest[slot]
        # Where the log keeps no lengths there is nothing to hold against the database.
        good &= (frames.length <= longest) | ((frames.length == LENGTH_UNKNOWN) & (longest >= 0))
        good &= frames.kind == DATA
        return good


class _Times:
    """The times of a block in another order, and blocks made of runs of it."""

    def __init__(self, block: Block, order: NDArray[np.intp]) -> None:
        self._log = block.log_ns[order]
        self._publish = None if block.publish_ns is None else block.publish_ns[order]
        self._header = None if block.header_ns is None else block.header_ns[order]

    def block(
        self,
        topic: str,
        rows: slice,
        columns: Mapping[str, NDArray[np.generic]],
        units: Mapping[str, str],
    ) -> Block:
        """Rows of one message with their times."""
        return Block(
            topic,
            self._log[rows],
            Table(columns, units),
            None if self._publish is None else self._publish[rows],
            None if self._header is None else self._header[rows],
        )


def _words(frames: CanFrames) -> Words:
    words: Words = np.ascontiguousarray(frames.data).view("<u8").astype(np.uint64, copy=False)
    return words


def _tally(
    key: NDArray[np.int64],
) -> tuple[NDArray[np.int64], NDArray[np.intp], NDArray[np.intp]]:
    """Distinct values, where each is first, and how often it occurs."""
    return np.unique(key, return_index=True, return_counts=True)


def _chosen(database: CanDatabase, wanted: Wanted | None) -> dict[tuple[int, bool], set[str]]:
    """From the identifier of a wanted message to the names of its wanted signals."""
    if wanted is None:
        return {m.key: {s.name for s in m.signals} for m in database.messages}
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


def _entry(message: CanMessage, chosen: Mapping[tuple[int, bool], set[str]]) -> _Entry:
    if message.key not in chosen:
        return _Entry(message, None, {}, NOT_ASKED_TOPIC)
    if message.problem:
        return _Entry(message, None, {}, message.problem)
    extractor = Extractor(message, chosen[message.key])
    units = {s.name: s.unit for s in extractor.signals if s.unit}
    return _Entry(message, extractor, units, "")


def _dtypes(extractor: Extractor) -> dict[str, np.dtype[np.generic]]:
    columns: dict[str, np.dtype[np.generic]] = {}
    for signal in extractor.signals:
        kind = signal.arithmetic
        is_integer = kind in (Arithmetic.INT64, Arithmetic.UINT64)
        columns[signal.name] = np.dtype(kind.value if is_integer else np.float64)
        if is_integer and signal.may_be_absent:
            columns[signal.name + PRESENT_SUFFIX] = np.dtype(np.bool_)
    return columns
