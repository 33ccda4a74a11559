"""Charts and recordings of a drive with gaps show the gaps and draw no line across them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure
from rerun.chunk import RrdReader

from crosscue.eval.drives.score import ScoreWork
from crosscue.eval.recording import save_rrd
from crosscue.eval.runs.folder import RunFolder
from crosscue.eval.runs.tables.log_time import ClockGap, gaps_of
from crosscue.eval.scoring.drives import ScoreSettings
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


def test_report_shades_each_gap_with_its_duration(
    paused: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    figures: list[Figure] = []
    draw = Figure.savefig

    def kept(figure: Figure, *args: Any, **more: Any) -> None:
        figures.append(figure)
        draw(figure, *args, **more)

    monkeypatch.setattr(Figure, "savefig", kept)
    work = ScoreWork(paused.path.parent / "truth.json", ScoreSettings(), (10.0,))
    page = work(paused.path).report.read_text()

    assert page.count('class="bar s0"') == 2, "the sign's lane, before and after"
    assert page.count('class="gap"') == 2, "belief and range"
    assert page.count(">gap of 2.2 s</text>") == 2
    over_time = [f.axes[0] for f in figures if "time" in f.axes[0].get_xlabel()]
    assert len(over_time) == 3
    for axes in over_time:
        assert [text.get_text() for text in axes.texts] == ["gap of 2.2 s"]
        assert np.isnan(np.asarray(axes.lines[0].get_xdata(), np.float64)).sum() == 1
    (by_way,) = [f.axes[0] for f in figures if "travelled" in f.axes[0].get_xlabel()]
    assert np.isnan(np.asarray(by_way.lines[0].get_ydata(), np.float64)).sum() == 1
