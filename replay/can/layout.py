"""CAN messages, their signals and bit layouts, independent of the format of the database.

Bits are counted as in DBC files. A little-endian signal starts at its least significant bit, bit
``8 * byte + bit_in_byte``. A big-endian signal starts at its most significant bit, with the same
numbering, and runs down to bit 0 of a byte and on to bit 7 of the next.
"""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import Final

EXACT_IN_FLOAT64: Final = 2**53
_FD_LENGTHS: Final = (12, 16, 20, 24, 32, 48, 64)


class Arithmetic(Enum):
    """Arithmetic that converts raw bits to a physical value without losing digits.

    * ``FLOAT``: float64; every possible value is exact, or the scale is a fraction.
    * ``INT64``, ``UINT64``: integers that may exceed 2**53 and fit the type.
    * ``BIG``: integers whose computation exceeds 64 bits; the column holds the nearest float64.
    """

    FLOAT = "float64"
    INT64 = "int64"
    UINT64 = "uint64"
    BIG = "float64 of big integers"


@dataclass(frozen=True, slots=True)
class CanSignal:
    """One signal of a message: ``value = raw * scale + offset``.

    Attributes:
        name: Name as spelled in the database.
        start: First bit, counted as described at the head of this module.
        length: Number of bits, 1 to 64.
        is_big_endian: True for Motorola byte order.
        is_signed: True for two's complement.
        is_float: True if the bits are an IEEE 754 number of 16, 32 or 64 bits.
        scale: Physical units per raw step; an int if the file contains an integer.
        offset: Physical value of raw zero; an int if the file contains an integer.
        unit: Unit as spelled in the database; empty if unspecified.
        minimum: Smallest meaningful physical value as declared, or None. Not enforced.
        maximum: Largest meaningful physical value as declared, or None. Not enforced.
        choices: Names by raw value.
        is_multiplexer: True if its value selects other signals.
        multiplexer: Name of the signal that selects this one; None if it is always present.
        branches: Multiplexer values that select it; empty without a multiplexer.
    """

    name: str
    start: int
    length: int
    is_big_endian: bool = False
    is_signed: bool = False
    is_float: bool = False
    scale: float = 1
    offset: float = 0
    unit: str = ""
    minimum: float | None = None
    maximum: float | None = None
    choices: Mapping[int, str] = field(default_factory=dict, hash=False)
    is_multiplexer: bool = False
    multiplexer: str | None = None
    branches: frozenset[int] = frozenset()

    @property
    def first_bit(self) -> int:
        """The start, counted in the signal's direction.

        Little endian: position of the least significant bit, counted upwards from the lowest bit of
        byte 0. Big endian: position of the most significant bit, counted downwards from the highest
        bit of byte 0.
        """
        if self.is_big_endian:
            return 8 * (self.start // 8) + 7 - self.start % 8
        return self.start

    @property
    def end_bit(self) -> int:
        """One past the last bit, counted like ``first_bit``."""
        return self.first_bit + self.length

    @property
    def raw_range(self) -> tuple[int, int]:
        """Smallest and largest raw integer; meaningless for floats."""
        if self.is_signed:
            return -(1 << (self.length - 1)), (1 << (self.length - 1)) - 1
        return 0, (1 << self.length) - 1

    @property
    def arithmetic(self) -> Arithmetic:
        """Arithmetic of its values, which determines the column's dtype."""
        if self.is_float or not is_integer(self.scale):
            return Arithmetic.FLOAT
        if self.length <= 32 and abs(self.scale) <= 2**20 and abs(self.offset) <= 2**52:
            return Arithmetic.FLOAT  # a shortcut for nearly all signals
        products = [raw * int(self.scale) for raw in self.raw_range]
        if not is_integer(self.offset):
            small = _largest([*self.raw_range, *products]) <= EXACT_IN_FLOAT64
            return Arithmetic.FLOAT if small else Arithmetic.BIG
        values = [product + int(self.offset) for product in products]
        if _largest([*self.raw_range, *products, *values]) <= EXACT_IN_FLOAT64:
            return Arithmetic.FLOAT
        if min(values) >= -(2**63) and max(values) < 2**63:
            return Arithmetic.INT64
        if min(values) >= 0 and max(values) < 2**64:
            return Arithmetic.UINT64
        return Arithmetic.BIG


@dataclass(frozen=True, slots=True)
class CanMessage:
    """One message of a database.

    Attributes:
        name: Name as spelled in the database; not always unique.
        arbitration_id: Identifier of 11 or 29 bits.
        is_extended: True for a 29-bit identifier. The same number of 11 bits is another message.
        length: Number of payload bytes.
        signals: Signals in the database's order. Signals from the cache of layouts are read on
            first use, because a bus carries few of a large database's messages.
        is_fd: True for a CAN FD frame, or None where the database does not specify it.
        topic: Topic of its decoded rows: ``name``, or ``name_0xID`` where several messages have
            the same name.
        problem: Reason why its frames cannot be decoded, or empty.
        source: File and line that define it.
    """

    name: str
    arbitration_id: int
    is_extended: bool
    length: int
    signals: Sequence[CanSignal]
    is_fd: bool | None = None
    topic: str = ""
    problem: str = ""
    source: str = ""

    @property
    def key(self) -> tuple[int, bool]:
        """Identifier, and whether it is extended."""
        return self.arbitration_id, self.is_extended

    @property
    def topic_name(self) -> str:
        """``topic``, or the name if the topic is empty."""
        return self.topic or self.name

    def signal(self, name: str) -> CanSignal:
        """Return the signal named ``name``.

        Raises:
            ValueError: It does not exist; the message lists the existing signals.
        """
        for signal in self.signals:
            if signal.name == name:
                return signal
        there = ", ".join(signal.name for signal in self.signals)
        raise ValueError(f"{self.name} has no signal {name!r}; there are: {there}")

    def longest_frame(self, is_fd: bool) -> int:
        """Return the max payload bytes of a frame that carries it.

        CAN FD frames have only certain lengths, so a message of 10 bytes is sent in 12.
        """
        if not is_fd or self.length <= 8:
            return self.length
        return next((n for n in _FD_LENGTHS if n >= self.length), self.length)


def is_integer(number: float) -> bool:
    """Return whether a number is an integer, regardless of its type."""
    return isinstance(number, int) or number.is_integer()


def layout_problem(message: CanMessage) -> str:
    """Return the reason why no frame of ``message`` can be decoded, or an empty string."""
    if not message.signals:
        return "message has no signals"
    twice = [name for name, n in Counter(s.name for s in message.signals).items() if n > 1]
    if twice:
        return f"message names a signal twice: {twice[0]}"
    for signal in message.signals:
        if not 1 <= signal.length <= 64:
            return f"signal {signal.name} has {signal.length} bits; expected 1 to 64"
        if signal.is_float and signal.length not in (16, 32, 64):
            return f"signal {signal.name} is a float of {signal.length} bits"
        if signal.start < 0 or signal.end_bit > 8 * message.length:
            return f"signal {signal.name} does not fit into {message.length} bytes"
    return _multiplexing_problem(message)


def _multiplexing_problem(message: CanMessage) -> str:
    by_name = {signal.name: signal for signal in message.signals}
    for signal in message.signals:
        seen = {signal.name}
        above = signal.multiplexer
        while above is not None:
            if above not in by_name or not by_name[above].is_multiplexer:
                return f"signal {signal.name} depends on {above}, which is not a multiplexer"
            if above in seen:
                return f"multiplexers depend on each other in a cycle: {above}"
            seen.add(above)
            above = by_name[above].multiplexer
    return ""


def overlapping_signals(message: CanMessage) -> Iterator[tuple[str, str]]:
    """Yield pairs of signals that share a bit although both can occur in one frame."""
    owner: dict[int, list[CanSignal]] = {}
    reported: set[tuple[str, str]] = set()
    for signal in message.signals:
        for bit in range(signal.first_bit, signal.end_bit):
            place = bit if not signal.is_big_endian else 8 * (bit // 8) + 7 - bit % 8
            for other in owner.setdefault(place, []):
                pair = (other.name, signal.name)
                if pair not in reported and _can_meet(message, other, signal):
                    reported.add(pair)
                    yield pair
            owner[place].append(signal)


def _can_meet(message: CanMessage, a: CanSignal, b: CanSignal) -> bool:
    """Return whether the multiplexers allow both signals in one frame."""
    needs_a, needs_b = _needs(message, a), _needs(message, b)
    return all(needs_a[name] & needs_b[name] for name in needs_a.keys() & needs_b.keys())


def _needs(message: CanMessage, signal: CanSignal) -> dict[str, frozenset[int]]:
    needs: dict[str, frozenset[int]] = {}
    while signal.multiplexer is not None:
        needs[signal.multiplexer] = signal.branches
        signal = message.signal(signal.multiplexer)
    return needs


def _largest(numbers: list[int]) -> int:
    return max(abs(number) for number in numbers)
