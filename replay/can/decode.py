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
from .engines import Engine, Grouped, NumbaEngine, NumpyEngine, Rules, has_numba
from .extract import PRESENT_SUFFIX, Extractor
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

AUTO_FRAMES: Final = 4_000_000
"""From so many frames on, compiled loops make up for the time that loading Numba takes."""

EngineName: TypeAlias = Literal["auto", "numpy", "numba"]
Wanted: TypeAlias = Collection[str] | Collection[tuple[str, str]]
CountKey: TypeAlias = tuple[int, bool, str]

_FEW_KEYS: Final = 1 << 20


@dataclass(frozen=True, slots=True)
class DecodeSettings:
    """How strictly and by what means frames are decoded.

    Attributes:
        allow_longer: Decode frames with more bytes than their message has, ignoring the rest; for
            logs that pad them.
        engine: ``numpy``; ``numba``; or ``auto``, which begins with NumPy and goes on with Numba,
            where it is installed, after ``AUTO_FRAMES`` frames. All give the same values.
    """

    allow_longer: bool = False
    engine: EngineName = "auto"


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
        self._engine_name = settings.engine
        self._frames_seen = 0
        self.counts: dict[CountKey, int] = {}
        chosen = _chosen(database, wanted)
        self._entries = tuple(_entry(message, chosen) for message in database.messages)
        self._rules = [_rules(entry, settings) for entry in self._entries]
        self._refusals = sorted({e.refusal for e in self._entries if e.refusal})
        use_numba = settings.engine == "numba"
        self._engine: Engine = (NumbaEngine if use_numba else NumpyEngine)(self._rules)

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
        self._choose_engine(len(frames))
        grouped = self._engine.group(frames)
        if not grouped.is_good.all():
            self._account(frames, grouped, block.log_ns)
        times = _Times(block, grouped.order)
        decoded = []
        for number in (np.flatnonzero(np.diff(grouped.stops)) + 1).tolist():
            entry = self._entries[number - 1]
            columns, strange = self._engine.columns(number)
            topic = f"{self._bus}/{entry.message.topic_name}"
            one = times.block(topic, grouped.rows(number), columns, entry.units)
            if strange is not None:
                at = one.log_ns[strange]
                self._tell((*entry.message.key, NO_BRANCH), len(at), int(at[0]))
                one = one.take(~strange)
            if len(one):
                decoded.append(one)
        return decoded

    def _choose_engine(self, frames: int) -> None:
        self._frames_seen += frames
        if self._engine_name == "auto" and self._frames_seen > AUTO_FRAMES:
            self._engine_name = "numba" if has_numba() else "numpy"
            if has_numba():
                self._engine = NumbaEngine(self._rules)

    def _account(self, frames: CanFrames, grouped: Grouped, log_ns: NDArray[np.int64]) -> None:
        """Count the frames that cannot be decoded, each under the first reason that holds."""
        rows = np.flatnonzero(~grouped.is_good)
        is_unknown = (grouped.number[rows] == 0) & (frames.kind[rows] == DATA)
        self._count(frames, rows[is_unknown], [UNKNOWN_ID], None, log_ns)
        rows = rows[~is_unknown]
        if len(rows):
            reasons, which = self._reasons(frames, grouped, rows)
            self._count(frames, rows, reasons, which, log_ns)

    def _count(
        self,
        frames: CanFrames,
        rows: NDArray[np.intp],
        reasons: list[str],
        which: NDArray[np.int64] | None,
        log_ns: NDArray[np.int64],
    ) -> None:
        """Count ``rows`` by identifier and by ``which`` of the reasons; None for the first."""
        extended = frames.is_extended[rows]
        for is_extended, bits in ((False, 11), (True, 29)):
            chosen = extended if is_extended else ~extended
            if not chosen.any():
                continue
            mine = rows[chosen]
            key = frames.arbitration_id[mine].astype(np.int64)
            if which is not None:
                key += which[chosen] << bits
            for value, count in _tally(key):
                whose: CountKey = (
                    value & ((1 << bits) - 1),
                    is_extended,
                    reasons[value >> bits],
                )
                if whose in self.counts:
                    self._add(whose, count)
                else:
                    first = mine[np.argmax(key == value)]
                    self._tell(whose, count, int(log_ns[first]))

    def _reasons(
        self, frames: CanFrames, grouped: Grouped, rows: NDArray[np.intp]
    ) -> tuple[list[str], NDArray[np.int64]]:
        """All reasons, and the number of the one that holds for each of ``rows``."""
        reasons = [ERROR_FRAME, REMOTE_FRAME, UNKNOWN_ID, WRONG_FORMAT, TOO_SHORT, TOO_LONG]
        refused = np.zeros(len(self._entries) + 1, dtype=np.int64)
        for number, entry in enumerate(self._entries, start=1):
            if entry.refusal:
                refused[number] = len(reasons) + self._refusals.index(entry.refusal)
        longest = np.array([(-1, -1), *(rule.longest for rule in self._rules)], dtype=np.int16)
        shortest = np.array([0, *(m.message.length for m in self._rules)])
        number, kind = grouped.number[rows], frames.kind[rows]
        carried = np.minimum(frames.length[rows], frames.data.shape[1])
        which = np.select(
            [
                kind == ERROR,
                kind == REMOTE,
                number == 0,
                refused[number] > 0,
                frames.is_fd[rows] & (longest[number, 1] < 0),
                carried < shortest[number],
            ],
            [np.int64(0), np.int64(1), np.int64(2), refused[number], np.int64(3), np.int64(4)],
            np.int64(5),
        )
        return reasons + self._refusals, which

    def _add(self, key: CountKey, count: int) -> None:
        self.counts[key] += count
        self._ledger.topic(self._bus).skipped[key[2]] += count

    def _tell(self, key: CountKey, count: int, t_ns: int) -> None:
        """Count frames; only the first of a kind leave a detail, or a busy bus would fill all."""
        if key in self.counts:
            self._add(key, count)
            return
        detail = f"{spell_id(*key[:2])}, first of them"
        if len(self.counts) >= COUNTS_KEPT:
            key = (*OTHERS, key[2])
        self.counts[key] = self.counts.get(key, 0) + count
        self._ledger.skip(self._bus, key[2], count, detail, t_ns)


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


def _tally(key: NDArray[np.int64]) -> list[tuple[int, int]]:
    """Distinct values and how often each occurs."""
    if not len(key):
        return []
    if key.max() < _FEW_KEYS:  # many times as fast as sorting, and buses have few identifiers
        counts = np.bincount(key)
        values = np.flatnonzero(counts)
        return list(zip(values.tolist(), counts[values].tolist(), strict=True))
    values, counts = np.unique(key, return_counts=True)
    return list(zip(values.tolist(), counts.tolist(), strict=True))


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


def _rules(entry: _Entry, settings: DecodeSettings) -> Rules:
    message = entry.message
    if entry.extractor is None:
        return Rules(message, None, (-1, -1))
    if settings.allow_longer:
        classic = flexible = LENGTH_UNKNOWN
    else:
        classic, flexible = message.longest_frame(False), message.longest_frame(True)
    return Rules(message, entry.extractor, (classic, -1 if message.is_fd is False else flexible))


def _dtypes(extractor: Extractor) -> dict[str, np.dtype[np.generic]]:
    columns: dict[str, np.dtype[np.generic]] = {}
    for signal in extractor.signals:
        kind = signal.arithmetic
        is_integer = kind in (Arithmetic.INT64, Arithmetic.UINT64)
        columns[signal.name] = np.dtype(kind.value if is_integer else np.float64)
        if is_integer and signal.may_be_absent:
            columns[signal.name + PRESENT_SUFFIX] = np.dtype(np.bool_)
    return columns
