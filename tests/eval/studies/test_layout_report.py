"""The page and the tables of the study of layouts."""

import json
import math
from pathlib import Path

import numpy as np
import pytest

from crosscue.eval.scoring.intervals import Mean
from crosscue.eval.scoring.truth import FEATURES
from crosscue.eval.studies.layouts.run import study_tables, verdict, write_layout_study
from crosscue.eval.studies.layouts.score import (
    DriveBelief,
    LayoutScores,
    score_difference,
    score_layouts,
)
from crosscue.eval.studies.layouts.settings import LayoutStudy


def beliefs(p: float) -> list[DriveBelief]:
    n = 4
    return [
        DriveBelief(
            f"M{i}-01",
            f"M{i}",
            dict.fromkeys(FEATURES, i % 2 == 0),
            np.linspace(30.0, 3.0, n),
            np.full((n, len(FEATURES)), p),
            np.full(n, False),
            np.full(n, False),
        )
        for i in range(6)
    ]


def scores() -> LayoutScores:
    first, second = beliefs(0.5), beliefs(0.95)
    less = score_difference(first, second)
    return LayoutScores(
        {"source": score_layouts(first), "temporal": score_layouts(second)},
        {"temporal less source": less},
        {"stop_sign": less},
        {"": score_layouts(first), "persistence": score_layouts(second)},
        {"persistence": less},
        6,
        6,
        {0: (0.5, 0.02)},
    )


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [
        (-0.2, -0.1, "better"),
        (0.1, 0.2, "worse"),
        (-0.1, 0.2, "undecided"),
        (math.nan, math.nan, "undecided"),
    ],
)
def test_verdict_requires_interval_without_zero(low: float, high: float, expected: str) -> None:
    assert verdict(Mean((low + high) / 2.0, low, high, 10, 5)) == expected


def test_every_table_row_has_one_entry_per_column() -> None:
    for table in study_tables(scores()):
        assert {len(row) for row in table.rows} == {len(table.head)}
        assert table.as_text().startswith(table.heading)


def test_files_state_that_study_is_simulated_and_command_to_repeat_it(tmp_path: Path) -> None:
    write_layout_study(tmp_path, LayoutStudy(), scores(), {"M3-01": "disk full"})

    tree = json.loads((tmp_path / "study.json").read_text(encoding="utf-8"))
    assert tree["is_simulated"]
    assert tree["command"].startswith("crosscue study layouts --perception pixels --blocks 8")
    assert tree["failures"] == {"M3-01": "disk full"}
    assert tree["kinds"]["source"]["brier"]["value"] == 0.25
    assert tree["perception"] == "pixels"
    page = (tmp_path / "study.html").read_text(encoding="utf-8")
    assert "networks saw rendered photographs" in page
    assert "failed M3-01: disk full" in page

    write_layout_study(tmp_path, LayoutStudy("faults"), scores(), {})
    assert "No network saw a picture" in (tmp_path / "study.html").read_text(encoding="utf-8")
