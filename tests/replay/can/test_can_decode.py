"""CAN frames are decoded as by cantools, and all are accounted for."""

import math
from collections.abc import Callable
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
from crosscue.replay.can.decode import TOO_SHORT, UNKNOWN_ID, BusDecoder
from crosscue.replay.can.encode import encode
from crosscue.replay.can.extract import PRESENT_SUFFIX
from crosscue.replay.can.layout import (
    Arithmetic,
    CanMessage,
    CanSignal,
    is_integer,
    overlapping_signals,
)
from crosscue.replay.columns import DATA, ERROR, LENGTH_UNKNOWN, REMOTE, Block, CanFrames, Table
from crosscue.replay.ledger import Ledger
from crosscue.replay.mobileye.can.admit import Admission, all_ids
from crosscue.replay.mobileye.settings import MobileyeSettings
from support.accounted import read_topics
from support.can_layouts import (
    block_of,
    comma2k19_frames,
    dbc_text,
    ford_frames,
    frames_of,
    join,
    messages,
)
from support.data import shared

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


SPEED = CanMessage("Speed", 0x100, False, 2, (CanSignal("kph", 0, 16, scale=0.01, unit="km/h"),))
TWIN = CanMessage("Twin", 0x100, True, 2, (CanSignal("raw", 0, 16),))
LONG = CanMessage("Long", 0x200, False, 10, (CanSignal("last", 64, 16),), is_fd=True)
CLASSIC = CanMessage("Classic", 0x300, False, 8, (CanSignal("a", 0, 8),), is_fd=False)
SWITCH = CanMessage(
    "Switch",
    0x400,
    False,
    2,
    (
        CanSignal("page", 0, 8, is_multiplexer=True),
        CanSignal("zero", 8, 8, multiplexer="page", branches=frozenset({0})),
        CanSignal("two", 8, 4, multiplexer="page", branches=frozenset({2, 3})),
    ),
)
EMPTY = CanMessage("Empty", 0x500, False, 8, (), problem="message has no signals")
DATABASE = CanDatabase.of([SPEED, TWIN, LONG, CLASSIC, SWITCH, EMPTY])


def decoder(allow_longer: bool = False) -> tuple[BusDecoder, Ledger]:
    ledger = Ledger("made up")
    return BusDecoder(DATABASE, "can0", ledger, None, allow_longer=allow_longer), ledger


def test_number_of_counted_unknown_ids_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("crosscue.replay.can.decode.COUNTS_KEPT", 10)
    decode, ledger = decoder()
    ids = np.arange(1000, 1100, dtype=np.uint32)

    decode(block_of(frames_of(np.zeros((100, 2), np.uint8), ids, is_extended=True)))

    assert len(decode.counts) == 11
    assert sum(decode.counts.values()) == 100 == ledger.topic("can0").skipped.total()


IDS = st.sampled_from([0x100, 0x101, 0x200, 0x300, 0x400, 0x500])


@given(
    rows=st.lists(
        st.tuples(
            IDS,
            st.booleans(),
            st.sampled_from([0, 0, 0, REMOTE, ERROR]),
            st.sampled_from([0, 1, 2, 3, 8, 10, 12, 64, LENGTH_UNKNOWN]),
            st.integers(0, 4),
            st.booleans(),
        ),
        max_size=60,
    ),
    allow_longer=st.booleans(),
)
@settings(max_examples=60)
def test_every_frame_is_decoded_or_counted(
    rows: list[tuple[int, bool, int, int, int, bool]], allow_longer: bool
) -> None:
    ids, extended, kinds, lengths, first, fd = np.array(rows, np.int64).reshape(-1, 6).T
    data = np.zeros((len(rows), 64), dtype=np.uint8)
    data[:, 0] = first
    frames = frames_of(data, ids, extended, lengths, kinds, fd)
    decode, ledger = decoder(allow_longer)
    ledger.find("can0", len(rows))

    blocks = decode(block_of(frames))

    account = ledger.topic("can0")
    assert account.used == sum(map(len, blocks))
    assert sum(decode.counts.values()) == account.skipped.total()
    times = np.sort(np.concatenate([np.zeros(0, np.int64), *(b.log_ns for b in blocks)]))
    assert len(np.unique(times)) == account.used


def canedge_frames() -> Block:
    """Return all frames of the first bus of the real CSS log in one block."""
    path = shared("can", "css_canedge", "3BA199E2", "00000164", "00000001-60FE3F04.MF4")
    return join(read_topics(path)[0]["can/1"])


BUSES: dict[str, tuple[tuple[str, ...], Callable[[], Block]]] = {
    "toyota": (("comma2k19", "toyota_2017.dbc"), lambda: comma2k19_frames(0)),
    "toyota radar": (("comma2k19", "toyota_adas.dbc"), lambda: comma2k19_frames(1)),
    "ford": (("can", "ford_fusion_2017", "ford_fusion_2018_pt.dbc"), ford_frames),
    "canedge": (("can", "css_canedge", "canmod-gps.dbc"), canedge_frames),
    "canedge, names repeated": (("can", "css_canedge", "gnss.dbc"), canedge_frames),
    "ford, all": (("can", "ford_fusion_2017", "ford_lincoln_base_pt.dbc"), ford_frames),
}


def test_wheel_speeds_of_real_drive_equal_published_values() -> None:
    block = comma2k19_frames(bus=0)
    ledger = Ledger("comma2k19")
    ledger.find(block.topic, len(block))
    database = CanDatabase.load([shared("comma2k19", "toyota_2017.dbc")])
    decode = BusDecoder(database, block.topic, ledger, ["WHEEL_SPEEDS"], allow_longer=True)

    (wheels,) = decode(block)

    published = np.load(
        shared(
            *("comma2k19", "Example_1", "b0c9d2329ad1606b_2018-08-02--08-34-47", "40"),
            *("processed_log", "CAN", "wheel_speed", "value"),
        ),
        allow_pickle=False,
    )
    assert wheels.topic == f"{block.topic}/WHEEL_SPEEDS"
    assert isinstance(wheels.rows, Table)
    assert wheels.rows.units["WHEEL_SPEED_FL"] == "km/h"
    names = [f"WHEEL_SPEED_{corner}" for corner in ("FL", "FR", "RL", "RR")]
    ours_mps = np.stack([wheels.rows[name] for name in names], axis=1).astype(float) / 3.6
    np.testing.assert_allclose(ours_mps, published[: len(ours_mps)], atol=1e-9)
    assert ledger.topic(block.topic).used == len(wheels)


@pytest.mark.slow
@pytest.mark.parametrize("bus", sorted(BUSES))
def test_decodable_frames_of_real_bus_equal_cantools(bus: str) -> None:
    parts, read = BUSES[bus]
    path, block = shared(*parts), read()
    ledger = Ledger(bus)
    ledger.find(block.topic, len(block))
    database = CanDatabase.load([path])
    decode = BusDecoder(database, block.topic, ledger, allow_longer=True)

    blocks = {b.topic.removeprefix(f"{block.topic}/"): b for b in decode(block)}

    theirs = {
        (m.frame_id, m.is_extended_frame): m
        for m in dbc.load_string(path.read_text(encoding="utf-8"), False).messages
    }
    compared = 0
    for message in database.messages:
        rows = rows_of(block, message.arbitration_id, message.is_extended, message.length)
        if message.problem or not len(rows):
            continue
        ours = blocks[message.topic_name]
        assert len(ours) == len(rows)
        compared += len(rows)
        for one in split_messages(theirs[message.key], any(overlapping_signals(message))):
            assert_same_columns(ours, one, rows)
    assert compared == sum(map(len, blocks.values())) == ledger.topic(block.topic).used
    assert set(ledger.topic(block.topic).skipped) <= {UNKNOWN_ID, TOO_SHORT}
    assert sum(decode.counts.values()) == len(block) - compared


def split_messages(message: Message, has_overlaps: bool) -> list[Message]:
    """Return the message, or one per signal, because cantools shifts signals after an overlap."""
    if not has_overlaps:
        return [message]
    return [
        Message(message.frame_id, message.name, message.length, [signal], strict=True)
        for signal in message.signals
    ]


def rows_of(block: Block, arbitration_id: int, is_extended: bool, length: int) -> CanFrames:
    frames = block.rows
    assert isinstance(frames, CanFrames)
    return frames.take(
        (frames.arbitration_id == arbitration_id)
        & (frames.is_extended == is_extended)
        & (frames.length >= length)
    )


def assert_same_columns(ours: Block, theirs: Message, frames: CanFrames) -> None:
    # Every frame with new bytes; a frame with repeated bytes cannot differ.
    _, first, inverse = np.unique(frames.data, axis=0, return_index=True, return_inverse=True)
    assert isinstance(ours.rows, Table)
    decoded = [theirs.decode_simple(frames.data[i].tobytes(), decode_choices=False) for i in first]
    for name in theirs.signal_tree:
        assert isinstance(name, str)
        # NumPy 2.0 returns a column here, 2.1 a row.
        expected = np.array([row[name] for row in decoded])[inverse.reshape(-1)]
        np.testing.assert_array_equal(ours.rows[name], expected)


TWIN_BUS = CanMessage("Twin", 0x739, True, 8, (CanSignal("raw", 0, 16),))
TEN_SLOTS = MobileyeSettings(slots=10, is_shared_bus=True)
FRAME = st.tuples(
    # Frames of the car, of an unknown device, the first obstacle, and slot 11, beyond the ten.
    st.sampled_from([0x100, 0x123, 0x738, 0x739, 0x757]),
    st.sampled_from([DATA, DATA, DATA, REMOTE, ERROR]),
    st.booleans(),
    st.booleans(),
    st.sampled_from([0, 2, 7, 8]),
)


@given(frames=st.lists(FRAME, min_size=1, max_size=30))
def test_each_frame_is_accounted_for_by_exactly_one_decoder(
    frames: list[tuple[int, int, bool, bool, int]],
) -> None:
    ids, kinds, extended, fd, lengths = (np.array(column) for column in zip(*frames, strict=True))
    data = np.zeros((len(frames), 8), np.uint8)
    rows = frames_of(data, ids, extended, lengths, kinds, fd)
    log_ns = np.arange(len(frames), dtype=np.int64)
    ledger = Ledger("made up")
    car = BusDecoder(
        CanDatabase.of([SPEED, TWIN_BUS]), "can0", ledger, elsewhere=all_ids(TEN_SLOTS)
    )

    decoded = sum(len(block) for block in car(Block("can0", log_ns, rows)))
    admitted = len(Admission("can0", ledger, TEN_SLOTS)(rows, log_ns))

    assert decoded + admitted + ledger.topic("can0").skipped.total() == len(frames)
