"""The pitch of the camera in a report, and its steps."""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

import numpy as np
import pyarrow as pa
import pytest

from crosscue.eval.report import page
from crosscue.eval.runs.folder import RunFolder


class Run:
    """A run with a table of visual odometry."""

    def __init__(self, folder: Path, step_rad: float) -> None:
        rng = np.random.default_rng(1)
        t_s = np.arange(0.0, 40.0, 0.1)
        pitch = 0.02 + step_rad * (t_s > 20.0) + 5e-4 * rng.normal(size=len(t_s))
        self._columns = {
            "t_ns": np.round(t_s * 1e9).astype(np.int64),
            "pitch_rad": pitch,
            "is_standing": np.zeros(len(t_s), np.bool_),
        }
        self._file = folder / "visual_odometry.parquet"
        self._file.touch()

    def file(self, name: str) -> Path:
        """Path of the table."""
        return self._file

    def table(self, name: str, columns: Any) -> pa.Table:
        """The table."""
        return pa.table(self._columns)


@pytest.mark.parametrize("step_deg", [0.0, 0.5])
def test_report_names_a_step_of_the_pitch_and_lists_ten_seconds_each(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step_deg: float
) -> None:
    monkeypatch.setattr(page, "span_ns", lambda run: (0, 40_000_000_000))
    run = cast("RunFolder", Run(tmp_path, np.radians(step_deg)))

    windows, steps = page._pitch(run)

    assert [one.partition(":")[0] for one in windows] == [
        "0 to 10 s",
        "10 to 20 s",
        "20 to 30 s",
        "30 to 40 s",
    ]
    assert "+1.15 +-" in windows[0]
    assert [one.rpartition(" at ")[2] for one in steps] == (["20 s"] if step_deg else [])
