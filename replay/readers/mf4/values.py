"""Values of MDF 4 channels, computed from columns of records."""

import numpy as np
from numpy.typing import NDArray

from .blocks import VIRTUAL, VIRTUAL_MASTER, Conversion, Mf4Channel

_FLOATS = {16: np.float16, 32: np.float32, 64: np.float64}
ALL_INVALID = 1
HAS_INVALID_BIT = 2


def is_numeric(channel: Mf4Channel, value_bytes: int) -> bool:
    """Return whether ``raw`` supports a channel."""
    if channel.type in (VIRTUAL_MASTER, VIRTUAL):
        return True
    end = channel.byte_offset + (channel.bit_offset + channel.bit_count + 7) // 8
    fits = end <= value_bytes and channel.bit_offset + channel.bit_count <= 64
    if channel.data_type in (4, 5):
        return fits and channel.bit_count in _FLOATS and not channel.bit_offset
    return channel.data_type <= 3 and channel.bit_count > 0 and fits


def is_plain(channel: Mf4Channel) -> bool:
    """Return whether a channel's raw value is an unsigned little-endian number in the record."""
    return channel.type not in (VIRTUAL_MASTER, VIRTUAL) and channel.data_type == 0


class Words:
    """Records as 64-bit words, which are loaded once for all channels that share them."""

    def __init__(self, records: NDArray[np.uint8], first: int = 0) -> None:
        """Wrap records; words are loaded on demand.

        Args:
            records: Shape (N, record bytes).
            first: Index of the first record in its group, for virtual channels.
        """
        self.records, self.first = np.ascontiguousarray(records), first
        self._loaded: dict[int, NDArray[np.uint64]] = {}

    def __len__(self) -> int:
        return len(self.records)

    def bits(self, byte: int, bit: int, count: int) -> NDArray[np.uint64]:
        """Read little-endian numbers of up to 64 bits from bit ``bit`` of ``byte`` on."""
        size = self.records.shape[1]
        at = byte - byte % 8
        if byte * 8 + bit + count > at * 8 + 64:
            at = byte
        at = max(min(at, size - 8), 0)
        if at not in self._loaded:
            self._loaded[at] = self._word(at, size)
        word, shift = self._loaded[at], 8 * (byte - at) + bit
        if shift:
            word = word >> np.uint64(shift)
        return word if shift + count == 64 else word & np.uint64((1 << count) - 1)

    def _word(self, at: int, size: int) -> NDArray[np.uint64]:
        if size < 8:
            wide = np.zeros((len(self.records), 8), np.uint8)
            wide[:, :size] = self.records
            return wide.view("<u8")[:, 0]
        if not len(self.records):
            return np.zeros(0, np.uint64)
        view: NDArray[np.uint64] = np.ndarray(
            (len(self.records),), np.dtype("<u8"), self.records.data, at, (size,)
        )
        return view.astype(np.uint64)  # a copy, which is aligned


def raw(channel: Mf4Channel, words: Words) -> NDArray[np.generic]:
    """Return the stored values of a numeric channel; the record's index for a virtual channel."""
    if channel.type in (VIRTUAL_MASTER, VIRTUAL):
        return np.arange(words.first, words.first + len(words), dtype=np.int64)
    count = (channel.bit_offset + channel.bit_count + 7) // 8
    if channel.data_type in (1, 3, 5):
        part = words.records[:, channel.byte_offset : channel.byte_offset + count]
        words = Words(part[:, ::-1])
        value = words.bits(0, channel.bit_offset, channel.bit_count)
    else:
        value = words.bits(channel.byte_offset, channel.bit_offset, channel.bit_count)
    if channel.data_type in (4, 5):
        number = value.astype(f"<u{channel.bit_count // 8}", copy=False)
        floats: NDArray[np.generic] = number.view(_FLOATS[channel.bit_count])
        return floats
    if channel.data_type in (0, 1):
        return value if channel.bit_count > 32 else value.astype(np.uint32)
    spare = 64 - channel.bit_count
    signed: NDArray[np.int64] = (value << np.uint64(spare)).view(np.int64) >> np.int64(spare)
    return signed


def physical(conversion: Conversion, values: NDArray[np.generic]) -> NDArray[np.generic]:
    """Return the converted values; unchanged for unsupported conversions."""
    p = conversion.values
    if conversion.type == 1 and len(p) >= 2:
        if p[0] == 0.0 and p[1] == 1.0:
            return values
        if p[1] == 0.0:
            return np.full(len(values), p[0])
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
    if conversion.type == 5 and len(p) >= 2:
        keys, targets = np.array(p[0::2]), np.array(p[1::2])
        if len(keys) == len(targets) and bool((np.diff(keys) > 0).all()):
            return targets[_nearest(keys, values.astype(np.float64))]
    if conversion.type == 6 and len(p) >= 4:
        return _of_ranges(p, values)
    return values


def _nearest(keys: NDArray[np.float64], x: NDArray[np.float64]) -> NDArray[np.intp]:
    """Return the index of the key nearest to each value; of two equally near keys, the lower."""
    above = np.clip(np.searchsorted(keys, x), 1, max(len(keys) - 1, 1))
    above = np.minimum(above, len(keys) - 1)
    below = np.maximum(above - 1, 0)
    return np.where(x - keys[below] <= keys[above] - x, below, above)


def _of_ranges(p: tuple[float, ...], values: NDArray[np.generic]) -> NDArray[np.float64]:
    """Convert by a table of lower bound, upper bound and result, followed by the default."""
    low, high, target = (np.array(p[k : 3 * (len(p) // 3) : 3]) for k in range(3))
    x = values.astype(np.float64)
    found = np.full(len(x), p[-1])
    for k in range(len(low)):
        # The upper bound is inclusive only for integers.
        inside = (x >= low[k]) & ((x <= high[k]) if values.dtype.kind in "iu" else (x < high[k]))
        found[inside] = target[k]
    return found


def is_applied(conversion: Conversion) -> bool:
    """Return whether ``physical`` supports this conversion."""
    return conversion.type in (0, 1, 2, 4, 5, 6)


def invalid(
    channel: Mf4Channel, records: NDArray[np.uint8], value_bytes: int
) -> NDArray[np.bool_] | None:
    """Return a mask of the values marked as invalid by the recorder; None for none."""
    if channel.flags & ALL_INVALID:
        return np.ones(len(records), np.bool_)
    at = value_bytes + channel.invalid_bit // 8
    if not channel.flags & HAS_INVALID_BIT or at >= records.shape[1]:
        return None
    marked: NDArray[np.bool_] = (records[:, at] >> (channel.invalid_bit % 8)) & 1 != 0
    return marked if bool(marked.any()) else None


def times_ns(channel: Mf4Channel, values: NDArray[np.generic]) -> NDArray[np.int64] | None:
    """Convert master values to nanoseconds since the start, exactly if stored as integer steps.

    Returns:
        Shape (N,); None if a value is not a valid time (not finite, or over 200 years).
    """
    conversion = channel.conversion
    offset, factor = 0.0, 1.0
    if conversion.type == 1 and len(conversion.values) >= 2:
        offset, factor = conversion.values[:2]
    elif not is_applied(conversion):
        return None
    elif conversion.type > 1:
        values = physical(conversion, values)
    step = factor * 1e9
    whole = round(step) if np.isfinite(step) else 0
    is_exact = values.dtype.kind in "iu" and offset == 0.0 and whole >= 1
    if is_exact and abs(step - whole) < 1e-6 * whole:
        largest = (1 << 62) // whole
        if len(values) and int(values.max()) > largest:
            return None
        return values.astype(np.int64) * whole
    with np.errstate(over="ignore", invalid="ignore"):
        seconds = values.astype(np.float64, copy=False)
        # A single product, which is exact for nanosecond counts stored as floating point.
        nanos = np.rint(seconds * step if offset == 0.0 else (seconds * factor + offset) * 1e9)
        # Comparisons with NaN are false.
        if len(nanos) and not (nanos.max() < float(1 << 62) and nanos.min() > -float(1 << 62)):
            return None
    return nanos.astype(np.int64)
