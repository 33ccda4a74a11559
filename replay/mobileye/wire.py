"""Between payloads and columns, one message at a time, as the layout table says.

Columns here are in SI and left-positive, but still seen from the device's reference point: what the
mounting changes is in ``geometry``. A missing value is NaN in a float64 column and -1 in an int16
or int8 one. A flag is bool, or int8 where it may be missing.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import pi
from typing import Final

import numpy as np
from numpy.typing import NDArray

from .bits import Words, extract, place
from .layout import VARIANTS, Column, Columns, Field, Message, Variant

_TO_SI: Final[Mapping[str, float]] = {"deg": pi / 180, "deg/s": pi / 180, "km/h": 1 / 3.6}

MISSING_CODE: Final = -1
_SNAP: Final = 0.05
"""A value given this close to a step of the raw number, in steps, is that step (float32 fields)."""


def values_of(message: Message, words: Words, variant: Variant) -> dict[str, NDArray[np.float64]]:
    """Values on the wire, NaN where missing, of every field.

    Args:
        message: Its layout.
        words: Shape (N,).
        variant: Shape (N,); unknown leaves the fields missing that depend on it.
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


def from_raw(f: Field, raw: NDArray[np.int64]) -> NDArray[np.float64]:
    """(raw - zero) * scale / per, NaN for the codes that mean missing."""
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


def from_given(f: Field, given: NDArray[np.float64]) -> NDArray[np.float64]:
    """Values that another program took off the wire, back on the table's steps and codes."""
    steps = given * f.per / f.scale + f.zero
    whole = np.rint(steps)
    is_near = np.abs(steps - whole) <= _SNAP
    raw = np.where(is_near, whole, 0.0).astype(np.int64)
    return np.where(is_near, from_raw(f, raw), given)


def blank_dependent(message: Message, values: dict[str, NDArray[np.float64]]) -> None:
    """Make missing what hangs on another field that is missing or 0."""
    for f in message.fields:
        if f.missing_with and f.missing_with in values:
            values[f.name] = np.where(np.isnan(values[f.missing_with]), np.nan, values[f.name])
        if f.needs and f.needs in values:
            values[f.name] = np.where(values[f.needs] == 0, np.nan, values[f.name])


def columns_of(message: Message, values: Mapping[str, NDArray[np.float64]]) -> Columns:
    """SI, left-positive, each column in its type."""
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
    """The type of a column of ``message``."""
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
    """The payloads that say ``columns``, rounded to the nearest step.

    A column that is not given is missing where the message can say so, else its default. Columns of
    another variant than a row's are not examined.

    Raises:
        ValueError: A value that the field cannot carry, with column, row, value and range.
    """
    words = np.zeros(len(variant), dtype=np.uint64)
    for f in message.fields:
        here = np.ones(len(variant), dtype=np.bool_)
        if f.only:
            here = variant == VARIANTS.index(f.only)
        raw = np.where(here, _raw_from(f, columns.get(f.name), here, topic), 0)
        words |= place(raw, f.start, f.width, f.order == "big")
    return words


def _raw_from(
    f: Field, column: Column | None, here: NDArray[np.bool_], topic: str
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
            f"{topic} {f.name}, row {row}: cannot send {column[row]}; "
            f"expected {low:g} to {high:g} {f.unit} on the wire"
        )
    nearest = np.clip(np.rint(steps), lowest, highest)
    nearest = _beside_missing(f, nearest)
    return np.where(is_missing | np.isnan(nearest), stand_in, nearest).astype(np.int64)


def _inside(steps: NDArray[np.float64], lowest: int, highest: int) -> NDArray[np.bool_]:
    return (steps >= lowest - 0.5 - 1e-6) & (steps <= highest + 0.5 + 1e-6)


def _beside_missing(f: Field, nearest: NDArray[np.float64]) -> NDArray[np.float64]:
    """A value on a code that means missing moves to the step before it."""
    for code in f.missing:
        nearest = np.where(nearest == code, code - 1 if code > 0 else code + 1, nearest)
    return nearest


def _on_wire(f: Field, column: Column) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """A column in the wire's unit and sign, and where it is missing."""
    value = column.astype(np.float64)
    if f.kind != "real":
        return value, value == MISSING_CODE
    value = value / _TO_SI.get(f.unit, 1.0)
    return (-value if f.flip else value), np.isnan(value)
