"""Metrics compared by drive: the direction of each, and those that are no longer scored."""

import json
from collections.abc import Mapping
from typing import Any, Final

import pytest

from crosscue.eval import cli
from crosscue.eval.catalog.paired import compare_drives
from crosscue.eval.scoring.by_drive import DriveMetric, drive_contributions, no_longer_scored
from support.scoring import (
    belief_table,
    cue_table,
    frame_table,
    range_table,
    run_folder,
    truth_folder,
)

DRIVES: Final = 8


@pytest.fixture(scope="module")
def scores(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Scores of a generated drive with a sign, a belief and ranges."""
    folder = tmp_path_factory.mktemp("drive")
    truth_folder(folder)
    tables = {
        "frames": frame_table(50),
        "cues": cue_table({"stop_sign": {frame: int(frame >= 10) for frame in range(40)}}),
        "belief": belief_table({"intersection": {10: 0.95}, "left": {20: 0.95}, "right": {}}),
        "range": range_table(8, 45, 0.5),
    }
    run = run_folder(folder / "run", tables)
    assert cli.run(["score", str(run.path), "-q"]) == 0
    tree: dict[str, Any] = json.loads((run.path / "score" / "metrics.json").read_text())
    return tree


def fleet(tree: Mapping[str, Any]) -> list[DriveMetric]:
    """Return metrics of several drives that all have the same scores."""
    return [
        one
        for i in range(DRIVES)
        for one in drive_contributions(f"drive {i}", tree, None, is_lost=False)
    ]


def with_doubled_counts(tree: Any, name: str = "") -> Any:
    """Double every count and keep every rate."""
    if isinstance(tree, Mapping):
        return {key: with_doubled_counts(value, key) for key, value in tree.items()}
    is_count = isinstance(tree, int) and not isinstance(tree, bool)
    return 2 * tree if is_count else tree


def verdicts(before: Mapping[str, Any], after: Mapping[str, Any]) -> dict[str, str]:
    return {one.path: one.verdict for one in compare_drives(fleet(before), fleet(after))}


def test_number_of_scored_rows_has_no_direction(scores: dict[str, Any]) -> None:
    more = scores | {
        name: with_doubled_counts(scores[name]) for name in ("cues", "belief", "range")
    }
    changed = {one.metric for one in set(fleet(more)) - set(fleet(scores))}
    assert {"cues.stop_sign.scored", "range.start.scored", "belief.left.scored"} <= changed

    for found in (verdicts(scores, more), verdicts(more, scores)):
        assert {"cues.stop_sign.precision", "range.start.rmse_m", "belief.left.brier"} <= {*found}
        assert set(found.values()) == {"undecided"}


def test_additional_late_detection_is_not_worse(scores: dict[str, Any]) -> None:
    def found(detected: int, mean_m: float) -> dict[str, Any]:
        counts = {"approaches": 4, "detected": detected, "full": 0, "full_m": None}
        group = counts | {"detected_m": mean_m}
        mean = {"value": mean_m, "of": detected}
        return scores | {
            "approaches": scores["approaches"]
            | {"approaches": 4, "without_range": 0, "detected_m": mean}
            | {"detected": {"value": detected / 4, "of": 4}, "by_condition": {"rain": group}}
        }

    # Two approaches at 40 m; then a third at 10 m, so that the mean over detected ones is 30 m.
    got = verdicts(found(2, 40.0), found(3, 30.0))

    for path in ("approaches", "approaches.by_condition.rain"):
        assert got[f"{path}.detected_m_or_0"] == got[f"{path}.detected"] == "better"
        assert f"{path}.detected_m" not in got
    assert "worse" not in got.values()


def test_metrics_no_longer_scored_are_reported(scores: dict[str, Any]) -> None:
    nothing = {"value": None, "of": 0}
    unseen = scores["cues"]["stop_sign"] | {"scored": 0, "precision": nothing, "recall": nothing}
    off = scores | {"cues": scores["cues"] | {"stop_sign": unseen}}

    assert no_longer_scored(fleet(scores), fleet(off)) == ("cues.stop_sign.scored",)
    assert no_longer_scored(fleet(off), fleet(scores)) == ()
    assert no_longer_scored(fleet(scores), fleet(scores)) == ()


def test_metrics_of_unpaired_drives_are_not_reported_as_lost() -> None:
    """A fleet with one more drive has conditions that the other lacks."""

    def of(log: str, metric: str) -> DriveMetric:
        return DriveMetric(log, metric, "mean", 1.0, 1)

    dusk, recall = "cues.stop_sign.by_condition.dusk.recall", "cues.stop_sign.recall"
    before = [of("monday", recall), of("tuesday", recall), of("tuesday", dusk)]

    assert no_longer_scored(before, [of("monday", recall)]) == ()
    assert no_longer_scored(before, [of("monday", recall), of("tuesday", recall)]) == (dusk,)
