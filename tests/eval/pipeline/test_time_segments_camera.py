"""Cues, ranges and beliefs of a drive with a clock jump equal those of its separate halves."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np
import pytest
from hypothesis import Phase, example, given, settings
from hypothesis import strategies as st

from crosscue.eval import cli
from crosscue.eval.pipeline.outcome import Outcome
from crosscue.eval.runs.folder import RunFolder
from support.gap_drive import ROW, SECOND, Clock, distance_m, replay, write_drive
from support.refusals import refusal

LABELLED: Final = ("frames", "detections", "road", "cues", "range", "belief", "pose", "skipped")
NEVER_S: Final = 1e6
# Seconds of a gap that is too long to be crossed, above ``time.restart_after_s``.
RESTART_MS: Final = 5_000
ONE_ROW_MS: Final = ROW // 1_000_000


def _columns(
    outcome: Outcome, name: str, segment: int = 0, by_ms: int = 0
) -> dict[str, list[object]]:
    """Rows of a table in one segment, with the clock jump removed and counters starting at 0."""
    table = outcome.run.table(name)
    table = table.filter([number == segment for number in table["segment"].to_pylist()])
    columns: dict[str, list[object]] = table.to_pydict()
    columns["t_ns"] = (table["log_t_ns"].to_numpy() - by_ms * 1_000_000).tolist()
    for counter in columns.keys() & {"approach", "frame"}:
        numbers = table[counter].to_pylist()
        first = min((one for one in numbers if one is not None), default=0)
        columns[counter] = [None if one is None else one - first for one in numbers]
    return {key: rows for key, rows in columns.items() if key not in ("segment", "log_t_ns")}


def _assert_equal(one: dict[str, list[object]], other: dict[str, list[object]]) -> None:
    assert one.keys() == other.keys()
    for name, mine in one.items():
        if any(isinstance(value, float) for value in mine):
            ours, theirs = (np.array(rows, np.float64) for rows in (mine, other[name]))
            np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-9, err_msg=name)
        else:
            assert mine == other[name], name


@pytest.mark.slow
@settings(max_examples=4, phases=[Phase.explicit, Phase.reuse, Phase.generate])
@given(
    cut=st.integers(40, 95),
    by_ms=st.one_of(st.integers(-4_000_000, -350), st.integers(1_100, 4_000_000)),
    rows_a_block=st.sampled_from([3, 7, 50]),
)
@example(cut=60, by_ms=3_000, rows_a_block=7)
@example(cut=60, by_ms=-3_000, rows_a_block=7)
def test_tables_around_clock_jump_equal_those_of_halves(
    tmp_path: Path, cut: int, by_ms: int, rows_a_block: int
) -> None:
    cut_s = cut * ROW / SECOND

    def run(name: str, clock: Clock) -> Outcome:
        log = write_drive(tmp_path, clock, rows_a_block=rows_a_block, name=f"{name}.mcap")
        return replay(tmp_path, log, name)

    first = run("first", Clock(pause_s=(cut_s, NEVER_S)))
    second = run("second", Clock(pause_s=(0.0, cut_s)))
    jumped = run("whole", Clock(set_at_s=cut_s, by_s=by_ms / 1000))

    assert len(jumped.segments) == 2
    assert jumped.exit_status == 3
    assert jumped.travelled_m == pytest.approx(first.travelled_m + second.travelled_m, abs=1e-9)
    assert jumped.detected is not None
    assert set(jumped.detected.counts.from_cache.values()) == {140}
    assert all(_columns(half, "range")["t_ns"] for half in (first, second))
    assert all(half.scene and half.scene.positive["stop_sign"] for half in (first, second))
    for name in ("frames", "detections", "cues", "range", "belief"):
        _assert_equal(_columns(jumped, name, 0), _columns(first, name))
    restarts = by_ms < 0 or by_ms + ONE_ROW_MS > RESTART_MS
    for name in ("cues", "range", "belief") if restarts else ("detections",):
        _assert_equal(_columns(jumped, name, 1, by_ms), _columns(second, name))


@pytest.mark.parametrize("by_s", [-3600.0, -7.0, 1200.0])
def test_every_table_records_segment_and_original_stamp(tmp_path: Path, by_s: float) -> None:
    jumped = replay(tmp_path, write_drive(tmp_path, Clock(set_at_s=6.0, by_s=by_s)))

    for name in LABELLED:
        assert {"segment", "log_t_ns"} <= set(jumped.run.schema(name).names)
    frames = jumped.run.table("frames")
    assert np.all(np.diff(frames["t_ns"].to_numpy()) > 0)
    assert set(frames["segment"].to_pylist()) == {0, 1}


@pytest.mark.parametrize("pause_s", [1.5, 3.0])
def test_short_gap_keeps_approach_and_range(tmp_path: Path, pause_s: float) -> None:
    begin_s = 5.0
    log = write_drive(tmp_path, Clock(pause_s=(begin_s, begin_s + pause_s)))

    outcome = replay(tmp_path, log)

    assert len(outcome.segments) == 2
    assert outcome.scene is not None
    assert outcome.scene.counts["approaches opened"] == 1
    assert "approaches closed: stale" not in outcome.scene.counts
    assert outcome.scene.without_odometry == 1
    after = outcome.run.table("range").to_pylist()
    after = [row for row in after if row["segment"] == 1]
    # A new range would begin with the second observation; this one was carried over the gap.
    assert after[0]["t_ns"] == outcome.segments[1].start_ns
    left_m = float(distance_m(np.array([after[0]["t_ns"]]))[0])
    assert after[0]["range_m"] == pytest.approx(left_m, abs=1.0)


@pytest.mark.parametrize("line", ["max_silence_s = 9.0", "restart_after_s = 2.0"])
def test_estimate_refuses_settings_that_split_frames_differently(tmp_path: Path, line: str) -> None:
    run = replay(tmp_path, write_drive(tmp_path, Clock(pause_s=(5.0, 8.0)))).run
    before = run.file("manifest.json").read_bytes()
    other = tmp_path / "other.toml"
    other.write_text((tmp_path / "car.toml").read_text() + f"[time]\n{line}\n")

    message = refusal(2, "estimate", run.path, "--vehicle", other)
    assert f"time.{line.split()[0]}" in message
    assert "run crosscue replay again" in message
    assert run.file("manifest.json").read_bytes() == before
    assert cli.run(["estimate", str(run.path), "--vehicle", str(tmp_path / "car.toml")]) == 3


@pytest.mark.parametrize("by_s", [3.0, -3.0])
def test_estimate_keeps_segments_of_detect(tmp_path: Path, by_s: float) -> None:
    log = write_drive(tmp_path, Clock(set_at_s=6.0, by_s=by_s))
    car, run = str(tmp_path / "car.toml"), tmp_path / "run"

    assert cli.run(["detect", str(log), "--vehicle", car, "-o", str(run), "--no-cache"]) == 3
    detected = RunFolder(run).table("frames")
    assert cli.run(["estimate", str(run), "--vehicle", car]) == 3

    assert set(detected["segment"].to_pylist()) == {0, 1}
    assert RunFolder(run).table("frames").equals(detected)
    assert set(RunFolder(run).table("pose")["segment"].to_pylist()) == {0, 1}
