"""Encode columns of physical values as payloads, with the layouts used for decoding.

A value that its bits cannot hold is refused, never clipped, because a simulated drive must not look
plausible where it is wrong.
"""

from collections.abc import Mapping
from typing import Any, Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from .extract import is_one_of
from .layout import Arithmetic, CanMessage, CanSignal

Column: TypeAlias = NDArray[Any]

_REALS: Final = {16: (np.float16, np.uint16), 32: (np.float32, np.uint32)}


def encode(message: CanMessage, columns: Mapping[str, Column]) -> NDArray[np.uint8]:
    """Return the payloads of N frames of one message.

    Args:
        message: The layout of the message.
        columns: N numbers by signal name. A signal may be missing only if multiplexers exclude it
            in every row. Values in rows where multiplexers exclude a signal are ignored, and so are
            the companion columns ``SIGNAL_is_present`` of decoded messages.

    Returns:
        Shape (N, message.length), uint8; unused bits are zero.

    Raises:
        ValueError: A value is out of its signal's range, or not a number.
    """
    n = len(next(iter(columns.values())))
    present = _presence(message, columns, n)
    size = -(-message.length // 8)
    little, big = np.zeros((2, n, size), dtype=np.uint64)
    for signal in message.signals:
        rows = present[signal.name]
        if rows.any():
            raw = np.zeros(n, dtype=np.uint64)
            raw[rows] = _raw(message, signal, np.asarray(columns[signal.name])[rows])
            _place(big if signal.is_big_endian else little, signal, raw)
    packed = little.astype("<u8").view(np.uint8) | big.astype(">u8").view(np.uint8)
    return packed[:, : message.length]


def _presence(
    message: CanMessage, columns: Mapping[str, Column], n: int
) -> dict[str, NDArray[np.bool_]]:
    """Return the rows that hold each signal, according to the multiplexers' values."""
    present: dict[str, NDArray[np.bool_]] = {}
    waiting = list(message.signals)
    while waiting:
        signal = waiting.pop(0)
        if signal.multiplexer is None:
            rows = np.ones(n, dtype=np.bool_)
        elif signal.multiplexer not in present:
            waiting.append(signal)
            continue
        else:
            above = message.signal(signal.multiplexer)
            rows = present[above.name].copy()
            if rows.any():
                rows &= is_one_of(np.asarray(columns[above.name]), tuple(signal.branches))
        present[signal.name] = rows
    return present


def _raw(message: CanMessage, signal: CanSignal, values: Column) -> NDArray[np.uint64]:
    """Return raw bits, right-aligned; bits above the signal's length may be set."""
    where = f"{message.name}.{signal.name}"
    if signal.is_float:
        return _raw_real(where, signal, values.astype(np.float64))
    if signal.arithmetic in (Arithmetic.INT64, Arithmetic.UINT64) and values.dtype.kind in "biu":
        return _raw_whole(where, signal, values)
    low, high = signal.raw_range
    steps = np.rint((values.astype(np.float64) - float(signal.offset)) / float(signal.scale))
    # Both limits are powers of two, hence exact in float64; NaN is outside every range.
    _refuse_outside(where, signal, values, (steps >= float(low)) & (steps < float(high + 1)))
    return steps.astype(np.int64).view(np.uint64) if signal.is_signed else steps.astype(np.uint64)


def _raw_real(where: str, signal: CanSignal, values: NDArray[np.float64]) -> NDArray[np.uint64]:
    if signal.scale != 1 or signal.offset != 0:
        values = (values - float(signal.offset)) / float(signal.scale)
    if signal.length == 64:
        return values.view(np.uint64)
    real, whole = _REALS[signal.length]
    with np.errstate(over="ignore"):
        narrow = values.astype(real)
    _refuse_outside(where, signal, values, np.isinf(narrow) <= np.isinf(values))
    return narrow.view(whole).astype(np.uint64)


def _raw_whole(where: str, signal: CanSignal, values: Column) -> NDArray[np.uint64]:
    """Return raw integers without floating point: differences modulo 2**64 are exact here."""
    scale, offset = int(signal.scale), int(signal.offset)
    ends = [raw * scale + offset for raw in signal.raw_range]
    _refuse_outside(where, signal, values, (values >= min(ends)) & (values <= max(ends)))
    wide = values.astype(np.uint64 if values.dtype.kind in "bu" else np.int64).view(np.uint64)
    steps = wide - np.uint64(offset % 2**64)
    if scale < 0:
        steps = np.uint64(0) - steps
    size = abs(scale)
    whole: Column = steps.view(np.int64) if signal.is_signed else steps
    quotient, rest = np.divmod(whole, whole.dtype.type(size))
    left = whole.dtype.type(size) - rest
    quotient += (rest > left) | ((rest == left) & (quotient % 2 == 1))
    raw: NDArray[np.uint64] = quotient.view(np.uint64)
    return raw


def _refuse_outside(
    where: str, signal: CanSignal, values: Column, is_inside: NDArray[np.bool_]
) -> None:
    if is_inside.all():
        return
    row = int(np.argmin(is_inside))
    ends = sorted(raw * signal.scale + signal.offset for raw in signal.raw_range)
    span = f"{signal.length}-bit floats" if signal.is_float else f"{ends[0]} to {ends[1]}"
    raise ValueError(f"{where}: {values[row]} does not fit; the signal's bits hold {span}")


def _place(words: NDArray[np.uint64], signal: CanSignal, raw: NDArray[np.uint64]) -> None:
    """Write raw bits into words of shape (N, W) that count bits in the signal's direction."""
    word, bit = divmod(signal.first_bit, 64)
    raw = raw & np.uint64(2**signal.length - 1)
    over = bit + signal.length - 64
    if not signal.is_big_endian:
        words[:, word] |= raw << np.uint64(bit)
        if over > 0:
            words[:, word + 1] |= raw >> np.uint64(64 - bit)
    elif over <= 0:
        words[:, word] |= raw << np.uint64(-over)
    else:
        words[:, word] |= raw >> np.uint64(over)
        words[:, word + 1] |= raw << np.uint64(64 - over)
