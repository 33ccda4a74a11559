"""Extract the signals of many payloads at once into columns, with NumPy.

A payload is read as 64-bit words: word ``k`` holds bytes ``8 k`` to ``8 k + 7`` as one number in
the signal's byte order. A signal is in one word or spans two consecutive words. Signals with the
same word, byte order and kind are extracted together as one array of shape (signals, rows),
because a call into NumPy costs more than the work on a few hundred rows.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import groupby
from typing import Any, Final, NamedTuple, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from .layout import Arithmetic, CanMessage, CanSignal, is_integer

# Shape (N, W / 8): payloads as little-endian words.
Words: TypeAlias = NDArray[np.uint64]
Column: TypeAlias = NDArray[Any]
Number = TypeVar("Number", np.uint64, np.float64)

# Suffix of the companion column of a signal that may be absent and cannot be NaN.
PRESENT_SUFFIX: Final = "_is_present"

# Number of bits in the fraction of a float64.
SHORT_BITS: Final = 52
# Sign and exponent of the float64 2**52 + n, where n are the 52 bits below. This converts integers
# without a loop.
EXPONENT: Final = 0x4330_0000_0000_0000

_FLOATS: Final = {16: (np.uint16, np.float16), 32: (np.uint32, np.float32)}


class _Place(NamedTuple):
    """Common properties of the signals that are extracted together."""

    is_big_endian: bool
    word: int
    is_split: bool
    is_short: bool
    is_signed: bool
    is_float: bool
    is_plain: bool
    float_bits: int
    arithmetic: str


def _place(signal: CanSignal) -> _Place:
    word, bit = divmod(signal.first_bit, 64)
    arithmetic = signal.arithmetic
    is_exact = arithmetic is Arithmetic.FLOAT and not signal.is_float
    is_short = is_exact and signal.length <= SHORT_BITS
    return _Place(
        signal.is_big_endian,
        word,
        bit + signal.length > 64,
        is_short,
        signal.is_signed and not signal.is_float and not is_short,
        signal.is_float,
        signal.is_float and signal.scale == 1 and signal.offset == 0,
        signal.length if signal.is_float else 0,
        arithmetic.name,
    )


class _SignalGroup:
    """Signals with one ``_Place``, with their shifts as columns of shape (S, 1)."""

    def __init__(self, place: _Place, signals: list[CanSignal]) -> None:
        self.place = place
        self.signals = signals
        self.names = tuple(s.name for s in signals)
        turns = [flip_and_bias(s) for s in signals]
        bit = _column([s.first_bit % 64 for s in signals], np.uint64)
        length = _column([s.length for s in signals], np.uint64)
        self._flip = _column([flip for flip, _ in turns], np.uint64)
        self._drop = np.uint64(64) - length
        # A left shift drops the bits above the signal; the right shift that follows drops the bits
        # below it and extends the sign.
        self._left = bit if place.is_big_endian else np.uint64(64) - (bit + length)
        self._taken = np.uint64(64) - bit  # bits of a split signal in its first word
        self._is_below_64 = all(s.length < 64 for s in signals)
        self._bias = _column([bias for _, bias in turns], np.float64)
        scales, offsets = [s.scale for s in signals], [s.offset for s in signals]
        is_linear_float = place.is_float and not place.is_plain  # -0.0 + 0 is 0.0
        self._scale = _column(scales, np.float64) if any(x != 1 for x in scales) else None
        is_moved = any(offsets) or is_linear_float
        self._offset = _column(offsets, np.float64) if is_moved else None

    def __call__(self, words: Words) -> Column:
        """Return physical values, shape (S, N)."""
        raw = self._split(words) if self.place.is_split else self._whole(words)
        if self.place.is_short:
            raw ^= self._flip
            values = raw.view(np.float64)
            values -= self._bias
            return self._scaled(values)
        if self.place.is_float:
            with np.errstate(all="ignore"):  # the bits may be any number
                return self._scaled(_as_float(raw, self.place.float_bits))
        if self.place.arithmetic == Arithmetic.FLOAT.name:
            return self._scaled(raw.astype(np.float64))
        if self.place.arithmetic == Arithmetic.BIG.name:
            return _big(raw, self.signals)
        return self._scaled_integers(raw)

    def _word(self, words: Words, k: int) -> Words:
        word = words[:, k]
        return word.byteswap() if self.place.is_big_endian else word

    def _whole(self, words: Words) -> Column:
        raw = self._word(words, self.place.word) << self._left
        if self.place.is_signed:
            return np.right_shift(raw.view(np.int64), self._drop.view(np.int64))
        raw >>= self._drop
        # Conversion from int64 is faster; without the top bit both types hold the same value.
        return raw.view(np.int64) if self._is_below_64 and not self.place.is_short else raw

    def _split(self, words: Words) -> Column:
        first = self._word(words, self.place.word)
        second = self._word(words, self.place.word + 1)
        if self.place.is_big_endian:
            raw = (first << (np.uint64(64) - self._taken)) | (second >> self._taken)
        else:
            raw = (first >> (np.uint64(64) - self._taken)) | (second << self._taken)
            raw = raw << self._drop
        if self.place.is_signed:
            return np.right_shift(raw.view(np.int64), self._drop.view(np.int64))
        return raw >> self._drop

    def _scaled(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        if self._scale is not None:
            values *= self._scale
        if self._offset is not None:
            values += self._offset
        return values

    def _scaled_integers(self, raw: Column) -> Column:
        # Sums and products modulo 2**64 are exact because the result fits.
        values: Column = raw.view(np.uint64).copy()
        values *= _modulo([int(s.scale) for s in self.signals])
        values += _modulo([int(s.offset) for s in self.signals])
        return values.view(np.int64) if self.place.arithmetic == Arithmetic.INT64.name else values


def flip_and_bias(signal: CanSignal) -> tuple[int, float]:
    """Return the constants that convert the raw bits of a short integer to float64.

    Returns:
        Bits to flip in the raw number, and the bias to subtract from the result read as float64.
        The sign bit is flipped, so that two's complement becomes a count from the lowest number.
    """
    lowest = signal.raw_range[0]
    return EXPONENT | -lowest, float(2**SHORT_BITS - lowest)


def _column(numbers: Sequence[float], kind: type[Number]) -> NDArray[Number]:
    """Return numbers as an array of shape (S, 1)."""
    return np.array(numbers, dtype=kind)[:, None]


def _modulo(numbers: list[int]) -> NDArray[np.uint64]:
    return np.array([x % 2**64 for x in numbers], dtype=np.uint64)[:, None]


def _as_float(raw: Column, bits: int) -> NDArray[np.float64]:
    if bits == 64:
        return raw.view(np.float64).copy()
    whole, real = _FLOATS[bits]
    return raw.astype(whole).view(real).astype(np.float64)


def _big(raw: Column, signals: list[CanSignal]) -> NDArray[np.float64]:
    """Convert each value with Python's unbounded integers, which is exact and rarely needed."""
    rows = [
        [float(value * _plain(s.scale) + _plain(s.offset)) for value in row.tolist()]
        for s, row in zip(signals, raw, strict=True)
    ]
    return np.array(rows, dtype=np.float64).reshape(raw.shape)


def _plain(number: float) -> float:
    return int(number) if is_integer(number) else number


class _Flat:
    """Signals that are present in every row."""

    def __init__(self, signals: Iterable[CanSignal]) -> None:
        ordered = sorted(((_place(s), s) for s in signals), key=lambda pair: pair[0])
        self._parts = [
            _SignalGroup(place, [s for _, s in pairs])
            for place, pairs in groupby(ordered, key=lambda pair: pair[0])
        ]
        self.is_in_order = len(self._parts) == 1

    def __call__(self, words: Words) -> dict[str, Column]:
        """Return values by signal name, shape (N,)."""
        if len(self._parts) == 1:
            return dict(zip(self._parts[0].names, self._parts[0](words), strict=True))
        columns: dict[str, Column] = {}
        for part in self._parts:
            columns.update(zip(part.names, part(words), strict=True))
        return columns


@dataclass(frozen=True, slots=True)
class _Switch:
    """A multiplexer, its known values, and by values the signals that they select."""

    name: str
    known: tuple[int, ...]
    branches: tuple[tuple[tuple[int, ...], _Node], ...]


@dataclass(frozen=True, slots=True)
class _Node:
    """Signals that occur together, and the multiplexers among them."""

    flat: _Flat
    switches: tuple[_Switch, ...]


class MessageExtractor:
    """Extractor of some signals of one message from payloads into columns.

    A signal that a row's multiplexers do not select is NaN there. An int64 or uint64 column holds 0
    there, and a companion bool column ``SIGNAL_is_present`` marks the rows with real values.
    """

    def __init__(self, message: CanMessage, wanted: Collection[str] | None = None) -> None:
        """Plan the extraction.

        Args:
            message: A message without ``problem``.
            wanted: Names of the signals to extract, or None for all.
        """
        self.message = message
        self._wanted = None if wanted is None else frozenset(wanted)

    # The properties below are computed at the first frame: a bus carries few of a large database's
    # messages, and the signals of the others need not be read.

    @cached_property
    def signals(self) -> tuple[CanSignal, ...]:
        """Signals to extract, in the database's order."""
        wanted = self._wanted
        return tuple(s for s in self.message.signals if wanted is None or s.name in wanted)

    @cached_property
    def units(self) -> dict[str, str]:
        """Units by signal name, for the signals that have one."""
        return {s.name: s.unit for s in self.signals if s.unit}

    @cached_property
    def is_multiplexed(self) -> bool:
        """True if any signal selects others."""
        return any(switches_on(self.message, s) for s in self.message.signals)

    def __call__(self, words: Words) -> tuple[dict[str, Column], NDArray[np.bool_] | None]:
        """Decode N payloads.

        Args:
            words: Shape (N, W / 8), with at least as many bytes as the message.

        Returns:
            Columns of length N in the database's order, and a mask of the rows with a multiplexer
            value without a branch, whose values are meaningless. The mask is None if there are no
            such rows.
        """
        if not self.is_multiplexed:
            columns = self._root.flat(words)
            if self._wanted is None and self._root.flat.is_in_order:
                return columns, None
            return {s.name: columns[s.name] for s in self.signals}, None
        filled = {s.name: _Filled(s, len(words)) for s in self.signals}
        strange = np.zeros(len(words), dtype=np.bool_)
        _descend(self._root, words, np.arange(len(words)), filled, strange)
        columns = {}
        for name, column in filled.items():
            columns[name] = column.values
            if column.present is not None:
                columns[name + PRESENT_SUFFIX] = column.present
        return columns, strange if strange.any() else None

    @cached_property
    def _root(self) -> _Node:
        wanted = self._wanted
        signals = self.message.signals
        needed = [s for s in signals if wanted is None or s.name in wanted or s.is_multiplexer]
        return _node(self.message, [s for s in needed if s.multiplexer is None], needed)


class _Filled:
    """A column of a multiplexed message, filled branch by branch."""

    def __init__(self, signal: CanSignal, n: int) -> None:
        arithmetic = signal.arithmetic
        is_integer = arithmetic in (Arithmetic.INT64, Arithmetic.UINT64)
        self.values: Column = (
            np.zeros(n, dtype=arithmetic.value) if is_integer else np.full(n, np.nan)
        )
        needs_companion = is_integer and signal.multiplexer is not None
        self.present = np.zeros(n, dtype=np.bool_) if needs_companion else None

    def put(self, rows: NDArray[np.intp], values: Column) -> None:
        self.values[rows] = values
        if self.present is not None:
            self.present[rows] = True


def _descend(
    node: _Node,
    words: Words,
    rows: NDArray[np.intp],
    filled: dict[str, _Filled],
    strange: NDArray[np.bool_],
) -> None:
    columns = node.flat(words[rows])
    for name, values in columns.items():
        if name in filled:
            filled[name].put(rows, values)
    for switch in node.switches:
        selector = columns[switch.name]
        strange[rows[~is_one_of(selector, switch.known)]] = True
        for chosen, below in switch.branches:
            there = rows[is_one_of(selector, chosen)]
            if len(there):
                _descend(below, words, there, filled, strange)


def is_one_of(selector: Column, values: tuple[int, ...]) -> NDArray[np.bool_]:
    """Return a mask of the rows whose multiplexer has one of ``values``, shape (N,)."""
    if selector.dtype == np.float64:
        return np.isin(np.trunc(selector), np.array(values, dtype=np.float64))
    limits = np.iinfo(selector.dtype)
    fitting = [v for v in values if limits.min <= v <= limits.max]
    return np.isin(selector, np.array(fitting, dtype=selector.dtype))


def known_values(message: CanMessage, multiplexer: CanSignal) -> frozenset[int]:
    """Return the values that have a branch: those of its signals, and those with a name."""
    values = set(multiplexer.choices)
    for signal in message.signals:
        if signal.multiplexer == multiplexer.name:
            values |= signal.branches
    return frozenset(values)


def switches_on(message: CanMessage, signal: CanSignal) -> bool:
    """Return whether ``signal`` is a multiplexer that selects at least one signal."""
    return signal.is_multiplexer and bool(known_values(message, signal))


def _node(message: CanMessage, here: list[CanSignal], needed: list[CanSignal]) -> _Node:
    switches = []
    for multiplexer in here:
        if not switches_on(message, multiplexer):
            continue
        below: dict[frozenset[int], list[CanSignal]] = {}
        for signal in needed:
            if signal.multiplexer == multiplexer.name:
                below.setdefault(signal.branches, []).append(signal)
        branches = [
            (tuple(sorted(values)), _node(message, signals, needed))
            for values, signals in below.items()
        ]
        known = tuple(sorted(known_values(message, multiplexer)))
        switches.append(_Switch(multiplexer.name, known, tuple(branches)))
    return _Node(_Flat(here), tuple(switches))
