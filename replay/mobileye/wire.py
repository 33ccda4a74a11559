"""Convert between payloads and columns, one message at a time, according to the layout table.

Columns here are in SI units and left-positive, but relative to the device's reference point;
``geometry`` applies the mounting. A missing value is NaN in a float64 column and -1 in an int16 or
int8 column. A flag is bool, or int8 if it may be missing.
"""

from collections.abc import Mapping
from math import pi
from typing import Final

import numpy as np
from numpy.typing import NDArray

from .bits import Words, extract, place_bits
from .layout import VARIANTS, BitField, Column, Columns, Message, Variant

_TO_SI: Final[Mapping[str, float]] = {"deg": pi / 180, "deg/s": pi / 180, "km/h": 1 / 3.6}

MISSING_CODE: Final = -1
# Max distance, in steps, of a value from the raw step that it represents (float32 fields).
_SNAP: Final = 0.05


def values_of(message: Message, words: Words, variant: Variant) -> dict[str, NDArray[np.float64]]:
    """Return the values on the wire of every field, NaN where missing.

    Args:
        message: Layout of the message.
        words: Payloads, shape (N,).
        variant: Variants, shape (N,); fields that depend on an unknown variant are missing.
    """
    values: dict[str, NDArray[np.float64]] = {}
    for f in message.fields:
        raw = extract(words, f.start, f.bits, f.signed, f.order == "big")
        value = from_raw(f, raw)
        if f.only:
            here = variant == VARIANTS.index(f.only)
            value = np.where(here, value, values.get(f.name, np.nan))
        values[f.name] = value
    blank_dependent(message, values)
    return values


def from_raw(f: BitField, raw: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return (raw - zero) * scale / per, NaN for the codes that mean missing."""
    value = raw.astype(np.float64)
    if f.zero:
        value -= f.zero
    if f.scale != 1.0:
        value *= f.scale
    if f.per != 1.0:
        value /= f.per
    for code in f.missing:
        value[raw == code] = np.nan
    return value


def from_given(f: BitField, given: NDArray[np.float64]) -> NDArray[np.float64]:
    """Round values that another program decoded to the table's steps and codes."""
    steps = given * f.per / f.scale + f.zero
    whole = np.rint(steps)
    is_near = np.abs(steps - whole) <= _SNAP
    raw = np.where(is_near, whole, 0.0).astype(np.int64)
    return np.where(is_near, from_raw(f, raw), given)


def blank_dependent(message: Message, values: dict[str, NDArray[np.float64]]) -> None:
    """Set fields to missing if a field that they depend on is missing or 0."""
    for f in message.fields:
        if f.missing_with and f.missing_with in values:
            values[f.name] = np.where(np.isnan(values[f.missing_with]), np.nan, values[f.name])
        if f.needs and f.needs in values:
            values[f.name] = np.where(values[f.needs] == 0, np.nan, values[f.name])


def si_columns(message: Message, values: Mapping[str, NDArray[np.float64]]) -> Columns:
    """Return columns in SI units, left-positive, each with its dtype."""
    columns: Columns = {}
    for f in {f.name: f for f in message.fields}.values():
        value = values[f.name]
        if f.kind != "real":
            columns[f.name] = _whole(value, dtype_of(message, f.name))
            continue
        value = value * _TO_SI.get(f.unit, 1.0)
        columns[f.name] = 0.0 - value if f.flip else value
    return columns


def dtype_of(message: Message, name: str) -> np.dtype[np.generic]:
    """Return the dtype of a column of ``message``."""
    same = [f for f in message.fields if f.name == name]
    if same[0].kind == "real":
        return np.dtype(np.float64)
    if same[0].kind == "code":
        return np.dtype(np.int16)
    return np.dtype(np.int8 if any(f.may_be_missing for f in same) else np.bool_)


def _whole(value: NDArray[np.float64], dtype: np.dtype[np.generic]) -> Column:
    if dtype == np.bool_:
        flags: Column = value != 0
        return flags
    codes: Column = np.where(np.isnan(value), MISSING_CODE, value).astype(dtype)
    return codes


def words_from(
    message: Message, columns: Mapping[str, Column], variant: Variant, topic: str
) -> Words:
    """Return the payloads for ``columns``, rounded to the nearest step.

    An absent column is sent as missing if the message has a code for it, else as its default.
    Columns of another variant than that of a row are ignored.

    Raises:
        ValueError: A field cannot represent a value; the message names column, row, value and
            range.
    """
    words = np.zeros(len(variant), dtype=np.uint64)
    for f in message.fields:
        here = np.ones(len(variant), dtype=np.bool_)
        if f.only:
            here = variant == VARIANTS.index(f.only)
        raw = np.where(here, _raw_from(f, columns.get(f.name), here, topic), 0)
        words |= place_bits(raw, f.start, f.width, f.order == "big")
    return words


def _raw_from(
    f: BitField, column: Column | None, here: NDArray[np.bool_], topic: str
) -> NDArray[np.int64]:
    stand_in = f.missing[0] if f.missing else f.default
    if column is None:
        return np.full(len(here), stand_in, dtype=np.int64)
    value, is_missing = _on_wire(f, column)
    steps = value * f.per / f.scale + f.zero
    lowest, highest = f.raw_range
    can_miss = bool(f.missing or f.needs)
    is_bad = here & is_missing & (not can_miss)
    if f.beyond != "clip":
        is_bad |= here & ~is_missing & ~_inside(steps, lowest, highest)
    if is_bad.any():
        row = int(np.flatnonzero(is_bad)[0])
        low, high = sorted(float(from_raw(f, np.array([r]))[0]) for r in (lowest, highest))
        raise ValueError(
            f"{topic} {f.name}, row {row}: cannot encode {column[row]}; "
            f"expected {low:g} to {high:g} {f.unit} on the wire"
        )
    nearest = np.clip(np.rint(steps), lowest, highest)
    # Values that equal a code for missing are moved to the step before it.
    for code in f.missing:
        nearest = np.where(nearest == code, code - 1 if code > 0 else code + 1, nearest)
    return np.where(is_missing | np.isnan(nearest), stand_in, nearest).astype(np.int64)


def _inside(steps: NDArray[np.float64], lowest: int, highest: int) -> NDArray[np.bool_]:
    return (steps >= lowest - 0.5 - 1e-6) & (steps <= highest + 0.5 + 1e-6)


def _on_wire(f: BitField, column: Column) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return a column in the wire's unit and sign, and a mask of its missing values."""
    value = column.astype(np.float64)
    if f.kind != "real":
        return value, value == MISSING_CODE
    value = value / _TO_SI.get(f.unit, 1.0)
    return (-value if f.flip else value), np.isnan(value)
