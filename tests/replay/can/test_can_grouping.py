"""Searching for each message and sorting all frames yield equal groups and equal columns."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np
import pytest

from crosscue.replay.can import grouping
from crosscue.replay.can.database import CanDatabase
from crosscue.replay.can.decode import BusDecoder
from crosscue.replay.columns import Block, CanFrames, Table
from crosscue.replay.ledger import Ledger

IDS: Final = (256, 257, 258)


def _database(folder: Path) -> CanDatabase:
    lines = [f'BO_ {one} M{one}: 8 X\n SG_ S{one} : 0|16@1+ (0.5,0) [0|0] "" X\n' for one in IDS]
    (folder / "car.dbc").write_text('VERSION ""\n\nBU_: X\n\n' + "\n".join(lines))
    return CanDatabase.load([folder / "car.dbc"])


def _frames(count: int) -> CanFrames:
    """Return shuffled frames of all kinds, with known and unknown identifiers."""
    rng = np.random.default_rng(7)
    identifier = rng.choice(np.array([*IDS, 5, 0x12345], np.uint32), count)
    return CanFrames(
        identifier,
        identifier > 0x7FF,
        rng.choice(np.array([0, 0, 0, 1, 2], np.uint8), count),
        np.full(count, 8, np.uint8),
        rng.integers(0, 256, (count, 8), np.uint8),
        np.zeros(count, np.bool_),
        rng.random(count) > 0.5,
    )


@pytest.mark.parametrize("few_limit", [0, 1000])
def test_sorting_and_searching_yield_same_rows(
    few_limit: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = {}
    for name, limit in (("wanted", grouping.FEW), ("other", few_limit)):
        monkeypatch.setattr(grouping, "FEW", limit)
        ledger = Ledger("log")
        decoder = BusDecoder(_database(tmp_path), "/can", ledger)
        frames = _frames(4000)
        blocks = decoder(Block("/can", np.arange(4000), frames))
        rows = {
            one.topic: (one.log_ns.tolist(), [c.tolist() for c in one.rows.columns.values()])
            for one in blocks
            if isinstance(one.rows, Table)
        }
        found[name] = (rows, decoder.counts)

    assert found["wanted"][0].keys() == {f"/can/M{one}" for one in IDS}
    assert sum(found["wanted"][1].values()) > 1000
    assert found["wanted"] == found["other"]


@pytest.mark.parametrize("rows_taken", [np.array([3, 1, 1]), np.arange(40) % 3 == 0, slice(2, 9)])
def test_taken_rows_keep_every_column(rows_taken: object) -> None:
    frames = _frames(40)

    taken = frames.take(rows_taken)  # type: ignore[arg-type]

    for name in ("is_extended", "kind", "is_fd", "is_tx", "arbitration_id", "length", "data"):
        assert np.array_equal(getattr(taken, name), getattr(frames, name)[rows_taken]), name
        assert getattr(taken, name).dtype == getattr(frames, name).dtype
