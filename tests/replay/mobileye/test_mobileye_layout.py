"""The layout table: consistent, and correct for frames with known values."""

from __future__ import annotations

import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from crosscue.replay.errors import SchemaError
from crosscue.replay.mobileye.bits import extract, leading_words, payloads_of, place_bits
from crosscue.replay.mobileye.layout import VARIANTS, describe, layout, parse_layout
from crosscue.replay.mobileye.wire import values_of


def decoded_value(name: str, field: str, text: str, variant: str = "") -> float:
    message = layout()[name]
    payload = np.zeros((1, 8), dtype=np.uint8)
    raw = bytes.fromhex(text)
    payload[0, : len(raw)] = list(raw)
    number = VARIANTS.index(variant) if variant else -1
    values = values_of(message, leading_words(payload), np.array([number], dtype=np.int8))
    return float(values[field][0])


@pytest.mark.parametrize(
    ("name", "text", "field", "expected"),
    [
        ("obstacle_a", "0180014002003003", "obstacle_id", 1),
        ("obstacle_a", "0180014002003003", "x_m", 24.0),
        ("obstacle_a", "0180014002003003", "y_m", -28.0),
        ("obstacle_a", "0180014002003003", "type", 3),
        ("obstacle_a", "0180014002003003", "status", 3),
        ("obstacle_b", "1184030000000000", "length_m", 8.5),
        ("obstacle_b", "1184030000000000", "width_m", 6.6),
        ("obstacle_b", "1184030000000000", "age_frames", 3),
        ("obstacle_c", "0000000000103007", "replaced", 1),
        ("obstacle_c", "0000000000103007", "angle_rad", 18.4),
        ("status", "020505FF0103", "count", 2),
        ("status", "020505FF0103", "counter_ms", 5),
        ("status", "020505FF0103", "application_version", 5),
        ("status", "020505FF0103", "cut_in_left", 1),
        ("status", "020505FF0103", "cut_in_right", 1),
        ("status", "020505FF0103", "stop_go", 15),
        ("status", "020505FF0103", "protocol_version", 1),
        ("lane_details", "0040200200000000", "c2_per_m", 0x4000 * 3.81e-6),
        ("lane_details", "0040200200000000", "c1", 0.272),
    ],
)
def test_published_frames_decode_to_published_values(
    name: str, text: str, field: str, expected: float
) -> None:
    assert decoded_value(name, field, text, "classic") == pytest.approx(expected, rel=1e-12)


def test_describe_lists_every_field_once() -> None:
    rows = list(describe())
    assert len(rows) == sum(len(m.fields) for m in layout().messages)
    assert rows[0].ids == "0x738"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('fields = [{name = "a", start = 60, bits = 8}]', "a: bits 60+8 do not fit 8 bytes"),
        ('fields = [{name = "a", start = 0, bits = 8}, {name = "b", start = 7, bits = 1}]', "b"),
        ('fields = [{name = "a", start = 4, bits = 8, order = "big"}]', "of complete bytes"),
        ('fields = [{name = "a", start = 0, bits = 8, only = "new"}]', "only 'new'; there are"),
        ('fields = [{name = "a", start = 24, bits = 9}]', "m.a: does not fit the payload"),
    ],
)
def test_invalid_layout_is_refused(text: str, message: str) -> None:
    head = '[[message]]\nname = "m"\nabout = ""\ntable = "t"\nid = 1\nlengths = [4]\n'
    with pytest.raises(SchemaError, match=re.escape(message)):
        parse_layout(head + text)


@given(
    start=st.integers(0, 63), bits=st.integers(1, 32), signed=st.booleans(), seed=st.integers(0, 99)
)
def test_extract_inverts_place(start: int, bits: int, signed: bool, seed: int) -> None:
    bits = min(bits, 64 - start)
    low = -(1 << (bits - 1)) if signed else 0
    raw = np.random.default_rng(seed).integers(low, low + (1 << bits), 20)
    words = place_bits(raw, start, bits, False)
    np.testing.assert_array_equal(extract(words, start, bits, signed, False), raw)
    np.testing.assert_array_equal(leading_words(payloads_of(words)), words)
