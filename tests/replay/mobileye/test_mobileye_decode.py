"""Frames of a bus are decoded to tables; only frames of one image are joined."""

from __future__ import annotations

from collections import Counter
from itertools import pairwise
from math import cos, sin

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crosscue.replay.columns import Block, CanFrames, Table
from crosscue.replay.ledger import Ledger
from crosscue.replay.mobileye.can.decode import MobileyeDecoder
from crosscue.replay.mobileye.geometry import DevicePosition
from crosscue.replay.mobileye.layout import VARIANTS
from crosscue.replay.mobileye.settings import MobileyeSettings
from support.mobileye_frames import MS, frames, random_drive, status, values

ORIGIN_MOUNTING = DevicePosition()
DEVICE_FRAME = MobileyeSettings(mounting=ORIGIN_MOUNTING)


def decode(
    blocks: Block | list[Block], how: MobileyeSettings = DEVICE_FRAME
) -> tuple[dict[str, Table], Ledger]:
    """Return all tables of a log and its ledger, after checking that the ledger adds up."""
    blocks = [blocks] if isinstance(blocks, Block) else blocks
    ledger = Ledger("log")
    decoder = MobileyeDecoder("can1", ledger, how)
    decoded_blocks: list[Block] = []
    for block in blocks:
        ledger.find("can1", len(block))
        decoded_blocks += decoder(block)
    decoded_blocks += decoder.flush()
    tables: dict[str, list[Table]] = {}
    for block in decoded_blocks:
        assert isinstance(block.rows, Table)
        tables.setdefault(block.topic.removeprefix("can1/mobileye/"), []).append(block.rows)
    complete = {name: stack(parts) for name, parts in tables.items()}
    assert ledger.topic("can1").used == frames_in(complete)
    return complete, ledger


def stack(parts: list[Table]) -> Table:
    names = list(parts[0].columns)
    assert all(list(part.columns) == names for part in parts)
    return Table({name: np.concatenate([part[name] for part in parts]) for name in names})


def frames_in(tables: dict[str, Table]) -> int:
    """Return the number of frames from which the rows were decoded."""
    weight = {"obstacles": 3, "lanes": 2, "next_lanes": 2}
    return sum(weight.get(name, 1) * len(table) for name, table in tables.items())


def skipped(ledger: Ledger) -> Counter[str]:
    return ledger.topic("can1").skipped


LEFT_LANE = [(0x766, "A13EFE0A80FF7F0A"), (0x767, "0D80801E")]


@pytest.mark.parametrize("yaw_rad", [0.0, 0.03])
def test_lane_is_transformed_to_vehicle_frame(yaw_rad: float) -> None:
    mounting = DevicePosition(1.7, -0.2, yaw_rad)
    in_device_frame, _ = decode(frames([status(0, 0), *LEFT_LANE]))
    in_vehicle_frame, _ = decode(
        frames([status(0, 0), *LEFT_LANE]), MobileyeSettings(mounting=mounting)
    )

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
    rows = CanFrames(
        np.where(rng.random(n) < 0.05, 0x123, ids).astype(np.uint32),
        rng.random(n) < 0.02,
        rng.choice([0, 0, 0, 0, 0, 0, 1, 2], n).astype(np.uint8),
        lengths.astype(np.uint8),
        data.astype(np.uint8),
        rng.random(n) < 0.02,
    )
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
