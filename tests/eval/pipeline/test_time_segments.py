"""A drive whose clock jumps, pauses or is set back is divided into time segments."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from crosscue.eval.pipeline.outcome import Outcome
from crosscue.eval.pipeline.whole_run import replay_drive
from crosscue.eval.runs.drive import Drive
from crosscue.eval.runs.folder import create
from crosscue.localization.ekf import PoseBelief
from crosscue.localization.gap import GapSettings, cross_gap
from crosscue.localization.pose_track import start_belief
from crosscue.replay.columns import Block
from crosscue.replay.vehicle.pose import Start
from crosscue.replay.vehicle.vehicle import Vehicle
from support.memory_log import GYRO, WHEELS, MemoryLog, gyro_block, wheel_block

SECOND = 1_000_000_000
BEGIN = 1_000 * SECOND
# Ten wheel rows per second.
ROW = SECOND // 10


def _drive(seconds: int = 20, rows_a_block: int = 7) -> list[Block]:
    """Ten wheel rows and twenty gyro rows per second, of a car that speeds up and turns."""
    wheel_t = np.arange(seconds * 10) * ROW + BEGIN
    gyro_t = np.arange(seconds * 20) * (ROW // 2) + BEGIN
    wheels = [
        wheel_block(part.tolist(), (5.0 + (part - BEGIN) * 1e-10).tolist())
        for part in np.array_split(wheel_t, max(len(wheel_t) // rows_a_block, 1))
    ]
    gyros = [
        gyro_block(part.tolist(), [0.05] * len(part))
        for part in np.array_split(gyro_t, max(len(gyro_t) // (2 * rows_a_block), 1))
    ]
    return [block for pair in zip(wheels, gyros, strict=True) for block in pair]


def _moved(blocks: Sequence[Block], at_ns: int, by_ns: int) -> list[Block]:
    """Set the clock of a log by the given amount at a time."""
    return [
        Block(b.topic, np.where(b.log_ns >= at_ns, b.log_ns + by_ns, b.log_ns), b.rows)
        for b in blocks
    ]


def _part(blocks: Sequence[Block], first: int = 0, last: int = 1 << 62) -> list[Block]:
    return [b.take((b.log_ns >= first) & (b.log_ns < last)) for b in blocks]


def _replay(path: Path, blocks: Sequence[Block], vehicle: Vehicle | None = None) -> Outcome:
    log = MemoryLog((WHEELS, GYRO), [b for b in blocks if len(b)], path=Path(__file__))
    vehicle = vehicle or Vehicle(version=1, start=Start(heading_rad=0.0))
    return replay_drive(Drive([log], vehicle), create(path, overwrite=True))


@pytest.mark.slow
@settings(max_examples=10, phases=[Phase.explicit, Phase.reuse, Phase.generate])
@given(
    cut=st.integers(25, 175),
    offset_ns=st.integers(0, ROW - 1),
    by_ms=st.one_of(st.integers(-4_000_000, -350), st.integers(1_100, 4_000_000)),
    rows_a_block=st.sampled_from([3, 7, 50, 200]),
)
def test_distance_around_any_clock_jump_is_sum_of_halves(
    tmp_path: Path, cut: int, offset_ns: int, by_ms: int, rows_a_block: int
) -> None:
    blocks = _drive(rows_a_block=rows_a_block)
    cut_ns = BEGIN + cut * ROW + offset_ns
    halves = [
        _replay(tmp_path / "half", part)
        for part in (_part(blocks, last=cut_ns), _part(blocks, first=cut_ns))
    ]
    alone = [half.travelled_m for half in halves]

    jumped = _replay(tmp_path / "whole", _moved(blocks, cut_ns, by_ms * 1_000_000))

    assert len(jumped.segments) == 2
    assert jumped.travelled_m == pytest.approx(sum(alone), abs=1e-9)


@pytest.mark.parametrize("by_s", [1000, -900])
def test_single_stray_stamp_is_skipped_and_reported(tmp_path: Path, by_s: int) -> None:
    blocks = _drive(rows_a_block=50)
    stray = blocks[2].log_ns.copy()
    stray[20] += by_s * SECOND
    kept = np.arange(len(stray)) != 20

    outcome = _replay(
        tmp_path / "run", [*blocks[:2], Block("wheels", stray, blocks[2].rows), *blocks[3:]]
    )
    without = _replay(tmp_path / "without", [*blocks[:2], blocks[2].take(kept), *blocks[3:]])

    assert len(outcome.segments) == 1
    assert outcome.travelled_m == without.travelled_m
    assert outcome.ledgers[0].topic("wheels").skipped == {"stray time stamp": 1}
    assert any("is far" in sentence for sentence in outcome.ledgers[0].notices)


def _belief(speed_mps: float) -> PoseBelief:
    return start_belief(0, 0.0, 0.0, 0.0, speed_mps, 1.0, 0.01, 0.1)


@pytest.mark.parametrize("gap_s", [1.5, 4.0, 20.0, 1200.0])
def test_any_motion_in_gap_is_within_three_sigma(gap_s: float) -> None:
    limits = GapSettings()
    rng = np.random.default_rng(3)
    crossed = cross_gap(_belief(15.0), round(gap_s * 1e9), limits).belief
    for _ in range(200):
        accel = rng.uniform(-limits.max_accel_mps2, limits.max_accel_mps2)
        turn = rng.uniform(-limits.max_turn_rate_radps, limits.max_turn_rate_radps)
        time_s = np.linspace(0.0, gap_s, 2000)
        speed = np.clip(15.0 + accel * time_s, 0.0, limits.max_speed_mps)
        step_m = speed * gap_s / 2000
        xy = np.array(
            [(step_m * np.cos(turn * time_s)).sum(), (step_m * np.sin(turn * time_s)).sum()]
        )
        error = xy - crossed.mean[:2]
        assert error @ np.linalg.solve(crossed.cov[:2, :2], error) < 9.0


@pytest.mark.parametrize("by_ms", [-120, -150, -200, -250, -300])
def test_clock_set_back_by_few_rows_adds_no_distance(tmp_path: Path, by_ms: int) -> None:
    blocks = _drive()
    straight = _replay(tmp_path / "straight", blocks).travelled_m

    moved = _moved(blocks, BEGIN + 8 * SECOND, by_ms * 1_000_000)
    set_back = _replay(tmp_path / "moved", moved)

    # Wheel speeds of 5.9 m/s that overlap for up to 0.3 s cannot all be assigned.
    assert straight - 3.0 < set_back.travelled_m <= straight
