"""Group frames and extract their signals with loops that Numba compiles.

Loading the compiled loops takes as long as decoding about 16 million frames with NumPy.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.columns import CanFrames

from . import kernels
from .extract import Column, Words, flip_and_bias, is_short_integer
from .grouping import (
    STANDARD_IDS,
    Columns,
    Grouped,
    MessageRules,
    RuleArrays,
    Strange,
    payload_words,
)
from .layout import Arithmetic, CanSignal


class NumbaEngine:
    """Engine of compiled loops; messages with multiplexers still use their extractors."""

    def __init__(self, rules: Sequence[MessageRules]) -> None:
        """Prepare the tables; rules without an extractor must be last."""
        self._rules = rules
        self._tables = RuleArrays.of(rules)
        simple = [_simple_signals(rule) for rule in rules]
        self._simple = [_Simple.of(signals) for signals in simple]
        self._plan = _Plan.of([[], *simple])
        self._grouped: Grouped | None = None
        self._words: Words = np.zeros((0, 1), dtype=np.uint64)
        self._values: NDArray[np.float64] = np.zeros(0)
        self._base: NDArray[np.intp] = np.zeros(0, dtype=np.intp)

    def group(self, frames: CanFrames) -> Grouped:
        """Look up, check and sort frames, and extract all signals."""
        n, tables = len(frames), self._tables
        number = np.empty(n, dtype=np.uint16)
        is_good = np.empty(n, dtype=np.bool_)
        counts, seen = np.zeros((2, len(self._rules) + 1), dtype=np.intp)
        unknown = np.zeros(STANDARD_IDS + 1, dtype=np.intp)
        good_rows = np.empty(n, dtype=np.intp)
        kernels.look_up(
            _plain(frames.arbitration_id),
            _plain(frames.is_extended),
            _plain(frames.kind),
            _plain(frames.length),
            _plain(frames.is_fd),
            tables.standard,
            tables.extended_ids,
            tables.extended_numbers,
            tables.fits[frames.data.shape[1]],
            number,
            is_good,
            counts,
            seen,
            unknown,
            good_rows,
        )
        stops = np.cumsum(counts)
        words, n = _plain(payload_words(frames)), int(stops[-1])
        order = np.empty(n, dtype=np.intp)
        little = np.empty((words.shape[1], n), dtype=np.uint64)
        kernels.put_in_order(number, good_rows[:n], stops - counts, words, order, little)
        self._extract_signals(little, counts, stops)
        self._words = little.T
        self._grouped = Grouped(number, is_good, order, stops, seen, unknown[:STANDARD_IDS])
        return self._grouped

    def _extract_signals(
        self, little: NDArray[np.uint64], counts: NDArray[np.intp], stops: NDArray[np.intp]
    ) -> None:
        sizes = counts * np.diff(self._plan.first)
        self._base = np.cumsum(sizes) - sizes
        self._values = np.empty(int(sizes.sum()), dtype=np.float64)
        plan = self._plan
        kernels.extract_signals(
            little,
            stops,
            counts,
            self._base,
            plan.first,
            plan.is_big,
            plan.word,
            plan.bit,
            plan.length,
            plan.kind,
            plan.flip,
            plan.bias,
            plan.scale,
            plan.offset,
            plan.whole_scale,
            plan.whole_offset,
            self._values,
            self._values.view(np.uint64),
        )

    def columns(self, number: int) -> tuple[Columns, Strange]:
        """Return the columns of one message of the last group of frames."""
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
    """A message that the compiled loops decode.

    Attributes:
        names: Names of its columns.
        whole: Dtypes of its integer columns.
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
    """All signals of all messages as arrays with one element per signal.

    Attributes:
        first: Shape (M + 2,): index of each message's first signal, and the end of the last.
        is_big: True for big endian.
        word: Index of the word that holds the first bit.
        bit: First bit within the word, counted in the signal's direction.
        length: Number of bits.
        kind: Conversion, one of the constants in ``kernels``.
        flip: Bits to flip in a short integer, see ``extract.flip_and_bias``.
        bias: Bias to subtract from a short integer.
        scale: Physical units per raw step.
        offset: Physical value of raw zero.
        whole_scale: Scale modulo 2**64, for integers.
        whole_offset: Offset modulo 2**64, for integers.
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


def _plain(column: Column) -> Column:
    """Return a contiguous, writable column, because Numba recompiles for other kinds of array."""
    return np.require(column, requirements=("C", "W"))


def _simple_signals(rule: MessageRules) -> Sequence[CanSignal]:
    """Return the signals to extract with compiled loops; none if the extractor must be used."""
    extractor = rule.extractor
    if extractor is None or extractor.is_multiplexed:
        return []
    return extractor.signals if all(_kind(s) is not None for s in extractor.signals) else []


def _kind(signal: CanSignal) -> int | None:
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
