"""Real buses: decoded values equal those of other decoders, and every frame is accounted for."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from cantools.database.can import Message
from cantools.database.can.formats import dbc

from crosscue.replay.can.database import CanDatabase
from crosscue.replay.can.decode import TOO_SHORT, UNKNOWN_ID, BusDecoder
from crosscue.replay.can.layout import overlapping_signals
from crosscue.replay.columns import Block, CanFrames, Table
from crosscue.replay.ledger import Ledger
from crosscue.replay.logs.opening import open_log
from support.can_layouts import comma2k19_frames, ford_frames
from support.data import shared


def canedge_frames() -> Block:
    """Return all frames of the first bus of the real CSS log in one block."""
    path = shared("can", "css_canedge", "3BA199E2", "00000164", "00000001-60FE3F04.MF4")
    with open_log(path) as log:
        blocks = [b for b in log.read(Ledger("canedge")) if b.topic == "can/1"]
    frames = [b.rows for b in blocks if isinstance(b.rows, CanFrames)]
    assert len(frames) == len(blocks)
    names = ("arbitration_id", "is_extended", "kind", "length", "data", "is_fd")
    columns = [np.concatenate([getattr(f, name) for f in frames]) for name in names]
    return Block("can/1", np.concatenate([b.log_ns for b in blocks]), CanFrames(*columns))


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
