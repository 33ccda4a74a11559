"""Every frame of a bus is either decoded or counted with a reason."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crosscue.replay.can.database import CanDatabase
from crosscue.replay.can.decode import (
    ERROR_FRAME,
    NO_BRANCH,
    REMOTE_FRAME,
    TOO_LONG,
    TOO_SHORT,
    UNKNOWN_ID,
    WRONG_FORMAT,
    BusDecoder,
)
from crosscue.replay.can.layout import CanMessage, CanSignal
from crosscue.replay.columns import ERROR, LENGTH_UNKNOWN, REMOTE, Block, CanFrames, Table
from crosscue.replay.ledger import NOT_ASKED_TOPIC, Ledger
from support.can_layouts import block_of, frames_of

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


def decoder(
    allow_longer: bool = False, selected: list[str] | None = None
) -> tuple[BusDecoder, Ledger]:
    ledger = Ledger("made up")
    return BusDecoder(DATABASE, "can0", ledger, selected, allow_longer=allow_longer), ledger


def one_frame(
    arbitration_id: int,
    payload: bytes,
    *,
    is_extended: bool = False,
    kind: int = 0,
    is_fd: bool = False,
    length: int | None = None,
) -> CanFrames:
    data = np.zeros((1, 64), dtype=np.uint8)
    data[0, : len(payload)] = list(payload)
    payload_length = np.array([len(payload) if length is None else length], dtype=np.uint8)
    frames = frames_of(data, arbitration_id, is_extended, payload_length)
    return replace(
        frames, kind=np.array([kind], dtype=np.uint8), is_fd=np.array([is_fd], dtype=np.bool_)
    )


@pytest.mark.parametrize(
    ("frame", "reason"),
    [
        (one_frame(0x101, b"\0\0"), UNKNOWN_ID),
        (one_frame(0x200, bytes(12), is_extended=True, is_fd=True), UNKNOWN_ID),
        (one_frame(0x100, b"\0"), TOO_SHORT),
        (one_frame(0x100, b"\0\0\0"), TOO_LONG),
        (one_frame(0x100, b"\0\0", kind=REMOTE), REMOTE_FRAME),
        (one_frame(0x100, b"\0\0", kind=ERROR), ERROR_FRAME),
        (one_frame(0x300, bytes(8), is_fd=True), WRONG_FORMAT),
        (one_frame(0x200, bytes(16), is_fd=True), TOO_LONG),
        (one_frame(0x400, b"\1\0"), NO_BRANCH),
        (one_frame(0x500, bytes(8)), "message has no signals"),
    ],
)
def test_undecodable_frame_is_counted_by_id_and_reason(frame: CanFrames, reason: str) -> None:
    decode, ledger = decoder()
    ledger.find("can0", 3)

    for _ in range(3):
        assert decode(block_of(frame)) == []

    key = (int(frame.arbitration_id[0]), bool(frame.is_extended[0]), reason)
    assert decode.counts == {key: 3}
    assert dict(ledger.topic("can0").skipped) == {reason: 3}
    assert ledger.topic("can0").used == 0
    (detail,) = ledger.details
    assert f"0x{key[0]:03X}"[2:] in detail.detail


def test_11_and_29_bit_ids_are_different_messages() -> None:
    decode, _ = decoder()

    (plain,) = decode(block_of(one_frame(0x100, b"\x10\x27")))
    (extended,) = decode(block_of(one_frame(0x100, b"\x10\x27", is_extended=True)))

    assert plain.topic == "can0/Speed"
    assert extended.topic == "can0/Twin"
    assert isinstance(plain.rows, Table)
    assert plain.rows["kph"].tolist() == [100.0]
    assert plain.rows.units == {"kph": "km/h"}


def test_padded_fd_frame_is_decoded() -> None:
    decode, _ = decoder()
    payload = bytes([0] * 8 + [1, 2, 0xFF, 0xFF])

    (block,) = decode(block_of(one_frame(0x200, payload, is_fd=True)))

    assert isinstance(block.rows, Table)
    assert block.rows["last"].tolist() == [0x0201]


def test_longer_frames_are_decoded_with_allow_longer() -> None:
    decode, ledger = decoder(allow_longer=True)

    (block,) = decode(block_of(one_frame(0x100, b"\x64\0\xff\xff")))

    assert isinstance(block.rows, Table)
    assert block.rows["kph"].tolist() == [1.0]
    assert not ledger.topic("can0").skipped


def test_frames_of_unknown_length_are_decoded_if_payload_fits() -> None:
    decode, _ = decoder()
    lost = np.full(1, LENGTH_UNKNOWN, dtype=np.uint8)
    payload = np.zeros((1, 8), dtype=np.uint8)

    (block,) = decode(block_of(frames_of(payload, 0x100, length=lost)))
    nothing = decode(block_of(frames_of(payload, 0x200, length=lost)))

    assert block.topic == "can0/Speed"
    assert nothing == []
    assert decode.counts == {(0x200, False, TOO_SHORT): 1}


def test_signals_of_inactive_branches_are_nan() -> None:
    decode, _ = decoder()
    payload = np.array([[0, 7], [9, 9], [3, 0x15], [0, 8]], dtype=np.uint8)

    (block,) = decode(block_of(frames_of(payload, 0x400)))

    assert isinstance(block.rows, Table)
    assert block.log_ns.tolist() == [0, 2_000_000, 3_000_000]
    np.testing.assert_array_equal(block.rows["zero"], [7.0, np.nan, 8.0])
    np.testing.assert_array_equal(block.rows["two"], [np.nan, 5.0, np.nan])
    assert decode.counts == {(0x400, False, NO_BRANCH): 1}


def test_unselected_messages_are_counted_as_skipped() -> None:
    decode, ledger = decoder(selected=["Speed"])
    plain_and_extended = frames_of(np.zeros((4, 2), np.uint8), 0x100)
    plain_and_extended = replace(
        plain_and_extended, is_extended=np.array([False, True, False, True])
    )

    (block,) = decode(block_of(plain_and_extended))

    assert block.topic == "can0/Speed"
    assert block.log_ns.tolist() == [0, 2_000_000]
    assert dict(ledger.topic("can0").skipped) == {NOT_ASKED_TOPIC: 2}
    assert decode.counts == {(0x100, True, NOT_ASKED_TOPIC): 2}
    assert not ledger.details


def test_single_signals_can_be_selected() -> None:
    decode = BusDecoder(DATABASE, "can0", Ledger("made up"), [("Switch", "two")])

    (block,) = decode(block_of(frames_of(np.array([[2, 0xA5]], np.uint8), 0x400)))

    assert isinstance(block.rows, Table)
    assert {name: column.tolist() for name, column in block.rows.columns.items()} == {"two": [5.0]}
    with pytest.raises(ValueError, match="Switch has no signal 'tow'; there are: page, zero, two"):
        BusDecoder(DATABASE, "can0", Ledger("made up"), [("Switch", "tow")])
    with pytest.raises(ValueError, match="no message 'Sped' among 6; did you mean Speed"):
        BusDecoder(DATABASE, "can0", Ledger("made up"), ["Sped"])


def test_decoded_rows_keep_all_timestamps() -> None:
    decode, _ = decoder()
    frames = frames_of(np.zeros((3, 2), np.uint8), np.array([0x100, 0x101, 0x100], np.uint32))
    log_ns = np.array([5, 6, 7], dtype=np.int64)
    block = Block("can0", log_ns, frames, publish_ns=log_ns + 10, header_ns=log_ns + 20)

    (speed,) = decode(block)

    assert speed.log_ns.tolist() == [5, 7]
    assert speed.publish_ns is not None
    assert speed.publish_ns.tolist() == [15, 17]
    assert speed.header_ns is not None
    assert speed.header_ns.tolist() == [25, 27]


def test_strided_read_only_frames_are_decoded() -> None:
    decode, _ = decoder()
    payload = np.arange(8, dtype=np.uint8).reshape(4, 2)
    frames = frames_of(payload, np.array([0x100, 0x101, 0x100, 0x101], np.uint32)).take(
        slice(None, None, 2)
    )
    for column in (frames.arbitration_id, frames.length, frames.data):
        column.flags.writeable = False

    (block,) = decode(block_of(frames))

    assert isinstance(block.rows, Table)
    np.testing.assert_allclose(block.rows["kph"].astype(float), [2.56, 12.84])


def test_number_of_counted_unknown_ids_is_bounded(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
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
@settings(max_examples=60, deadline=None)
def test_every_frame_is_decoded_or_counted(
    rows: list[tuple[int, bool, int, int, int, bool]], allow_longer: bool
) -> None:
    columns = (
        [np.array(column) for column in zip(*rows, strict=True)] if rows else [np.zeros(0)] * 6
    )
    data = np.zeros((len(rows), 64), dtype=np.uint8)
    data[:, 0] = columns[4]
    frames = CanFrames(
        arbitration_id=columns[0].astype(np.uint32),
        is_extended=columns[1].astype(np.bool_),
        kind=columns[2].astype(np.uint8),
        length=columns[3].astype(np.uint8),
        data=data,
        is_fd=columns[5].astype(np.bool_),
    )
    decode, ledger = decoder(allow_longer)
    ledger.find("can0", len(rows))

    blocks = decode(block_of(frames))

    account = ledger.topic("can0")
    assert account.used == sum(map(len, blocks))
    assert sum(decode.counts.values()) == account.skipped.total()
    times = np.sort(np.concatenate([np.zeros(0, np.int64), *(b.log_ns for b in blocks)]))
    assert len(np.unique(times)) == account.used


def test_rows_that_are_not_can_frames_are_refused() -> None:
    decode, _ = decoder()
    table = Block("can0", np.zeros(1, np.int64), Table({"a": np.zeros(1)}))

    with pytest.raises(ValueError, match="can0: expected CanFrames, got Table"):
        decode(table)
