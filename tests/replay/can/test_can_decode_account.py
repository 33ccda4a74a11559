"""Every frame of a bus is either decoded or counted with a reason."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crosscue.replay.can.database import CanDatabase
from crosscue.replay.can.decode import BusDecoder
from crosscue.replay.can.layout import CanMessage, CanSignal
from crosscue.replay.columns import ERROR, LENGTH_UNKNOWN, REMOTE, CanFrames
from crosscue.replay.ledger import Ledger
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
