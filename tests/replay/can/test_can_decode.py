"""Columns equal what cantools decodes frame by frame, on random payloads of random layouts."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cantools.database.can import Message
from cantools.database.can.formats import dbc
from cantools.database.errors import DecodeError
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from crosscue.replay.can.database import CanDatabase
from crosscue.replay.can.decode import BusDecoder
from crosscue.replay.can.encode import encode
from crosscue.replay.can.extract import PRESENT_SUFFIX
from crosscue.replay.can.layout import Arithmetic, CanMessage, CanSignal, is_integer
from crosscue.replay.columns import Block, Table
from crosscue.replay.ledger import Ledger
from support.can_layouts import block_of, dbc_text, frames_of, messages

LAYOUTS = st.one_of(messages(), messages(multiplexed=True))
SEEDS = st.integers(0, 2**32 - 1)
ROWS = 24

hypothesis_settings = partial(
    settings,
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
)


def payloads(message: CanMessage, seed: int) -> NDArray[np.uint8]:
    """Return rows of random bytes, after a row of zeros and a row of 255s."""
    drawn = np.random.default_rng(seed).integers(0, 256, (ROWS, message.length), dtype=np.uint8)
    drawn[0], drawn[1] = 0, 255
    return drawn


def parsed_by_both(message: CanMessage, folder: Path) -> tuple[CanDatabase, Message]:
    """Write the message as a DBC file, and parse it with crosscue and with cantools."""
    text = dbc_text([message])
    path = folder / "layout.dbc"
    path.write_text(text, encoding="utf-8")
    (theirs,) = dbc.load_string(text, strict=True).messages
    return CanDatabase.load([path]), theirs


def decode_all(
    database: CanDatabase, message: CanMessage, payload: NDArray[np.uint8]
) -> tuple[Block | None, BusDecoder, Ledger]:
    ledger = Ledger("made up")
    ledger.find("can0", len(payload))
    decode = BusDecoder(database, "can0", ledger)
    blocks = decode(block_of(frames_of(payload, message.arbitration_id, message.is_extended)))
    assert len(blocks) <= 1
    return (blocks[0] if blocks else None), decode, ledger


def rows_by_cantools(message: Message, payload: NDArray[np.uint8]) -> list[dict[str, Any] | None]:
    """Return the values of each row from cantools, or None where it rejects the row."""
    rows: list[dict[str, Any] | None] = []
    for row in payload:
        try:
            rows.append(dict(message.decode_simple(row.tobytes(), decode_choices=False)))
        except DecodeError:
            rows.append(None)
    return rows


def row_of(table: Table, i: int) -> dict[str, Any]:
    """Return one row as Python numbers, without the signals that are absent from it."""
    columns = table.columns
    row = {name: column[i].item() for name, column in columns.items()}
    for name in columns:
        if name.endswith(PRESENT_SUFFIX) and not row.pop(name):
            del row[name.removesuffix(PRESENT_SUFFIX)]
    return row


def assert_same_values(ours: dict[str, Any], theirs: dict[str, Any]) -> None:
    for name, value in theirs.items():
        if math.isnan(value):
            assert math.isnan(ours[name])
        elif isinstance(ours[name], int):
            assert ours[name] == value
        else:
            assert ours[name] == float(value)
    assert all(math.isnan(ours[name]) for name in ours.keys() - theirs.keys())


@pytest.mark.slow
@given(message=LAYOUTS, seed=SEEDS)
@hypothesis_settings(max_examples=60)
def test_decoded_values_equal_cantools(message: CanMessage, seed: int, tmp_path: Path) -> None:
    database, theirs = parsed_by_both(message, tmp_path)
    payload = payloads(message, seed)

    block, decoder, ledger = decode_all(database, message, payload)

    expected = rows_by_cantools(theirs, payload)
    good = [i for i, row in enumerate(expected) if row is not None]
    assert sum(decoder.counts.values()) == len(payload) - len(good)
    assert ledger.topic("can0").used == len(good) == (len(block) if block else 0)
    if block is None:
        return
    assert block.log_ns.tolist() == [i * 1_000_000 for i in good]
    assert isinstance(block.rows, Table)
    for at, i in enumerate(good):
        row = expected[i]
        assert row is not None
        assert_same_values(row_of(block.rows, at), row)


def _is_integral(signal: CanSignal) -> bool:
    return not signal.is_float and is_integer(signal.scale) and is_integer(signal.offset)


def invertible(message: CanMessage) -> CanMessage:
    """Return the message with scales at which adjacent raw values are distinct in float64."""
    return replace(
        message,
        signals=tuple(
            replace(s, scale=1, offset=0)
            if s.arithmetic is Arithmetic.BIG
            or (not _is_integral(s) and (s.length > 40 or abs(s.offset) > 1000))
            else s
            for s in message.signals
        ),
    )


@pytest.mark.slow
@given(message=LAYOUTS.map(invertible), seed=SEEDS)
@hypothesis_settings(max_examples=60)
def test_encoding_inverts_decoding_and_equals_cantools(
    message: CanMessage, seed: int, tmp_path: Path
) -> None:
    database, theirs = parsed_by_both(message, tmp_path)
    (ours,) = database.messages
    payload = payloads(message, seed)
    block, _, _ = decode_all(database, message, payload)
    if block is None:
        return
    assert isinstance(block.rows, Table)

    encoded = encode(ours, block.rows.columns)

    again, decoder, _ = decode_all(database, message, encoded)
    assert not decoder.counts
    assert again is not None
    assert isinstance(again.rows, Table)
    for name, column in block.rows.columns.items():
        np.testing.assert_array_max_ulp(column.astype(float), again.rows[name].astype(float), 4)
    good = [row for row in rows_by_cantools(theirs, payload) if row is not None]
    for values, row in zip(good, encoded, strict=True):
        if not any(math.isnan(v) or math.isinf(v) for v in values.values()):
            assert theirs.encode(values, strict=False) == row.tobytes()


WIDE = CanMessage(
    name="Wide",
    arbitration_id=1,
    is_extended=False,
    length=8,
    signals=(CanSignal("counter", start=0, length=64),),
)


@pytest.mark.parametrize(
    ("value", "words"),
    [
        (-1.0, "-1.0 does not fit; the signal's bits hold 0.0 to 25.5"),
        (25.6, "25.6 does not fit"),
        (float("nan"), "nan does not fit"),
        (float("inf"), "inf does not fit"),
    ],
)
def test_encoding_refuses_values_out_of_range(value: float, words: str) -> None:
    signal = CanSignal("speed", start=0, length=8, scale=0.1)
    message = replace(WIDE, signals=(signal,))

    with pytest.raises(ValueError, match=rf"Wide\.speed: {words}"):
        encode(message, {"speed": np.array([1.0, value])})
