"""Values of MDF 4 channels, out of whole columns of records."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.columns import Bytes

from .mf4_blocks import VIRTUAL_MASTER, Channel, Conversion

_FLOATS = {16: np.float16, 32: np.float32, 64: np.float64}
ALL_INVALID = 1
HAS_INVALID_BIT = 2


def is_numeric(channel: Channel, value_bytes: int) -> bool:
    """Can ``raw`` read it?"""
    end = channel.byte_offset + (channel.bit_offset + channel.bit_count + 7) // 8
    fits = end <= value_bytes and channel.bit_offset + channel.bit_count <= 64
    if channel.data_type in (4, 5):
        return fits and channel.bit_count in _FLOATS and not channel.bit_offset
    return channel.data_type <= 3 and channel.bit_count > 0 and fits


def raw(channel: Channel, records: Bytes, first: int) -> NDArray[np.generic]:
    """Stored values of a numeric channel.

    Args:
        channel: One that ``is_numeric``, or a virtual master.
        records: Shape (N, record bytes).
        first: Index of the first record in its group, which is what a virtual master counts.
    """
    if channel.type == VIRTUAL_MASTER:
        return np.arange(first, first + len(records), dtype=np.int64)
    count = (channel.bit_offset + channel.bit_count + 7) // 8
    part = records[:, channel.byte_offset : channel.byte_offset + count]
    is_big = channel.data_type in (1, 3, 5)
    if is_big:
        part = part[:, ::-1]
    if channel.data_type in (4, 5):
        type_ = np.dtype(_FLOATS[channel.bit_count]).newbyteorder("<")
        numbers: NDArray[np.generic] = np.ascontiguousarray(part).view(type_)[:, 0]
        return numbers
    wide = np.zeros((len(records), 8), np.uint8)
    wide[:, :count] = part
    value = wide.view("<u8")[:, 0] >> np.uint64(channel.bit_offset)
    if channel.bit_count < 64:
        value &= np.uint64((1 << channel.bit_count) - 1)
    if channel.data_type in (0, 1):
        return value if channel.bit_count > 32 else value.astype(np.uint32)
    spare = 64 - channel.bit_count
    signed: NDArray[np.int64] = (value << np.uint64(spare)).view(np.int64) >> np.int64(spare)
    return signed


def physical(conversion: Conversion, values: NDArray[np.generic]) -> NDArray[np.generic]:
    """Converted values; unchanged for conversions that are not applied."""
    p = conversion.values
    if conversion.type == 1 and len(p) >= 2:
        if p[0] == 0.0 and p[1] == 1.0:
            return values
        return values.astype(np.float64) * p[1] + p[0]
    if conversion.type == 2 and len(p) >= 6:
        x = values.astype(np.float64)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            above, below = (p[0] * x + p[1]) * x + p[2], (p[3] * x + p[4]) * x + p[5]
            ratio: NDArray[np.float64] = above / below
        return ratio
    if conversion.type == 4 and len(p) >= 4:
        keys, targets = np.array(p[0::2]), np.array(p[1::2])
        if len(keys) == len(targets) and bool((np.diff(keys) > 0).all()):
            between: NDArray[np.float64] = np.interp(values.astype(np.float64), keys, targets)
            return between
    return values


def is_applied(conversion: Conversion) -> bool:
    """Does ``physical`` know this conversion?"""
    return conversion.type in (0, 1, 2, 4)


def invalid(channel: Channel, records: Bytes, value_bytes: int) -> NDArray[np.bool_] | None:
    """Which values the recorder marked as invalid; None for none."""
    if channel.flags & ALL_INVALID:
        return np.ones(len(records), np.bool_)
    at = value_bytes + channel.invalid_bit // 8
    if not channel.flags & HAS_INVALID_BIT or at >= records.shape[1]:
        return None
    marked: NDArray[np.bool_] = (records[:, at] >> (channel.invalid_bit % 8)) & 1 != 0
    return marked if bool(marked.any()) else None


def times_ns(channel: Channel, values: NDArray[np.generic]) -> NDArray[np.int64] | None:
    """Master values as nanoseconds since the start, exact where stored as whole steps of them.

    Returns:
        Shape (N,); None when one of them is no time (not finite, or over 200 years).
    """
    conversion = channel.conversion
    offset, factor = 0.0, 1.0
    if conversion.type == 1 and len(conversion.values) >= 2:
        offset, factor = conversion.values[:2]
    elif conversion.type not in (0, 1):
        return None
    step = factor * 1e9
    whole = round(step) if np.isfinite(step) else 0
    is_exact = values.dtype.kind in "iu" and offset == 0.0 and whole >= 1
    if is_exact and abs(step - whole) < 1e-6 * whole:
        largest = (1 << 62) // whole
        if len(values) and int(values.max()) > largest:
            return None
        return values.astype(np.int64) * whole
    with np.errstate(over="ignore", invalid="ignore"):
        nanos = np.rint((values.astype(np.float64) * factor + offset) * 1e9)
        if not bool((np.abs(nanos) < float(1 << 62)).all()):
            return None
    return nanos.astype(np.int64)
