"""Conversion of many text fields to numbers at once, with eight characters per 64-bit word.

A field is a range of one buffer. Its characters are read as unaligned little-endian words, and
characters outside the field are replaced by ``0``. A dozen integer operations on the column of
words then check and convert all fields ("SIMD within a register", Knuth TAOCP 7.1.3). No floating
point is used, so decimal times are exact.

The buffer must have ``FRONT`` bytes before the first field and ``BACK`` bytes after the last.
"""

from typing import Final, TypeAlias

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from crosscue.replay.columns import Bytes, Int64s

Words: TypeAlias = NDArray[np.uint64]
Bools: TypeAlias = NDArray[np.bool_]

FRONT: Final = 32
BACK: Final = 256
NANOS: Final = 1_000_000_000
# Maximum time, in the year 2116. The sum of a start and an offset below it does not overflow.
TIME_MAX_NS: Final = 1 << 62
SECONDS_MAX: Final = TIME_MAX_NS // NANOS - 1
OUT_OF_RANGE: Final = "time of the year 2116 or later, which is out of range"


def within_range(start_ns: int) -> int | None:
    """Return a start time, or None if it is implausible, as damaged ones are."""
    return start_ns if abs(start_ns) <= TIME_MAX_NS else None


def _u(value: int) -> np.uint64:
    return np.uint64(value)


_ALL: Final = (1 << 64) - 1
_KEEP_LAST: Final = np.array([_ALL << 8 * (8 - k) & _ALL for k in range(9)], np.uint64)
_KEEP_FIRST: Final = np.array([(1 << 8 * k) - 1 for k in range(9)], np.uint64)
_ZEROS: Final = _u(0x3030303030303030)
_POWER: Final = np.array([10**k for k in range(10)], np.int64)


def byte_words(buffer: Bytes) -> Words:
    """Return a view of every eight consecutive bytes as a word, shape (len - 7,)."""
    words: Words = np.ndarray((len(buffer) - 7,), np.dtype("<u8"), buffer.data, strides=(1,))
    return words


def _decimal8(word: Words) -> tuple[Words, Bools]:
    high = _u(0xF0F0F0F0F0F0F0F0)
    sixes = _u(0x0606060606060606)
    ok = ((word & high) | (((word + sixes) & high) >> _u(4))) == _u(0x3333333333333333)
    value = ((word & _u(0x0F0F0F0F0F0F0F0F)) * _u(2561)) >> _u(8)
    value = ((value & _u(0x00FF00FF00FF00FF)) * _u(6553601)) >> _u(16)
    value = ((value & _u(0x0000FFFF0000FFFF)) * _u(42949672960001)) >> _u(32)
    return value, ok


def _nibbles8(word: Words) -> tuple[Words, Bools]:
    """Convert eight hexadecimal characters to eight nibbles, and return whether all are valid.

    Each nibble is converted back and compared, which rejects every other byte value.
    """
    ones = _u(0x0101010101010101)
    nibble = (word & (ones * _u(15))) + ((word >> _u(6)) & (ones * _u(3))) * _u(9)
    letter = ((nibble + ones * _u(6)) >> _u(4)) & ones
    spelled = nibble + _ZEROS + letter * _u(39)
    ok = (spelled == (word | (letter << _u(5)))) & ((nibble & (ones * _u(0xF0))) == 0)
    return nibble, ok


def _filled(word: Words, table: Words, count: Int64s, fewest: int, max_count: int) -> Words:
    """Keep ``count`` characters of each word, clipped to 0..8, and set the others to ``0``."""
    if fewest >= 8:
        return word
    if fewest == max_count:
        keep = table[max(fewest, 0)]
        filled: Words = (word & keep) | (_ZEROS & ~keep)
        return filled
    keeps = table[np.minimum(np.maximum(count, 0), 8)]
    return ((word ^ _ZEROS) & keeps) ^ _ZEROS


def decimal(words: Words, stop: Int64s, count: Int64s) -> tuple[Int64s, Bools]:
    """Convert unsigned decimal fields of 1 to 16 digits that end before ``stop``.

    Returns:
        Values, shape (N,), int64, and a mask of the fields that are all digits. Values of other
        fields are undefined.
    """
    if not len(count):
        return np.zeros(0, np.int64), np.zeros(0, np.bool_)
    fewest, max_count = int(count.min()), int(count.max())
    value, ok = _decimal8(_filled(words[stop - 8], _KEEP_LAST, count, fewest, max_count))
    if fewest < 1 or max_count > 16:
        ok &= (count > 0) & (count <= 16)
    if max_count > 8:
        word = _filled(words[stop - 16], _KEEP_LAST, count - 8, fewest - 8, max_count - 8)
        if bool((word == word[0]).all()):
            word = word[:1]  # the leading digits of times are usually all equal
        high, high_ok = _decimal8(word)
        value = value + high * _u(100_000_000)
        ok &= high_ok
    return value.view(np.int64), ok


def hexadecimal(words: Words, stop: Int64s, count: Int64s) -> tuple[Int64s, Bools]:
    """Convert hexadecimal fields of 1 to 8 digits that end before ``stop``; see ``decimal``."""
    if not len(count):
        return np.zeros(0, np.int64), np.zeros(0, np.bool_)
    fewest, max_count = int(count.min()), int(count.max())
    nibble, ok = _nibbles8(_filled(words[stop - 8], _KEEP_LAST, count, fewest, max_count))
    value = _packed(nibble).astype(np.uint32).byteswap().astype(np.int64)
    return value, ok & (count > 0) & (count <= 8)


def _packed(nibble: Words) -> Words:
    """Pack eight nibbles into four bytes, the first two nibbles in the lowest byte."""
    pair = ((nibble << _u(4)) | (nibble >> _u(8))) & _u(0x00FF00FF00FF00FF)
    pair = (pair | (pair >> _u(8))) & _u(0x0000FFFF0000FFFF)
    return (pair | (pair >> _u(16))) & _u(0xFFFFFFFF)


def seconds_ns(
    buffer: Bytes, words: Words, start: Int64s, stop: Int64s, *, marked: bool = True
) -> tuple[Int64s, Bools]:
    """Convert decimal numbers such as ``12.000345`` or ``12,000345`` to 10**-9 units, exactly.

    Numbers have one to ten digits before the mark and one to nine after it; others are invalid.

    Args:
        buffer: The characters.
        words: View of ``buffer`` from ``byte_words``.
        start: Shape (N,): first character of each number.
        stop: Shape (N,): one past its last character.
        marked: Reject numbers without a decimal mark.
    """
    places = _places(buffer, start, stop)
    fraction, fraction_ok = decimal(words, stop, places)
    whole_stop = stop - places - (places > 0)
    whole, whole_ok = decimal(words, whole_stop, whole_stop - start)
    if not marked:
        fraction = np.where(places > 0, fraction, 0)
        fraction_ok |= places == 0
    ok = fraction_ok & whole_ok & (whole <= SECONDS_MAX)
    return whole * NANOS + fraction * _POWER[9 - places], ok


def _places(buffer: Bytes, start: Int64s, stop: Int64s) -> Int64s:
    """Return the number of decimals of each number; usually all have as many as the first."""
    first = _first_places(buffer, start, stop)
    places = np.full(len(stop), first, np.int64)
    here = _has_mark(buffer, start, stop, first)
    if bool(here.all()):
        return places
    open_ = np.flatnonzero(~here)
    for k in range(1, 10):
        here = _has_mark(buffer, start[open_], stop[open_], k)
        places[open_[here]] = k
        open_ = open_[~here]
    places[open_] = 0
    return places


def _has_mark(buffer: Bytes, start: Int64s, stop: Int64s, places: int) -> Bools:
    at = stop - (1 + places)
    mark = buffer[at]
    found: Bools = ((mark == ord(".")) | (mark == ord(","))) & (at > start)
    return found


def _first_places(buffer: Bytes, start: Int64s, stop: Int64s) -> int:
    if not len(stop):
        return 6
    text = buffer[int(start[0]) : int(stop[0])].tobytes()
    mark = max(text.rfind(b"."), text.rfind(b","))
    return min(max(len(text) - 1 - mark, 1), 9) if mark >= 0 else 6


def payload8(words: Words, start: Int64s, length: Int64s) -> tuple[Bytes, Bools]:
    """Convert up to eight bytes in hexadecimal without spaces (``DEADBEEF``).

    Returns:
        Bytes, shape (N, 8), zero from ``length`` on, and a mask of the valid payloads.
    """
    if not len(length):
        return np.zeros((0, 8), np.uint8), np.zeros(0, np.bool_)
    digits = 2 * length
    fewest, max_count = int(digits.min()), int(digits.max())
    low, ok = _nibbles8(_filled(words[start], _KEEP_FIRST, digits, fewest, max_count))
    word = _filled(words[start + 8], _KEEP_FIRST, digits - 8, fewest - 8, max_count - 8)
    high, high_ok = _nibbles8(word)
    ok &= high_ok
    if max_count > 16:
        ok &= length <= 8
    return _rows8(_packed(low), _packed(high)), ok


_GAPS: Final = np.array([0, 0xFF0000, 0xFF0000FF0000], np.uint64)


def spaced8(words: Words, start: Int64s, length: Int64s, gap: int) -> tuple[Bytes, Bools]:
    """Convert up to eight bytes with one character ``gap`` between them (``DE AD BE EF``)."""
    gaps = _u(gap) * _u(0x010000010000)
    ok = length <= 8
    halves = []
    for k in range(2):
        fours = []
        for j in (2 * k, 2 * k + 1):
            word = words[start + 6 * j]
            between = _GAPS[np.clip(length - 1 - 2 * j, 0, 2)]
            ok &= (word & between) == (gaps & between)
            fours.append((word & _u(0xFFFF)) | ((word >> _u(8)) & _u(0xFFFF0000)))
        keep = _KEEP_FIRST[np.clip(2 * length - 8 * k, 0, 8)]
        digits = fours[0] | (fours[1] << _u(32))
        nibble, half_ok = _nibbles8((digits & keep) | (_ZEROS & ~keep))
        halves.append(_packed(nibble))
        ok &= half_ok
    return _rows8(halves[0], halves[1]), ok


def _rows8(low: Words, high: Words) -> Bytes:
    return (low | (high << _u(32))).astype("<u8").view(np.uint8).reshape(-1, 8)


_NIBBLE: Final = np.full(256, 0x80, np.uint8)
for _value, _digits in enumerate(zip(b"0123456789abcdef", b"0123456789ABCDEF", strict=True)):
    _NIBBLE[list(_digits)] = _value


def is_hex(characters: Bytes) -> Bools:
    """Return a mask of the hexadecimal digits."""
    found: Bools = _NIBBLE[characters] < 0x80
    return found


def nibble(characters: Bytes) -> Int64s:
    """Return the value of each hexadecimal digit; 128 for any other character."""
    return _NIBBLE[characters].astype(np.int64)


def payload64(buffer: Bytes, start: Int64s, length: Int64s, gap: int | None) -> tuple[Bytes, Bools]:
    """Convert up to 64 bytes, with the character ``gap`` or nothing between them.

    Returns:
        Bytes, shape (N, 64), and a mask of the valid payloads.
    """
    step = 2 if gap is None else 3
    text = sliding_window_view(buffer, 64 * step)[start].reshape(-1, 64, step)
    high, low = _NIBBLE[text[:, :, 0]], _NIBBLE[text[:, :, 1]]
    inside = np.arange(64) < length[:, None]
    ok = ~np.any(((high | low) >= 0x80) & inside, axis=1) & (length <= 64)
    if gap is not None:
        between = np.arange(64) < length[:, None] - 1
        ok &= ~np.any((text[:, :, 2] != gap) & between, axis=1)
    return np.where(inside, (high << 4) | (low & 15), np.uint8(0)), ok


# Maximum length, in bytes, of the names that ``labels`` distinguishes.
LABEL_MAX: Final = 16
_NAMES_MAX: Final = 64


def labels(words: Words, start: Int64s, count: Int64s) -> tuple[Int64s, tuple[bytes, ...]]:
    """Number the distinct names in fields of 1 to 16 bytes, in order of appearance.

    Returns:
        Shape (N,): index of each field's name, or -1 beyond 64 distinct names; and the names.
    """
    if not len(start):
        return np.zeros(0, np.int64), ()
    fewest, max_count = int(count.min()), int(count.max())
    if fewest == max_count:
        low = words[start] & _KEEP_FIRST[min(max(max_count, 0), 8)]
    else:
        low = words[start] & _KEEP_FIRST[np.minimum(np.maximum(count, 0), 8)]
    high = np.zeros(len(start), np.uint64)
    if max_count > 8:
        high = words[start + 8] & _KEEP_FIRST[np.minimum(np.maximum(count - 8, 0), 8)]
    names = [_spelled(int(low[0]), int(high[0]), int(count[0]))]
    is_first = (low == low[0]) & (high == high[0])
    if bool(is_first.all()):
        return np.zeros(len(start), np.int64), tuple(names)
    codes = np.where(is_first, 0, -1)
    open_ = np.flatnonzero(~is_first)
    while len(open_) and len(names) < _NAMES_MAX:
        first = open_[0]
        same = (low[open_] == low[first]) & (high[open_] == high[first])
        codes[open_[same]] = len(names)
        names.append(_spelled(int(low[first]), int(high[first]), int(count[first])))
        open_ = open_[~same]
    return codes, tuple(names)


def _spelled(low: int, high: int, count: int) -> bytes:
    return (low | high << 64).to_bytes(16, "little")[:count]
