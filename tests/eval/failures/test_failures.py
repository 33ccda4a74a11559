"""Failures of runs: their frames, their ranking and a selection of diverse causes."""

import json
import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import crosscue
from crosscue.eval import cli
from crosscue.eval.failures.approach_level import flips_without_truth
from crosscue.eval.failures.record import Failure, distance_bin, read_failures, write_failures
from crosscue.eval.scoring.columns import BeliefRows
from support.commands import output_of
from support.refusals import refusal
from support.scene_run import scene_run
from support.scoring import at, truth_folder


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Write a synthetic run and its truth to one folder."""
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


def test_visible_sign_is_missed_until_its_first_detection(drive: tuple[Path, Path]) -> None:
    found = crosscue.failures(drive[0], truth=drive[1])

    (sign,) = [one for one in found.failures if one.what == "stop_sign"]
    assert (sign.kind, sign.level, sign.frames) == ("missed", "frames", 5)
    assert (sign.start_ns, sign.end_ns) == (at(5), at(9))
    # Detection should be easiest at the nearest frame; the run starts at its first frame.
    assert (sign.t_ns, sign.at_s, sign.distance_m) == (at(9), 0.9, 31.0)
    assert (sign.intersection, sign.conditions) == ("A", ("rain",))
    assert sign.cause == "not detected"
    assert sign.severity == pytest.approx(math.log2(6))


def test_overconfident_range_is_a_failure(tmp_path: Path) -> None:
    folder = scene_run(tmp_path / "drive").path
    truth = truth_folder(tmp_path / "truth")
    assert not [f for f in crosscue.failures(folder, truth=truth).failures if f.kind == "range"]

    path = folder / "range.parquet"
    table = pq.read_table(path)
    var = table["var_m2"].to_numpy().copy()
    # An error of half a metre with an s.d. of 0.1 m is five standard deviations.
    var[5:8] = 0.01
    column = table.schema.get_field_index("var_m2")
    pq.write_table(table.set_column(column, "var_m2", pa.array(var)), path)

    (wrong,) = [f for f in crosscue.failures(folder, truth=truth).failures if f.kind == "range"]
    assert (wrong.what, wrong.cause, wrong.frames) == ("range to start", "interval too narrow", 3)
    assert wrong.severity == pytest.approx(25.0 / (2.0 * math.log(2.0)))


def test_run_without_truth_reports_only_flipped_beliefs(drive: tuple[Path, Path]) -> None:
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


def test_decided_belief_is_flipped_where_it_crosses_one_half() -> None:
    (flip,) = _flips(_belief(straight=[0.5, 0.95, 0.95, 0.6, 0.4, 0.05]))

    assert (flip.kind, flip.what, flip.t_ns, flip.start_ns) == ("flipped", "straight", at(4), at(2))
    assert flip.severity == pytest.approx(-math.log2(0.05))
    assert flip.cause == "no cue speaks against it"


def test_flip_names_the_contradicting_cue() -> None:
    belief = _belief(intersection=[0.5, 0.95, 0.4], left=[0.5, 0.95, 0.1])
    (left,) = [
        one for one in _flips(belief, {"one_way_right": [2]}) if one.what == "left"
    ]  # one-way right excludes a turn to the left

    assert left.cause == "a cue speaks against it"
    assert "one way right in 1 frames" in left.reported


@pytest.mark.parametrize("ending", ["parquet", "json"])
def test_failure_table_is_read_back_also_after_its_folder_moved(
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


def test_result_is_available_as_table_text_and_dict(
    drive: tuple[Path, Path], tmp_path: Path
) -> None:
    found = crosscue.failures(drive[0], truth=drive[1], top=2, output=tmp_path / "top.json")

    assert found.table.num_rows == len(found) == 2
    assert "stop_sign" in repr(found)
    assert found.found == sum(group.failures for group in found.groups)
    assert len(json.loads((tmp_path / "top.json").read_text())["failures"]) == 2
    assert found.as_dict()["found"] == found.found


def test_where_option_selects_runs(drive: tuple[Path, Path]) -> None:
    line = ["failures", str(drive[0].parent), "--truth", str(drive[1]), "--json"]

    everything = output_of(*line)
    assert output_of(*line, "--where", "stage = 'estimate'") == everything
    assert "no run where false" in refusal(1, *line, "--where", "false")
    assert cli.run([*line, str(drive[0]), "--where", "true"]) == 2


def test_each_distance_has_one_bin() -> None:
    assert [distance_bin(d) for d in (None, -1.0, 0.0, 9.9, 10.0, 79.9, 80.0)] == [
        "unknown",
        "0-10 m",
        "0-10 m",
        "0-10 m",
        "10-20 m",
        "40-80 m",
        "80 m and more",
    ]
