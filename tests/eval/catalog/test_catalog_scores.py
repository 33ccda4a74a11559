"""Scores and the truth's conditions in a catalog."""

from pathlib import Path

import pytest

import crosscue
from crosscue.eval import cli
from support.catalog_runs import add_run, approach_row, change, scene
from support.scoring import truth_folder


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write two runs, one of them scored; the truth records rain for its approach 7."""
    folder = tmp_path_factory.mktemp("fleet")
    truth = truth_folder(folder / "truth")
    scored = add_run(folder / "runs/scored", "scored")
    change(scored, scene=scene(approach_row(7, 30.0), approach_row(9, None)))
    add_run(folder / "runs/plain", "plain")
    assert cli.run(["score", str(scored.path), "--truth", str(truth), "-q"]) == 0
    return folder / "runs"


def test_scored_approach_has_conditions_and_results(runs: Path) -> None:
    rows = crosscue.catalog(runs).query(
        "select run, approach, truth, intersection, control, conditions, detected_m, "
        "detected_range_m, features_m['left'] as left_m from approaches order by run, approach"
    )

    plain, scored, extra = (list(row.values()) for row in rows.to_pylist())
    assert plain == ["plain", 7, None, None, None, None, None, 30.0, None]
    # Three frames confirm a detection: 0.95 at frame 10, 30 m away; left at frame 20.
    assert scored[:6] == ["scored", 7, 0, "A", "stop_sign", ["rain"]]
    assert scored[7:] == [30.0, 20.0]
    assert extra[:3] == ["scored", 9, None]
