"""Mobileye frames: layout, decoding and times."""

import re
from collections import Counter
from itertools import pairwise
from math import cos, sin

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crosscue.replay.columns import Block, Int64s, Table
from crosscue.replay.errors import SchemaError
from crosscue.replay.ledger import Ledger
from crosscue.replay.mobileye.bits import extract, leading_words, payloads_of, place_bits
from crosscue.replay.mobileye.can.decode import MobileyeDecoder
from crosscue.replay.mobileye.clock import SET_ANEW, WENT_BACK, CounterClock
from crosscue.replay.mobileye.geometry import DevicePosition
from crosscue.replay.mobileye.layout import VARIANTS, describe, layout, parse_layout
from crosscue.replay.mobileye.settings import MobileyeSettings
from crosscue.replay.mobileye.wire import values_of
from support.can_layouts import frames_of
from support.mobileye_frames import MS, frames, random_drive, status, tables_of, values

ORIGIN_MOUNTING = DevicePosition()
DEVICE_FRAME = MobileyeSettings(mounting=ORIGIN_MOUNTING)


def decode(
    blocks: Block | list[Block], how: MobileyeSettings = DEVICE_FRAME
) -> tuple[dict[str, Table], Ledger]:
    """Return all tables of a log and its ledger, after checking that the ledger adds up."""
    blocks = [blocks] if isinstance(blocks, Block) else blocks
    ledger = Ledger("log")
    decoder = MobileyeDecoder("can1", ledger, how)
    decoded: list[Block] = []
    for block in blocks:
        ledger.find("can1", len(block))
        decoded += decoder(block)
    tables = tables_of([*decoded, *decoder.flush()])
    assert ledger.topic("can1").used == frames_in(tables)
    return tables, ledger


def frames_in(tables: dict[str, Table]) -> int:
    """Return the number of frames from which the rows were decoded."""
    weight = {"obstacles": 3, "lanes": 2, "next_lanes": 2}
    return sum(weight.get(name, 1) * len(table) for name, table in tables.items())


def skipped(ledger: Ledger) -> Counter[str]:
    return ledger.topic("can1").skipped


LANE = frames([status(0, 0), (0x766, "A13EFE0A80FF7F0A"), (0x767, "0D80801E")])


@pytest.mark.parametrize("yaw_rad", [0.0, 0.03])
def test_lane_is_transformed_to_vehicle_frame(yaw_rad: float) -> None:
    mounting = DevicePosition(1.7, -0.2, yaw_rad)
    in_device_frame, _ = decode(LANE)
    in_vehicle_frame, _ = decode(LANE, MobileyeSettings(mounting=mounting))

    for x_m in (0.0, 10.0, 30.0):
        y_m = cubic(in_device_frame["lanes"], x_m)
        x_vehicle_m = 1.7 + cos(yaw_rad) * x_m - sin(yaw_rad) * y_m
        y_vehicle_m = -0.2 + sin(yaw_rad) * x_m + cos(yaw_rad) * y_m
        assert cubic(in_vehicle_frame["lanes"], x_vehicle_m) == pytest.approx(y_vehicle_m, abs=1e-5)
    end_m = values(in_vehicle_frame["lanes"], "x_end_m")[0]
    range_m = values(in_device_frame["lanes"], "view_range_m")[0]
    assert end_m == pytest.approx(1.7 + range_m, abs=0.2)


def cubic(lanes: Table, x_m: float) -> float:
    c = [float(values(lanes, name)[0]) for name in ("c0_m", "c1", "c2_per_m", "c3_per_m2")]
    return c[0] + c[1] * x_m + c[2] * x_m**2 + c[3] * x_m**3


@pytest.mark.slow
@given(seed=st.integers(0, 10_000), cuts=st.lists(st.integers(0, 400), max_size=6))
@settings(max_examples=25)
def test_tables_do_not_depend_on_block_division(seed: int, cuts: list[int]) -> None:
    """This also holds for a damaged log, in which frames are missing or repeated."""
    rng = np.random.default_rng(seed)
    drive = random_drive(8, rng)
    index = np.sort(rng.choice(len(drive), size=len(drive), replace=True))
    drive = drive.take(index)
    complete, ledger = decode(drive)
    places = sorted({min(c, len(drive)) for c in cuts})
    parts = [drive.take(np.s_[a:b]) for a, b in pairwise([0, *places, len(drive)])]
    from_parts, ledger_of_parts = decode(parts)

    assert complete.keys() == from_parts.keys()
    for name, table in complete.items():
        for column in table.columns:
            np.testing.assert_array_equal(table[column], from_parts[name][column])
    assert skipped(ledger) == skipped(ledger_of_parts)
    assert ledger.topic("can1").dropped == ledger_of_parts.topic("can1").dropped


@pytest.mark.slow
@given(seed=st.integers(0, 10_000))
@settings(max_examples=25)
def test_lost_frames_never_add_a_row(seed: int) -> None:
    rng = np.random.default_rng(seed)
    drive = random_drive(10, rng)
    complete, _ = decode(drive)
    remaining, ledger = decode(drive.take(rng.random(len(drive)) > 0.2))

    all_obstacles = rows_of(complete.get("obstacles"))
    assert rows_of(remaining.get("obstacles")) <= all_obstacles
    assert rows_of(remaining.get("lanes")) <= rows_of(complete.get("lanes"))
    if len(rows_of(remaining.get("obstacles"))) < len(all_obstacles):
        assert skipped(ledger) or ledger.topic("can1").dropped


@given(seed=st.integers(0, 100_000))
def test_arbitrary_frames_are_accounted_for(seed: int) -> None:
    """Random payloads, lengths, kinds and times with ids of the table and others."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 400))
    ids = rng.choice([0x738, *range(0x739, 0x760), *range(0x766, 0x77C), *range(0x700, 0x731)], n)
    lengths = rng.choice([2, 3, 4, 6, 7, 8, 8, 8, 8], n)
    data = rng.integers(0, 256, (n, 8)) * (np.arange(8) < lengths[:, None])
    steps = rng.choice([0, MS, 70 * MS, -(10**9)], n, p=[0.3, 0.6, 0.08, 0.02])
    ids = np.where(rng.random(n) < 0.05, 0x123, ids)
    extended, kinds = rng.random(n) < 0.02, rng.choice([0, 0, 0, 0, 0, 0, 1, 2], n)
    fd = rng.random(n) < 0.02
    rows = frames_of(data.astype(np.uint8), ids, extended, lengths, kinds, fd)
    cut = n // 2
    block = Block("can1", 10**18 + np.cumsum(steps), rows)
    decode([block.take(np.s_[:cut]), block.take(np.s_[cut:])])  # checks that the ledger adds up


def rows_of(table: Table | None) -> set[tuple[str, ...]]:
    """Return the rows as text, without burst numbers and image times."""
    if table is None:
        return set()
    skip = ("burst", "t_ns")
    names = [name for name in table.columns if name not in skip]
    return set(zip(*([str(v) for v in table[name]] for name in names), strict=True))


def test_both_revisions_on_one_bus_are_a_notice() -> None:
    blocks = [frames([status(0, 0)]), frames([status(0, 66, length=7)], [66 * MS])]
    tables, ledger = decode(blocks)

    assert [VARIANTS[k] for k in tables["status"]["layout"]] == ["classic", "2.32"]
    assert any("status frames of both revisions" in n for n in ledger.notices)


def test_rows_that_are_not_can_frames_are_refused() -> None:
    decoder = MobileyeDecoder("can1", Ledger("log"))
    with pytest.raises(ValueError, match="can1: expected CanFrames, got Table"):
        decoder(Block("can1", np.zeros(0, dtype=np.int64), Table({})))


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
    assert len(rows) == sum(len(m.fields) for m in layout().values())
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


def camera(n: int, period_ms: int = 66, drift: float = 0.0) -> tuple[Int64s, Int64s]:
    """Return image times on the log's clock, and the device's counter at these times."""
    image_ns = 10**18 + np.arange(n, dtype=np.int64) * period_ms * MS
    device_ns = (np.arange(n) * period_ms * MS * (1 + drift)).astype(np.int64) + 77 * MS
    return image_ns, device_ns // MS & 0xFF


def error_without_offset(image_ns: Int64s, truth_ns: Int64s) -> Int64s:
    """Return the error minus its median, because a constant offset cannot be observed."""
    error = image_ns - truth_ns
    return error - np.int64(np.median(error))


@given(seed=st.integers(0, 1000), period_ms=st.integers(50, 110), jitter_ms=st.integers(0, 90))
def test_arrival_jitter_is_removed(seed: int, period_ms: int, jitter_ms: int) -> None:
    rng = np.random.default_rng(seed)
    image_ns, counter_ms = camera(400, period_ms)
    latency_ns = 5 * MS + rng.exponential(jitter_ms * MS / 5 + 1, 400).clip(0, jitter_ms * MS)
    log_ns = np.maximum.accumulate(image_ns + latency_ns.astype(np.int64))
    found = CounterClock().feed(counter_ms, log_ns)

    settled = np.s_[60:]
    assert np.abs(error_without_offset(found[settled], image_ns[settled])).max() <= 4 * MS
    assert (np.diff(found) >= 0).all()
    assert (found <= log_ns).all()


@given(
    counters=st.lists(st.integers(0, 255), min_size=1, max_size=60),
    steps=st.lists(st.integers(0, 3 * 10**11), min_size=60, max_size=60),
)
def test_image_times_are_ordered_and_precede_their_frames(
    counters: list[int], steps: list[int]
) -> None:
    log_ns = np.cumsum(np.array(steps[: len(counters)], dtype=np.int64))
    found = CounterClock().feed(np.array(counters), log_ns)

    assert (np.diff(found) >= 0).all()
    assert (found <= log_ns).all()
    assert (log_ns - found).max() < 256 * MS or (np.diff(found) == 0).any()


def test_device_restart_is_followed_and_reported() -> None:
    image_ns, counter_ms = camera(400)
    counter_ms = np.where(np.arange(400) < 200, counter_ms, (counter_ms - 100) & 0xFF)
    clock = CounterClock()
    found = clock.feed(counter_ms, image_ns)

    np.testing.assert_allclose(found[280:], image_ns[280:], atol=2 * MS)
    assert any(n.startswith(f"{SET_ANEW} (1 times") for n in clock.notices)


def test_log_clock_set_back_restarts_image_times() -> None:
    image_ns, counter_ms = camera(100)
    log_ns = np.where(np.arange(100) < 50, image_ns, image_ns - 10**12)
    clock = CounterClock()
    found = clock.feed(counter_ms, log_ns)

    np.testing.assert_allclose(found, log_ns, atol=MS)
    assert clock.notices == (f"{WENT_BACK} (1 times, first at {log_ns[50]} ns)",)
