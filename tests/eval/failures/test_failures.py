"""Failures of runs: found at the right moment, ranked, and selected from many causes."""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

import crosscue
from crosscue.eval import cli
from crosscue.eval.failures.approach_level import flips_without_truth
from crosscue.eval.failures.order import cause_groups, diverse, ranked
from crosscue.eval.failures.record import Failure, distance_bin, read_failures, write_failures
from crosscue.eval.scoring.columns import BeliefRows
from crosscue.replay.base import AnnotationError, UnreadableRunError, UsageError
from support.scene_run import scene_run
from support.scoring import at, truth_folder


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A made-up run and its truth, in one folder."""
    folder = tmp_path_factory.mktemp("failing")
    return scene_run(folder).path, truth_folder(folder / "truth")


def failure(severity: float = 1.0, **changes: object) -> Failure:
    usual: dict[str, object] = {
        "run": "runs/a",
        "kind": "missed",
        "level": "frames",
        "what": "stop_sign",
        "cause": "not detected",
        "reported": "",
        "t_ns": 0,
        "at_s": 0.0,
        "start_ns": 0,
        "end_ns": 0,
        "frames": 1,
        "approach": None,
        "intersection": "",
        "conditions": (),
        "distance_m": None,
    }
    return Failure(**(usual | {"severity": severity} | changes))  # type: ignore[arg-type]


def test_a_sign_in_plain_view_that_was_not_found_at_first_is_missed_until_it_is(
    drive: tuple[Path, Path],
) -> None:
    found = crosscue.failures(drive[0], truth=drive[1])

    (sign,) = [one for one in found.failures if one.what == "stop_sign"]
    assert (sign.kind, sign.level, sign.frames) == ("missed", "frames", 5)
    assert (sign.start_ns, sign.end_ns) == (at(5), at(9))
    # Detection should be easiest at the nearest frame; the run starts at its first frame.
    assert (sign.t_ns, sign.at_s, sign.distance_m) == (at(9), 0.9, 31.0)
    assert (sign.intersection, sign.conditions) == ("A", ("rain",))
    assert sign.cause == "not detected"
    assert sign.severity == pytest.approx(math.log2(6))


def test_a_right_range_is_no_failure_and_one_sure_of_itself_and_off_is(tmp_path: Path) -> None:
    folder = scene_run(tmp_path / "drive").path
    truth = truth_folder(tmp_path / "truth")
    assert not [f for f in crosscue.failures(folder, truth=truth).failures if f.kind == "range"]

    path = folder / "range.parquet"
    import pyarrow as pa
    import pyarrow.parquet as pq

    table = pq.read_table(path)
    var = table["var_m2"].to_numpy().copy()
    # An error of half a metre with an s.d. of 0.1 m is five standard deviations.
    var[5:8] = 0.01
    column = table.schema.get_field_index("var_m2")
    pq.write_table(table.set_column(column, "var_m2", pa.array(var)), path)

    (wrong,) = [f for f in crosscue.failures(folder, truth=truth).failures if f.kind == "range"]
    assert (wrong.what, wrong.cause, wrong.frames) == (
        "range to start",
        "interval too narrow",
        3,
    )
    assert wrong.severity == pytest.approx(25.0 / (2.0 * math.log(2.0)))


def test_a_run_without_truth_still_shows_beliefs_that_it_took_back(
    drive: tuple[Path, Path],
) -> None:
    found = crosscue.failures(drive[0])

    assert found.without_truth == (drive[0],)
    assert {one.kind for one in found.failures} <= {"flipped"}


def _belief(**features: list[float]) -> BeliefRows:
    rows = len(next(iter(features.values())))
    return BeliefRows(
        np.array([at(row) for row in range(rows)]),
        np.full(rows, 3),
        {name: np.array(values) for name, values in features.items()},
        np.zeros(rows, np.bool_),
    )


def _flips(belief: BeliefRows, cues: Mapping[str, list[int]] | None = None) -> list[Failure]:
    positives = {name: np.array([at(f) for f in frames]) for name, frames in (cues or {}).items()}
    return flips_without_truth(belief, positives, "run", 0.9)


def test_a_belief_that_was_decided_and_then_went_over_is_flipped_where_it_crosses() -> None:
    (flip,) = _flips(_belief(straight=[0.5, 0.95, 0.95, 0.6, 0.4, 0.05]))

    assert (flip.kind, flip.what, flip.t_ns, flip.start_ns) == (
        "flipped",
        "straight",
        at(4),
        at(2),
    )
    assert flip.severity == pytest.approx(-math.log2(0.05))
    assert flip.cause == "no cue speaks against it"


def test_the_same_flip_towards_the_other_answer_is_as_severe() -> None:
    (yes,) = _flips(_belief(left=[0.5, 0.95, 0.2]))
    (no,) = _flips(_belief(left=[0.5, 0.05, 0.8]))

    assert yes.severity == pytest.approx(no.severity)


@pytest.mark.parametrize(
    "values",
    [[0.5, 0.95, 0.99], [0.5, 0.85, 0.1], [0.02, 0.02, 0.6, 0.95], [0.5, 0.95, 0.55]],
    ids=["it stays", "never decided", "a prior is no decision", "it only weakens"],
)
def test_what_was_never_decided_or_never_given_up_is_no_flip(values: list[float]) -> None:
    assert not _flips(_belief(left=values))


def test_a_flip_names_the_cue_that_spoke_against_it() -> None:
    belief = _belief(intersection=[0.5, 0.95, 0.4], left=[0.5, 0.95, 0.1])
    (left,) = [
        one for one in _flips(belief, {"one_way_right": [2]}) if one.what == "left"
    ]  # its row excludes a turn to the left

    assert left.cause == "a cue speaks against it"
    assert "one way right in 1 frames" in left.reported


def test_order_does_not_depend_on_the_order_of_runs_or_of_what_was_found() -> None:
    several = [failure(s, run=run, t_ns=t) for s, run, t in itertools.product([1, 2], "ab", [1, 2])]

    assert ranked(several) == ranked(several[::-1])
    assert diverse(several, 3) == diverse(several[::-1], 3)
    assert [one.severity for one in ranked(several)] == sorted([1, 2] * 4, reverse=True)


def test_no_group_and_no_run_has_two_before_every_other_has_one() -> None:
    loud = [failure(9.0, run="a", t_ns=t) for t in range(5)]
    same_cause = [failure(1.0, run="b")]
    rare = [failure(0.1, cause="score too low")]
    everything = [*loud, *same_cause, *rare]

    first_two = diverse(everything, 2)
    assert {one.cause for one in first_two} == {"not detected", "score too low"}
    first_three = diverse(everything, 3)
    assert first_three[:2] == first_two
    assert {one.run for one in first_three if one.cause == "not detected"} == {"a", "b"}
    assert sorted(diverse(everything, 99), key=repr) == sorted(everything, key=repr)


def test_groups_count_every_failure_once() -> None:
    groups = cause_groups([failure(), failure(3.0, run="b"), failure(kind="late")])

    assert [(g.kind, g.failures, g.runs, g.severity) for g in groups] == [
        ("missed", 2, 2, 3.0),
        ("late", 1, 1, 1.0),
    ]


@pytest.mark.parametrize("ending", ["parquet", "json"])
def test_a_table_reads_back_as_it_was_also_after_both_folders_moved(
    tmp_path: Path, ending: str
) -> None:
    (tmp_path / "before").mkdir()
    kept = failure(run=str(tmp_path / "before" / "run"), conditions=("rain",), distance_m=3.5)
    table = tmp_path / "before" / f"worst.{ending}"
    write_failures([kept], table)

    assert read_failures(table) == (kept,)
    (tmp_path / "before").rename(tmp_path / "after")
    (moved,) = read_failures(tmp_path / "after" / table.name)
    assert moved.run == str(tmp_path / "after" / "run")


def test_a_damaged_table_is_refused_with_its_name(tmp_path: Path) -> None:
    for name, text in (("a.parquet", "x"), ("b.json", "{}"), ("c.json", '{"failures": [{}]}')):
        (tmp_path / name).write_text(text)
        with pytest.raises(AnnotationError, match=name):
            read_failures(tmp_path / name)


def test_one_run_that_cannot_be_read_does_not_hide_the_others(
    drive: tuple[Path, Path], tmp_path: Path
) -> None:
    broken = tmp_path / "broken"
    broken.mkdir()
    (broken / "manifest.json").write_text("{")

    found = crosscue.failures([drive[0], broken], truth=drive[1])
    assert (found.runs, list(found.failed), found.found) == (2, [broken], len(found))
    with pytest.raises(UnreadableRunError, match="broken"):
        crosscue.failures(broken)


def test_the_result_is_a_table_a_text_and_plain_values(
    drive: tuple[Path, Path], tmp_path: Path
) -> None:
    found = crosscue.failures(drive[0], truth=drive[1], top=2, output=tmp_path / "top.json")

    assert found.table.num_rows == len(found) == 2
    assert "stop_sign" in repr(found)
    assert found.found == sum(group.failures for group in found.groups)
    assert len(json.loads((tmp_path / "top.json").read_text())["failures"]) == 2
    assert found.as_dict()["found"] == found.found


def test_values_that_mean_nothing_are_wrong_usage(drive: tuple[Path, Path]) -> None:
    for wrong in ({"top": 0}, {"threshold": 0.4}, {"workers": 0}, {"output": "x.csv"}):
        with pytest.raises(UsageError):
            crosscue.failures(drive[0], truth=drive[1], **wrong)


def test_every_distance_has_one_bin() -> None:
    assert [distance_bin(d) for d in (None, -1.0, 0.0, 9.9, 10.0, 79.9, 80.0)] == [
        "unknown",
        "0-10 m",
        "0-10 m",
        "0-10 m",
        "10-20 m",
        "40-80 m",
        "80 m and more",
    ]


def test_a_query_selects_the_runs_of_one_folder(
    drive: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    line = ["failures", str(drive[0].parent), "--truth", str(drive[1]), "--json"]

    assert cli.run(line) == 0
    everything = capsys.readouterr().out
    assert cli.run([*line, "--where", "stage = 'estimate'"]) == 0
    assert capsys.readouterr().out == everything
    assert cli.run([*line, "--where", "false"]) == 1
    assert "no run where false" in capsys.readouterr().err
    assert cli.run([*line, str(drive[0]), "--where", "true"]) == 2
