"""Charts and recordings of a drive with gaps show the gaps and draw no line across them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rerun.chunk import RrdReader

from crosscue.eval.recording import save_rrd
from crosscue.eval.report.opening import opening_of
from crosscue.eval.runs.folder import RunFolder
from crosscue.eval.runs.moments import moment_ns
from crosscue.eval.runs.tables.log_time import ClockGap, gaps_of
from support.gap_drive import Clock, replayed, write_drive

PAUSE = Clock(pause_s=(5.0, 7.1))


@pytest.fixture(scope="module")
def paused(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    folder = tmp_path_factory.mktemp("paused")
    return replayed(folder, write_drive(folder, PAUSE))


def _rows(path: Path, entity: str, component: str) -> list[tuple[int, Any]]:
    """Return time and value of each row of an entity of a recording."""
    found: list[tuple[int, Any]] = []
    for chunk in RrdReader(path).stream():
        if chunk.entity_path == entity and not chunk.is_static:
            batch = chunk.to_record_batch()
            name = next(n for n in batch.schema.names if n.endswith(component))
            times = batch["drive"].cast("int64").to_pylist()
            found += zip(times, batch[name].to_pylist(), strict=True)
    return sorted(found, key=lambda row: row[0])


def _crosses(rows: Sequence[tuple[int, Any]], gap: ClockGap) -> bool:
    """Return True if a line crosses the gap."""
    before = [value for t_ns, value in rows if t_ns < gap.middle_ns]
    return bool(np.isfinite(before[-1][0]))


def test_lines_of_a_recording_break_at_gaps(paused: RunFolder, tmp_path: Path) -> None:
    path = tmp_path / "run.rrd"
    save_rrd(paused, path)

    (gap,) = gaps_of(paused.drive_manifest().timeline)
    lines = [
        "/plots/belief/intersection",
        "/plots/range/start",
        "/plots/speed/speed_mps",
        "/plots/heading/heading_deg",
        "/plots/ellipse/major_axis_m",
    ]
    for entity in lines:
        rows = _rows(path, entity, "scalars")
        assert len(rows) > 50, entity
        assert not _crosses(rows, gap), entity
    states = _rows(path, "/cues/stop_sign", "state")
    assert [bool(value) for t_ns, value in states if t_ns < gap.middle_ns][-1] is False
    strips = [
        chunk.to_record_batch()
        for chunk in RrdReader(path).stream()
        if chunk.entity_path == "/plan/estimate"
    ]
    name = next(n for n in strips[0].schema.names if n.endswith("strips"))
    assert len(strips[0][name].to_pylist()[0]) == 2


def test_moments_of_a_drive_whose_clock_was_set_have_pictures_and_open(tmp_path: Path) -> None:
    run = replayed(tmp_path, write_drive(tmp_path, Clock(set_at_s=3.0, by_s=-3600.0)))

    opening = opening_of(run, 0.9)

    assert opening.moments
    assert all(one.picture for one in opening.moments), opening.missing
    frames = set(run.table("frames")["t_ns"].to_pylist())
    for one in opening.moments:
        assert one.t_ns in frames
        assert moment_ns(run, f"{one.at_s:.3f}") == pytest.approx(one.t_ns, abs=1e6)
