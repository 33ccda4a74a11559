"""Real buses: what is decoded equals what others decoded, and every frame is accounted for."""

from __future__ import annotations

import numpy as np

from crosscue.replay.can.database import CanDatabase
from crosscue.replay.can.decode import UNKNOWN_ID, BusDecoder, DecodeSettings
from crosscue.replay.columns import Table
from crosscue.replay.ledger import Ledger
from support.can_layouts import comma2k19_frames
from support.data import shared


def test_wheel_speeds_of_a_real_drive_are_those_the_data_set_publishes() -> None:
    block = comma2k19_frames(bus=0)
    ledger = Ledger("comma2k19")
    ledger.find(block.topic, len(block))
    database = CanDatabase.load([shared("comma2k19", "toyota_2017.dbc")])
    decode = BusDecoder(
        database, block.topic, ledger, ["WHEEL_SPEEDS"], DecodeSettings(allow_longer=True)
    )

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
    account = ledger.topic(block.topic)
    assert account.used == len(wheels)
    assert account.skipped[UNKNOWN_ID] == sum(
        n for (_, _, reason), n in decode.counts.items() if reason == UNKNOWN_ID
    )
