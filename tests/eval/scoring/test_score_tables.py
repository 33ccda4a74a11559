"""``crosscue.score``: the tables of a drive are scored without a run folder."""

from __future__ import annotations

import builtins
import io
import json
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest

import crosscue
from crosscue.eval.scoring.drives import ScoreSettings, as_metrics
from crosscue.eval.scoring.truth import read_scored_truth
from crosscue.replay.files.tree_text import strict_json
from support.scoring import good_truth, run_folder, truth_folder

SECTIONS = ("cues", "approaches", "belief", "range")


def _metrics(scores: object) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(strict_json(as_metrics(scores)))  # type: ignore[arg-type]
    return found


def test_scores_of_tables_are_those_of_their_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "one"
    truth_folder(folder)
    run_folder(folder / "run")
    crosscue.score_run(folder / "run", has_figures=False)
    of_run = json.loads((folder / "run" / "score" / "metrics.json").read_text())
    names = ("frames", "cues", "range", "belief")
    tables = {name: pq.read_table(folder / "run" / f"{name}.parquet") for name in names}
    truth = read_scored_truth(folder / "truth.json", str(folder / "run"))

    def closed(*_: object, **__: object) -> None:
        raise AssertionError("a file was opened")

    monkeypatch.setattr(builtins, "open", closed)
    monkeypatch.setattr(io, "open", closed)
    scores = crosscue.score(tables, truth)

    found = _metrics(scores)
    assert {name: found[name] for name in SECTIONS} == {name: of_run[name] for name in SECTIONS}


def test_what_is_missing_is_not_scored(tmp_path: Path) -> None:
    run_folder(tmp_path / "run")
    cues = pq.read_table(tmp_path / "run" / "cues.parquet")

    scores = crosscue.score({"cues": cues}, good_truth().truth, ScoreSettings(threshold=0.8))

    assert scores.cues["stop_sign"].precision.value == 1.0
    assert scores.not_scored() == {
        "approaches": "the run has no belief",
        "belief": "the run has no belief",
        "range": "the run has no range",
    }
    assert scores.settings.threshold == 0.8
