"""Two ways to group a block's frames by message and take their signals out, with equal results.

NumPy needs nothing and is the faster one for short logs, since loading Numba takes as long as
decoding some million frames. Numba does the same in compiled loops.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Final, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.columns import DATA, LENGTH_UNKNOWN, CanFrames

from .extract import Column, Extractor, Words, flip_and_bias, is_short_integer
from .layout import Arithmetic, CanMessage, CanSignal

STANDARD_IDS: Final = 2048

Columns: TypeAlias = dict[str, Column]
Strange: TypeAlias = NDArray[np.bool_] | None


@dataclass(frozen=True, slots=True)
class Rules:
    """What the frames of one message must look like.

    Attributes:
        message: The message.
        extractor: Takes its signals out, or None if it is not decoded.
        longest: Most bytes of a classic and of an FD frame; -1 where none fits.
    """

    message: CanMessage
    extractor: Extractor | None
    longest: tuple[int, int]


@dataclass(frozen=True, slots=True)
class Tables:
    """The rules of all messages as arrays; message number 0 stands for none.

    Attributes:
        standard: Shape (2049,): message number of each 11-bit identifier; the last place is for
            whatever is larger.
        extended_ids: Sorted 29-bit identifiers.
        extended_numbers: Their message numbers.
        fits: From the width of the payload array to shape (2, M + 1, 256): whether a frame, classic
            or FD, of this message and length can be decoded.
    """

    standard: NDArray[np.uint16]
    extended_ids: NDArray[np.uint32]
    extended_numbers: NDArray[np.uint16]
    fits: dict[int, NDArray[np.bool_]]

    @classmethod
    def of(cls, rules: Sequence[Rules]) -> Tables:
        """Build the tables; messages are numbered from 1."""
        standard = np.zeros(STANDARD_IDS + 1, dtype=np.uint16)
        fits = {width: np.zeros((2, len(rules) + 1, 256), dtype=np.bool_) for width in (8, 64)}
        extended = []
        for number, rule in enumerate(rules, start=1):
            if rule.message.is_extended:
                extended.append((rule.message.arbitration_id, number))
            else:
                standard[rule.message.arbitration_id] = number
            for width, table in fits.items():
                if rule.extractor is not None and rule.message.length <= width:
                    table[:, number] = _fitting_lengths(rule)
        extended.sort()
        ids = np.array([i for i, _ in extended], dtype=np.uint32)
        numbers = np.array([n for _, n in extended], dtype=np.uint16)
        return cls(standard, ids, numbers, fits)


def _fitting_lengths(rule: Rules) -> NDArray[np.bool_]:
    length, longest = np.arange(256), np.array(rule.longest)[:, None]
    fits = (length >= rule.message.length) & (length <= longest)
    # Where the log keeps no lengths there is nothing to hold against the database.
    fits[:, LENGTH_UNKNOWN] |= longest[:, 0] >= 0
    return fits


@dataclass(frozen=True, slots=True)
class Grouped:
    """The frames of a block, put in order of their messages.

    Attributes:
        number: Shape (N,): number of each frame's message, 0 for none.
        is_good: Shape (N,): the frame can be decoded.
        order: Shape (G,): the G good frames: those of message 1, then of message 2, ...
        stops: Shape (M + 1,): where each message ends in ``order``; 0 for message 0.
        seen: Shape (M + 1,): data frames of each message, good or not.
        unknown: Shape (2048,): data frames of no message, by their 11-bit identifier.
    """

    number: NDArray[np.uint16]
    is_good: NDArray[np.bool_]
    order: NDArray[np.intp]
    stops: NDArray[np.intp]
    seen: NDArray[np.intp]
    unknown: NDArray[np.intp]

    def rows(self, number: int) -> slice:
        """Where a message's frames are in ``order``."""
        return slice(int(self.stops[number - 1]), int(self.stops[number]))


class Engine(Protocol):
    """Groups frames and gives the columns of each group."""

    def group(self, frames: CanFrames) -> Grouped:
        """Look up, check and sort frames."""
        ...

    def columns(self, number: int) -> tuple[Columns, Strange]:
        """Columns of one message of the frames grouped last, as ``Extractor`` gives them."""
        ...


class NumpyEngine:
    """Whole arrays at a time."""

    def __init__(self, rules: Sequence[Rules]) -> None:
        """Prepare the tables; rules without an extractor come last."""
        self._rules = rules
        self._decodable = sum(rule.extractor is not None for rule in rules)
        self._tables = Tables.of(rules)
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
        self._words = words_of(frames).take(order, axis=0)
        unknown = is_data & (number == 0) & ~frames.is_extended
        by_id = np.bincount(
            np.minimum(frames.arbitration_id[unknown], STANDARD_IDS), minlength=STANDARD_IDS
        )
        self._grouped = Grouped(number, is_good, order, stops, seen, by_id[:STANDARD_IDS])
        return self._grouped

    def _sort(self, number: NDArray[np.uint16]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """All frames in order of ``number``, and where each number ends."""
        order = np.argsort(number, kind="stable")  # a radix sort on 16 bits
        return order, np.searchsorted(number[order], self._numbers, side="right")

    def _all_fit(self, frames: CanFrames, order: NDArray[np.intp], stops: NDArray[np.intp]) -> bool:
        """Whether every frame of a decodable message fits: the usual case, told from extremes."""
        if frames.kind.any() or frames.is_fd.any():
            return False
        ends = stops[: self._decodable + 1]
        groups = np.flatnonzero(np.diff(ends))
        if not len(groups):
            return True
        lengths = frames.length[order[: ends[-1]]]
        least = np.minimum.reduceat(lengths, ends[groups])
        most = np.maximum.reduceat(lengths, ends[groups])
        fits = self._tables.fits[frames.data.shape[1]][0, groups + 1]
        at = np.arange(len(groups))
        # Between two fitting lengths all fit, but for the number that stands for "unknown".
        in_one_piece = (most < LENGTH_UNKNOWN) | (least == LENGTH_UNKNOWN)
        return bool((fits[at, least] & fits[at, most] & in_one_piece).all())

    def columns(self, number: int) -> tuple[Columns, Strange]:
        """Columns of one message of the frames grouped last."""
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


class NumbaEngine:
    """Compiled loops; messages with multiplexers go through their extractors all the same."""

    def __init__(self, rules: Sequence[Rules]) -> None:
        from .kernels import compiled

        self._kernels = compiled()
        self._rules = rules
        self._tables = Tables.of(rules)
        simple = [_simple_signals(rule) for rule in rules]
        self._simple = [_Simple.of(signals) for signals in simple]
        self._plan = _Plan.of([[], *simple])
        self._grouped: Grouped | None = None
        self._words: Words = np.zeros((0, 1), dtype=np.uint64)
        self._values: NDArray[np.float64] = np.zeros(0)
        self._base: NDArray[np.intp] = np.zeros(0, dtype=np.intp)

    def group(self, frames: CanFrames) -> Grouped:
        """Look up, check and sort frames, and take out all signals."""
        n, tables = len(frames), self._tables
        number = np.empty(n, dtype=np.uint16)
        is_good = np.empty(n, dtype=np.bool_)
        counts, seen = np.zeros((2, len(self._rules) + 1), dtype=np.intp)
        unknown = np.zeros(STANDARD_IDS + 1, dtype=np.intp)
        good_rows = np.empty(n, dtype=np.intp)
        self._kernels.look_up(
            *(frames.arbitration_id, frames.is_extended, frames.kind, frames.length, frames.is_fd),
            *(tables.standard, tables.extended_ids, tables.extended_numbers),
            tables.fits[frames.data.shape[1]],
            *(number, is_good, counts, seen, unknown, good_rows),
        )
        stops = np.cumsum(counts)
        words, n = words_of(frames), int(stops[-1])
        order = np.empty(n, dtype=np.intp)
        little = np.empty((words.shape[1], n), dtype=np.uint64)
        self._kernels.put_in_order(number, good_rows[:n], stops - counts, words, order, little)
        sizes = counts * np.diff(self._plan.first)
        self._base = np.cumsum(sizes) - sizes
        self._values = np.empty(int(sizes.sum()), dtype=np.float64)
        plan = self._plan
        self._kernels.take_out(
            *(little, stops, counts, self._base, plan.first),
            *(plan.is_big, plan.word, plan.bit, plan.length, plan.kind),
            *(plan.flip, plan.bias, plan.scale, plan.offset, plan.whole_scale, plan.whole_offset),
            *(self._values, self._values.view(np.uint64)),
        )
        self._words = little.T
        self._grouped = Grouped(number, is_good, order, stops, seen, unknown[:STANDARD_IDS])
        return self._grouped

    def columns(self, number: int) -> tuple[Columns, Strange]:
        """Columns of one message of the frames grouped last."""
        assert self._grouped is not None
        rows, simple = self._grouped.rows(number), self._simple[number - 1]
        if simple is None:
            extractor = self._rules[number - 1].extractor
            assert extractor is not None
            return extractor(np.ascontiguousarray(self._words[rows]))
        n, base = rows.stop - rows.start, int(self._base[number])
        together = self._values[base : base + n * len(simple.names)].reshape(-1, n)
        columns: Columns = dict(zip(simple.names, together, strict=True))
        for name, dtype in simple.whole:
            columns[name] = columns[name].view(dtype)
        return columns, None


@dataclass(frozen=True, slots=True)
class _Simple:
    """A message that the compiled loops take out.

    Attributes:
        names: Its columns.
        whole: Those that hold whole numbers, and their types.
    """

    names: tuple[str, ...]
    whole: tuple[tuple[str, np.dtype[np.generic]], ...]

    @classmethod
    def of(cls, signals: Sequence[CanSignal]) -> _Simple | None:
        if not signals:
            return None
        kinds = {s.name: s.arithmetic for s in signals}
        whole = [
            (name, np.dtype(kind.value))
            for name, kind in kinds.items()
            if kind in (Arithmetic.INT64, Arithmetic.UINT64)
        ]
        return cls(tuple(kinds), tuple(whole))


@dataclass(frozen=True, slots=True)
class _Plan:
    """All signals of all messages as arrays, one place each.

    Attributes:
        first: Shape (M + 2,): place of each message's first signal; one place more at the end.
        is_big: Big endian.
        word: Word that holds its first bit.
        bit: That bit within the word, counted in the signal's direction.
        length: Bits.
        kind: One of the numbers in ``kernels``.
        flip: Bits to flip in a short integer, as ``extract.flip_and_bias`` says.
        bias: What to subtract then.
        scale: Units per raw step.
        offset: Value of raw zero.
        whole_scale: The scale modulo 2**64, for whole numbers.
        whole_offset: The offset likewise.
    """

    first: NDArray[np.intp]
    is_big: NDArray[np.bool_]
    word: NDArray[np.intp]
    bit: NDArray[np.uint64]
    length: NDArray[np.uint64]
    kind: NDArray[np.uint8]
    flip: NDArray[np.uint64]
    bias: NDArray[np.float64]
    scale: NDArray[np.float64]
    offset: NDArray[np.float64]
    whole_scale: NDArray[np.uint64]
    whole_offset: NDArray[np.uint64]

    @classmethod
    def of(cls, messages: Sequence[Sequence[CanSignal]]) -> _Plan:
        signals = [s for message in messages for s in message]
        sizes = [len(message) for message in messages]
        turns = [flip_and_bias(s) if is_short_integer(s) else (0, 0.0) for s in signals]
        return cls(
            first=np.cumsum([0, *sizes]).astype(np.intp),
            is_big=np.array([s.is_big_endian for s in signals], dtype=np.bool_),
            word=np.array([s.first_bit // 64 for s in signals], dtype=np.intp),
            bit=np.array([s.first_bit % 64 for s in signals], dtype=np.uint64),
            length=np.array([s.length for s in signals], dtype=np.uint64),
            kind=np.array([_kind(s) for s in signals], dtype=np.uint8),
            flip=np.array([flip for flip, _ in turns], dtype=np.uint64),
            bias=np.array([bias for _, bias in turns], dtype=np.float64),
            scale=np.array([float(s.scale) for s in signals], dtype=np.float64),
            offset=np.array([float(s.offset) for s in signals], dtype=np.float64),
            whole_scale=np.array([_modulo(s.scale) for s in signals], dtype=np.uint64),
            whole_offset=np.array([_modulo(s.offset) for s in signals], dtype=np.uint64),
        )


def words_of(frames: CanFrames) -> Words:
    """Payloads as little-endian words, shape (N, W / 8)."""
    words: Words = np.ascontiguousarray(frames.data).view("<u8").astype(np.uint64, copy=False)
    return words


def has_numba() -> bool:
    """Whether Numba is installed; it is not imported for that."""
    return find_spec("numba") is not None


def _simple_signals(rule: Rules) -> Sequence[CanSignal]:
    """The signals to take out in compiled loops; none if the extractor must do it."""
    extractor = rule.extractor
    if extractor is None or extractor.is_multiplexed:
        return []
    return extractor.signals if all(_kind(s) is not None for s in extractor.signals) else []


def _kind(signal: CanSignal) -> int | None:
    from . import kernels

    is_plain = signal.scale == 1 and signal.offset == 0
    if signal.is_float:
        kinds = {
            (32, True): kernels.SINGLE,
            (32, False): kernels.SINGLE_SCALED,
            (64, True): kernels.DOUBLE,
            (64, False): kernels.DOUBLE_SCALED,
        }
        return kinds.get((signal.length, is_plain))
    if is_short_integer(signal):
        return kernels.SHORT
    if signal.arithmetic is Arithmetic.BIG:
        return None
    if signal.arithmetic is not Arithmetic.FLOAT:
        return kernels.WHOLE_SIGNED if signal.is_signed else kernels.WHOLE_UNSIGNED
    if signal.is_signed:
        return kernels.SIGNED
    return kernels.UNSIGNED if signal.length < 64 else kernels.UNSIGNED_LONG


def _modulo(number: float) -> int:
    return int(number) % 2**64
