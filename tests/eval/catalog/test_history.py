"""A metric over versions, on the page and in the command's output."""

import os
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from crosscue.eval import cli
from crosscue.eval.runs.folder import RunFolder
from crosscue.eval.runs.tags import write_tags
from crosscue.eval.scoring.by_drive import DriveMetric
from support.catalog_runs import scored_run
from support.commands import output_of
from support.refusals import refusal
from support.scoring import log_row

RECALL, BRIER = "cues.stop_sign.recall", "belief.left.brier"
MODELS = ("m0", "m1", "m2", "m3")


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eight drives with four models, the third of which finds fewer signs; one run has no score."""
    folder = tmp_path_factory.mktemp("fleet")
    rng = np.random.default_rng(2)
    for at, model in enumerate(MODELS):
        for drive in range(8):
            path = folder / f"{9 - at}-{drive}"
            log = folder / f"drive{drive}.mcap"
            log.write_text(f"drive {drive}")
            right = 70.0 + 2.0 * drive + rng.integers(0, 3) - 15.0 * (at >= 2)
            parts = [
                DriveMetric(f"drive {drive}", RECALL, "mean", right, 100),
                DriveMetric(f"drive {drive}", BRIER, "mean", 5.0 + rng.normal(), 100),
                DriveMetric(f"drive {drive}", "cues.stop_sign.positives", "sum", 9.0, 1),
            ]
            run = scored_run(path, parts, logs=(log_row(log, RunFolder(path)),))
            os.utime(run.path / "manifest.json", (1.7e9 + at, 1.7e9 + at))
            write_tags(run.path, {"model": model})
    shutil.rmtree(run.path / "score")
    return folder


def test_page_plots_each_metric_and_marks_its_changes(fleet: Path, tmp_path: Path) -> None:
    page = tmp_path / "history.html"

    printed = output_of("history", fleet, "--by", "model", "-o", page)
    assert re.search(rf"WORSE +{re.escape(RECALL)}: 0\.7\d+ -> 0\.6\d+ from model m2 on", printed)
    assert "2 metrics over 4 models; 1 changed" in printed
    assert "left out   1 run without a score" in printed
    text = page.read_text()
    assert f"{RECALL} m2 worse" in " ".join(re.sub("<[^>]*>", " ", text).split())
    assert text.count("<svg") == 2
    assert not re.search("<(script|link|img|iframe)", text)
    first = page.read_bytes()
    assert cli.run(["history", str(fleet), "--by", "model", "-o", str(page)]) == 1
    argv = ["history", str(fleet), "--by", "model", "-o", str(page), "--overwrite", "-q"]
    assert cli.run(argv) == 0
    assert page.read_bytes() == first


@pytest.mark.parametrize(
    ("words", "status", "message"),
    [
        (["--by", "no_such_tag"], 1, "no scored run of 32 has a no_such_tag"),
        (["--by", "it's"], 1, "no scored run of 32 has a it's"),
        (["--by", "model", "--metrics", "x.*"], 1, "no judged metric fits x.*"),
    ],
)
def test_history_without_matching_runs_or_metrics_is_refused(
    fleet: Path, words: list[str], status: int, message: str
) -> None:
    assert message in refusal(status, "history", fleet, *words)
