"""``crosscue compare``: what differs, what of it is worse, and the exit status."""

import json
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crosscue.eval import cli
from crosscue.eval.catalog.compare import compare_metrics, compare_runs, read_tolerance
from crosscue.eval.runs.folder import open_run
from crosscue.eval.scoring.metric_values import MetricValue
from crosscue.replay.base import UsageError
from crosscue.replay.vehicle.fusion import Fusion
from crosscue.replay.vehicle.vehicle import Vehicle
from support.scoring import (
    BELIEF,
    CUES,
    belief_table,
    cue_table,
    frame_table,
    range_table,
    run_folder,
    truth_folder,
)

WORSE_CUES = {**CUES, "stop_sign": {frame: int(frame >= 3) for frame in range(40)}}


def _settings(established: float) -> Vehicle:
    """As a manifest has them."""
    return Vehicle(version=1, fusion=Fusion(established=established))


def _pair(tmp_path: Path, *, scored: bool = True, threshold: float = 0.3) -> tuple[Path, Path]:
    """A good run and one with two false stop signs that is established at another threshold."""
    truth_folder(tmp_path)
    good = run_folder(tmp_path / "a", settings=_settings(0.9))
    worse = run_folder(
        tmp_path / "b",
        {
            "frames": frame_table(50),
            "cues": cue_table(WORSE_CUES),
            "belief": belief_table(BELIEF),
            "range": range_table(8, 45, 0.5),
        },
        settings=_settings(threshold),
    )
    if scored:
        assert cli.run(["score", str(good.path), "-q"]) == 0
        assert cli.run(["score", str(worse.path), "-q"]) == 0
    return good.path, worse.path


def test_a_run_is_like_itself(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    good, _ = _pair(tmp_path)

    assert cli.run(["compare", str(good), str(good)]) == 0
    assert "nothing is worse" in capsys.readouterr().out


def test_what_is_worse_is_named_with_what_may_be_its_cause(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    good, worse = _pair(tmp_path)

    assert cli.run(["compare", str(good), str(worse)]) == 1
    text = capsys.readouterr().out
    assert "setting    settings.fusion.established: 0.9 -> 0.3" in text
    assert "table      cues: other values (90 and 90 rows)" in text
    assert "count: 7 rows differ, by up to 1" in text
    # 35 of 37 positives are right instead of 30 of 30.
    assert "WORSE      cues.stop_sign.precision: 1 -> 0.945946" in text
    # The recall is better, so turning the comparison round finds that worse.
    assert cli.run(["compare", str(worse), str(good), "--json"]) == 1
    assert json.loads(capsys.readouterr().out)["worse"] == ["cues.stop_sign.recall"]


def test_tolerances_allow_a_loss_up_to_their_size_and_the_last_that_fits_counts(
    tmp_path: Path,
) -> None:
    good, worse = (str(path) for path in _pair(tmp_path))

    assert cli.run(["compare", good, worse, "-q", "--tolerance", "10%"]) == 0
    assert cli.run(["compare", good, worse, "-q", "--tolerance", "0.01"]) == 1
    narrow = ["10%", "cues.stop_*=0.01"]
    assert cli.run(["compare", good, worse, "-q", "--tolerance", *narrow]) == 1
    assert cli.run(["compare", good, worse, "-q", "--tolerance", *reversed(narrow)]) == 0


@pytest.mark.parametrize("text", ["", "a", "-1", "nan", "1e999", "x=%", "5%%"])
def test_a_tolerance_that_is_none_is_refused(text: str) -> None:
    with pytest.raises(UsageError, match=r"expected 0\.01"):
        read_tolerance(text)


def test_runs_without_a_score_are_judged_by_their_tables(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    good, worse = _pair(tmp_path, scored=False)

    assert cli.run(["compare", str(good), str(worse)]) == 1
    assert "judged by tables alone" in capsys.readouterr().out
    assert compare_runs(open_run(good), open_run(good)).worse == ()


def test_losing_a_score_is_worse_and_gaining_one_is_not() -> None:
    scored, lost = (
        {"cues.a.precision": MetricValue(0.9)},
        {"cues.a.precision": MetricValue(float("nan"))},
    )

    assert compare_metrics(scored, lost)[0][0].is_worse
    assert compare_metrics(scored, {})[0][0].is_worse
    assert not compare_metrics(lost, scored)[0][0].is_worse
    assert compare_metrics(lost, {}) == ((), 1)


@settings(max_examples=60, deadline=None)
@given(st.floats(0, 1), st.floats(0, 1), st.sampled_from(["precision", "brier", "fraction_there"]))
def test_at_most_one_direction_is_worse(old: float, new: float, name: str) -> None:
    one, other = {name: MetricValue(old)}, {name: MetricValue(new)}
    worse = [
        any(change.is_worse for change in compare_metrics(a, b)[0])
        for a, b in ((one, other), (other, one))
    ]

    apart = abs(old - new) > 1e-12 * max(old, new)
    assert sum(worse) == (name != "fraction_there" and apart)


def test_tables_that_cannot_be_compared_row_by_row_say_why(tmp_path: Path) -> None:
    good, worse = _pair(tmp_path, scored=False)
    pq.write_table(frame_table(49), worse / "frames.parquet")
    pq.write_table(cue_table(CUES).drop_columns(["count"]), worse / "cues.parquet")
    (worse / "range.parquet").unlink()
    nan = belief_table({**BELIEF, "left": {20: float("nan")}})
    pq.write_table(nan, worse / "belief.parquet")
    pq.write_table(nan, good / "belief.parquet")

    found = {one.name: one for one in compare_runs(open_run(good), open_run(worse)).tables}
    # A number that is missing in both is no difference.
    assert set(found) == {"cues", "frames", "range"}
    assert found["frames"].what == "another number of rows"
    assert found["cues"].what == "other columns: count int64 and nothing"
    assert found["range"].what == "only in the first run"


def test_pooled_scores_of_several_runs_are_compared_too(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    good, worse = _pair(tmp_path)
    for name, runs in (("good", [good]), ("both", [good, worse])):
        more = [] if len(runs) > 1 else [run_folder(tmp_path / "c", settings=_settings(0.9)).path]
        argv = ["score", *map(str, [*runs, *more]), "-o", str(tmp_path / name), "-q"]
        assert cli.run(argv) == 0

    assert cli.run(["compare", str(tmp_path / "good"), str(tmp_path / "both")]) == 1
    assert "WORSE      cues.stop_sign.precision: 1 -> 0.970149" in capsys.readouterr().out
    assert cli.run(["compare", str(tmp_path / "good"), str(tmp_path)]) == 4
    assert "not a run folder" in capsys.readouterr().err


def test_damaged_scores_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    good, worse = _pair(tmp_path)
    for text in ("{", "[]", "[" * 100_000):
        (worse / "score" / "metrics.json").write_text(text)
        assert cli.run(["compare", str(good), str(worse)]) == 4
        assert "run crosscue score again" in capsys.readouterr().err


def test_hostile_names_cannot_drive_the_terminal(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    runs = [
        run_folder(
            tmp_path / name,
            {"t": pa.table({"\x1b[2J": [value]})},
            versions={"\x1b]0;x\x07": f"\x1b[31m{value}"},
        )
        for name, value in (("a", 1), ("b", 2))
    ]

    assert cli.run(["compare", *(str(run.path) for run in runs)]) == 1
    assert "\x1b" not in capsys.readouterr().out
