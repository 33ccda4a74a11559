"""The layout table: consistent, and correct for frames with known values."""

from __future__ import annotations

import re
from math import degrees

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crosscue.replay.errors import SchemaError
from crosscue.replay.mobileye.bits import extract, leading_words, payloads_of, place_bits
from crosscue.replay.mobileye.layout import VARIANTS, Message, describe, layout, parse_layout
from crosscue.replay.mobileye.wire import from_given, from_raw, si_columns, values_of
from support.mobileye_frames import random_words


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


@pytest.mark.parametrize(
    ("name", "field", "text", "variant", "expected"),
    [
        (
            "lane_a",
            "c0_m",
            "003EFE0000000000",
            "",
            -1.7578125,
        ),  # a left lane
        ("lane_a", "c2_per_m", "000000FF7F000000", "", 0.0),
        ("lane_a", "c3_per_m2", "0000000000FF7F00", "", 0.0),
        ("lane_b", "c1", "FF7F0080", "", 0.0),
        ("lane_b", "view_range_m", "FF7F0080", "", 0.0),
        ("lane_b", "view_range_available", "FF7F0080", "", 1.0),
        ("lane_details", "yaw_rad", "00000000FF7F0000", "classic", 0.0),
        ("lane_details", "pitch_rad", "000000000000FFFF", "2.32", 0.05),
        ("lane_details", "pitch_rad", "0000000000000000", "2.32", -0.05),
        ("lane_details", "lane_count", "2300000000000000", "2.32", 3),
        ("lane_details", "lane_position", "2300000000000000", "2.32", 2),
        ("status", "failsafe", "00000000000400", "classic", 2),
        ("status", "failsafe", "00000000004010", "2.32", 64 + 4096),
        ("status", "close_car", "00000000000020", "2.32", 1),
        ("warnings", "ldw_on", "0000000001000000", "extended", 1),
        ("warnings", "ldw_on", "0000000001000000", "tsr", 0),
        ("warnings", "no_error", "0000000100000000", "tsr", 1),
        ("warnings", "headway_s", "0000330000000000", "tsr", 2.5),
        ("sign", "lateral_m", "000000FE00000000", "basic", -1.0),  # sign-extended by the device
        ("sign", "lateral_m", "0000007E00000000", "basic", -1.0),  # or not
        ("sign", "vertical_m", "00000000E0000000", "basic", -16.0),
        ("sign", "vertical_m", "0000000020000000", "basic", -16.0),
        ("high_beam_area", "bottom_rad", "00000000000000", "classic", -10.0),
        ("aftermarket_lane", "y_left_m", "0180FA0000000000", "", -1.76),
        ("aftermarket_lane", "confidence_left", "0300000000000000", "", 3),
        ("vehicle", "speed_mps", "0000480000000000", "", 72),
        ("gyro", "rate_radps", "80FF00", "", 256 * 0.00875),
    ],
)
def test_known_payloads_decode_to_known_values(
    name: str, field: str, text: str, variant: str, expected: float
) -> None:
    assert decoded_value(name, field, text, variant) == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize(
    ("name", "field", "text"),
    [
        ("obstacle_b", "length_m", "3F00000000000000"),
        ("obstacle_b", "radar_x_m", "000000F0FF000000"),
        ("obstacle_b", "radar_vx_mps", "000000F0FF008000"),
        ("obstacle_b", "radar_vx_mps", "000000F0FFFF0F00"),  # the other no-match code
        ("obstacle_b", "radar_id", "000000000000007F"),
        ("obstacle_c", "accel_x_mps2", "0000000000020000"),
        ("lane_details", "c2_per_m", "0080000000000000"),
        ("lane_details", "c1", "0000000800000000"),
        ("sign", "sign_type", "FF00000000000000"),
        ("reference_points", "position_1_m", "0010000000000000"),
        ("warnings", "headway_s", "0000320000000000"),
    ],
)
def test_codes_for_missing_values_are_nan(name: str, field: str, text: str) -> None:
    assert np.isnan(decoded_value(name, field, text, "classic" if name == "lane_details" else ""))


def test_radar_speed_of_minus_one_step_is_not_missing() -> None:
    assert decoded_value("obstacle_b", "radar_vx_mps", "0000000001FF0F00") == -0.0625


def test_fields_that_depend_on_unknown_variant_are_missing() -> None:
    assert np.isnan(decoded_value("warnings", "ldw_on", "0000000001000000"))
    assert np.isnan(decoded_value("lane_details", "c1", "0000200200000000"))
    assert decoded_value("warnings", "fcw", "0000000008000000") == 1


@pytest.mark.parametrize(("angle_raw", "bearing_deg"), [(-109, 1.07), (33, -0.25), (-778, 7.74)])
def test_angle_on_the_bus_is_negated_bearing(angle_raw: int, bearing_deg: float) -> None:
    """The sent angle and the bearing of the sent position are from three real recordings."""
    f = next(f for f in layout()["obstacle_c"].fields if f.name == "angle_rad")
    words = place_bits(np.array([angle_raw]), f.start, f.bits, False)
    values = values_of(layout()["obstacle_c"], words, np.array([-1], dtype=np.int8))
    angle_rad = si_columns(layout()["obstacle_c"], values)["angle_rad"].astype(np.float64)
    assert degrees(angle_rad[0]) == pytest.approx(bearing_deg, abs=0.1)


def test_lane_heading_sign_is_unified_across_messages() -> None:
    """Real messages: 0x737 is left-positive, the LKA lane right-positive; columns agree."""
    c1_lka = np.array([0.01367])
    lka = si_columns(layout()["lane_b"], {"c1": c1_lka, **_other_fields("lane_b", "c1")})
    details = si_columns(
        layout()["lane_details"], {"c1": -c1_lka, **_other_fields("lane_details", "c1")}
    )
    assert lka["c1"].tolist() == details["c1"].tolist() == [-0.01367]


def _other_fields(name: str, but: str) -> dict[str, np.ndarray[tuple[int], np.dtype[np.float64]]]:
    return {f.name: np.zeros(1) for f in layout()[name].fields if f.name != but}


def test_messages_have_documented_identifiers() -> None:
    ids = {m.name: m.ids for m in layout().messages}
    assert ids["obstacle_a"] == tuple(range(0x739, 0x760, 3))
    assert ids["obstacle_c"][-1] == 0x75F
    assert ids["vehicle"] == (0x760,)
    assert ids["next_lane_a"][0] == 0x76C
    assert ids["next_lane_b"][-1] == 0x77B
    assert ids["sign"] == tuple(range(0x720, 0x727))


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


def test_messages_with_same_identifier_are_refused() -> None:
    one = '[[message]]\nname = "{}"\nabout = ""\ntable = "t"\nid = 1\nlengths = [4]\nfields = []\n'
    with pytest.raises(SchemaError, match="two messages have the same identifier"):
        parse_layout(one.format("a") + one.format("b"))


@given(
    start=st.integers(0, 63), bits=st.integers(1, 32), signed=st.booleans(), seed=st.integers(0, 99)
)
@settings(max_examples=60, deadline=None)
def test_extract_inverts_place(start: int, bits: int, signed: bool, seed: int) -> None:
    bits = min(bits, 64 - start)
    low = -(1 << (bits - 1)) if signed else 0
    raw = np.random.default_rng(seed).integers(low, low + (1 << bits), 20)
    words = place_bits(raw, start, bits, False)
    np.testing.assert_array_equal(extract(words, start, bits, signed, False), raw)
    np.testing.assert_array_equal(leading_words(payloads_of(words)), words)


def test_big_endian_numbers_are_extracted_and_placed() -> None:
    word = leading_words(np.array([[0, 0x12, 0x34, 0, 0, 0, 0, 0]], dtype=np.uint8))
    assert extract(word, 8, 16, False, True)[0] == 0x1234
    np.testing.assert_array_equal(place_bits(np.array([0x1234]), 8, 16, True), word)


@pytest.mark.parametrize("message", layout().messages, ids=lambda m: m.name)
def test_float32_values_restore_raw_values(message: Message) -> None:
    """A driver that converts values to float32 loses no step and no code for missing values."""
    rng = np.random.default_rng(1)
    for f in message.fields:
        lowest, highest = f.raw_range
        raw = np.append(rng.integers(lowest, highest + 1, 50), list(f.missing)).astype(np.int64)
        physical = (raw - f.zero) * f.scale / f.per
        as_float32 = physical.astype(np.float32).astype(np.float64)
        np.testing.assert_array_equal(from_given(f, as_float32), from_raw(f, raw))


def test_random_words_are_within_declared_ranges() -> None:
    words = random_words(layout()["obstacle_a"], 500, np.random.default_rng(0))
    x_m = values_of(layout()["obstacle_a"], words, np.full(500, -1, dtype=np.int8))["x_m"]
    assert x_m.max() <= 250.0
