"""Scores of a run: files, gates, tables and the remembered truth."""

import builtins
import io
import json
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st

import crosscue
from crosscue.eval import cli
from crosscue.eval.recording import view
from crosscue.eval.report.junit import junit_text
from crosscue.eval.runs.folder import RunFolder
from crosscue.eval.runs.manifest import LogRow
from crosscue.eval.scoring.by_drive import DriveMetric, no_longer_scored
from crosscue.eval.scoring.drives import ScoreSettings, as_metrics
from crosscue.eval.scoring.gates import Gate, check_gates
from crosscue.eval.scoring.metric_values import MetricValue, metric_values
from crosscue.eval.scoring.truth import read_scored_truth
from crosscue.replay.errors import SchemaError, UsageError
from crosscue.replay.files.tree_text import strict_json
from support.commands import json_of, output_of
from support.refusals import refusal
from support.scene_run import scene_run
from support.scoring import (
    BELIEF,
    CUES,
    approach,
    at,
    belief_table,
    cue_table,
    frame_table,
    good_truth,
    log_row,
    range_table,
    run_folder,
    truth,
    truth_folder,
)


def _one(tmp_path: Path, name: str = "one") -> Path:
    """Write a run whose truth is next to its log."""
    truth_folder(tmp_path / name)
    run_folder(tmp_path / name / "run")
    return tmp_path / name / "run"


def test_score_finds_truth_next_to_log_and_writes_files(tmp_path: Path) -> None:
    run = _one(tmp_path)

    found = json_of("score", run)
    assert json.loads((run / "score" / "metrics.json").read_text()) == found["metrics"]
    assert found["metrics"]["cues"]["stop_sign"]["precision"]["value"] == 1.0
    assert found["metrics"]["approaches"]["full_m"]["value"] == 15.0
    assert found["metrics"]["range"]["start"]["rmse_m"] == pytest.approx(0.5)
    assert "no track" in found["metrics"]["coverage"]["not_scored"]["pose"]
    curves = pq.read_table(run / "score" / "curves.parquet")
    assert curves.num_rows == 40
    frames = pq.read_table(run / "score" / "cue_frames.parquet")
    assert frames.filter(frames["cue"].to_numpy(zero_copy_only=False) == "road_left").num_rows == 50


def _gates(tmp_path: Path, *gates: str) -> str:
    path = tmp_path / "gates.toml"
    path.write_text("version = 1\n" + "\n".join(f"[[gate]]\n{gate}" for gate in gates))
    return str(path)


def test_gates_set_exit_status_and_write_junit_file(tmp_path: Path) -> None:
    run = _one(tmp_path)
    passing = 'metric = "cues.stop_sign.precision"\nmin = 0.99'
    failing = 'metric = "cues.stop_sign.precision"\nmin = 0.99\nuse = "low"'

    assert cli.run(["score", str(run), "-q", "--gate", _gates(tmp_path, passing)]) == 0
    assert cli.run(["score", str(run), "-q", "--gate", _gates(tmp_path, passing, failing)]) == 1
    suite = ET.parse(run / "score" / "junit.xml").getroot()
    assert (suite.get("tests"), suite.get("failures")) == ("2", "1")
    (failure,) = suite.iter("failure")
    # 30 of 30 are right: the lower end of Wilson's interval is 0.886.
    assert "0.88" in str(failure.get("message"))


@pytest.mark.parametrize(
    ("gate", "message"),
    [
        ('metric = "cues.stop_sing.precision"\nmin = 0.9', "did you mean cues.stop_sign.precision"),
        ('metric = "cues.stop_sign.precision"', "expected min, max or both"),
        ('metric = "cues.stop_sign.precision"\nmin = nan', "finite number"),
        ('metric = "a"\nmin = 2\nmax = 1', "min 2 is above max 1"),
        (
            'metric = "a"\nmin = 0.9\nmin_coumt = 5',
            "gates.toml:5: gate.0.min_coumt: no such key; did you mean min_count?",
        ),
        (
            'metric = "a"\nmin = 0.9\n[[gate]]\nmetric = "b"\nmin = 1\nwarn = true',
            "gates.toml:8: gate.1.warn: no such key; there are: max, metric, min, min_count, use",
        ),
        ("metric = [", "not TOML"),
    ],
)
def test_invalid_gate_is_refused(tmp_path: Path, gate: str, message: str) -> None:
    line = refusal(2, "score", _one(tmp_path), "--gate", _gates(tmp_path, gate))

    assert message in line


def test_gate_fails_for_metric_that_was_not_scored(tmp_path: Path) -> None:
    run = _one(tmp_path)
    gates = [
        'metric = "pose.ape.none.translation_m.rmse"\nmax = 1.0',
        'metric = "cues.do_not_enter.precision"\nmin = 0.9',
        'metric = "cues.stop_sign.precision"\nmin = 0.9\nmin_count = 1000',
    ]

    assert cli.run(["score", str(run), "-q", "--gate", _gates(tmp_path, *gates)]) == 1
    messages = [
        one.get("message") or ""
        for one in ET.parse(run / "score" / "junit.xml").getroot().iter("failure")
    ]
    assert len(messages) == 3
    assert "no track" in messages[0]
    assert "no data for it" in messages[1]
    assert "based on 30 rows" in messages[2]


@given(st.text(min_size=1), st.text())
def test_arbitrary_names_yield_valid_junit(metric: str, suite: str) -> None:
    gate = Gate.model_construct(metric=metric, min=0.5, max=None, use="value", min_count=1)
    results = check_gates([gate], {metric: MetricValue(0.1)}, {})
    root = ET.fromstring(junit_text(results, suite))

    assert [one.tag for one in root.iter()] == ["testsuites", "testsuite", "testcase", "failure"]
    assert root[0].get("tests") == root.get("failures") == "1"


def test_metric_values_use_wider_interval() -> None:
    tree = {
        "precision": {
            "value": 0.9,
            "low": 0.85,
            "high": 0.95,
            "clusters_low": 0.6,
            "clusters_high": None,
            "of": 50,
        }
    }
    values = metric_values(tree)

    assert values["precision"] == MetricValue(0.9, 0.6, 0.95, 50)
    assert values["precision.low"].value == 0.85
    assert list(metric_values(tree, parts=False)) == ["precision"]


def test_truth_of_another_log_is_refused_by_time_or_hash(tmp_path: Path) -> None:
    run = _one(tmp_path)
    late = approach(start_ns=at(1000), enter_ns=at(1040))
    other = truth_folder(tmp_path / "other", truth([], [late], end=2000))
    other.write_text(other.read_text().replace(f'"start_ns": {at(0)}', f'"start_ns": {at(900)}'))
    hashed = truth_folder(tmp_path / "hashed")
    tree = json.loads(hashed.read_text())
    hashed.write_text(json.dumps(tree | {"log": "b.mcap", "log_sha256": {"b.mcap": "11"}}))

    assert "another log or clock" in refusal(1, "score", run, "--truth", other)
    assert "belongs to another b.mcap by its hash" in refusal(1, "score", run, "--truth", hashed)
    assert cli.run(["score", str(run), "--truth", str(hashed), "-q", "--any-log"]) == 0
    hashed.write_text(json.dumps(tree | {"log_sha256": {"drive.mcap": "00"}}))
    assert cli.run(["score", str(run), "--truth", str(hashed), "-q"]) == 0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"approaches": "twice"}, "overlap"),
        (
            {"cues": [{"cue": "stop_sing", "present": True, "t_ns": at(3)}]},
            "did you mean stop_sign",
        ),
        (
            {"cues": [{"cue": "stop_sign", "present": True, "t_ns": at(3000)}]},
            "expected times from",
        ),
        ({"ranges": "missing.csv"}, "missing.csv"),
        ({"ranges": "../run/manifest.json"}, "manifest.json"),
    ],
)
def test_invalid_truth_is_refused(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    run = _one(tmp_path)
    path = tmp_path / "one" / "truth.json"
    tree = json.loads(path.read_text())
    if change.get("approaches") == "twice":
        change = {"approaches": [*tree["approaches"], tree["approaches"][0] | {"id": 1}]}
    path.write_text(json.dumps(tree | change))

    assert message in refusal(4, "score", run)


@pytest.mark.parametrize(
    "line", ["x,0,1,2", "5,9,1,2", "5,0,nan,2", "5,0,inf,2", "99999999999999999999,0,1,2", "5"]
)
def test_invalid_range_row_is_refused_with_line_number(tmp_path: Path, line: str) -> None:
    run = _one(tmp_path)
    (tmp_path / "one" / "ranges.csv").write_text(f"t_ns,approach,start_m,end_m\n{line}\n")

    assert "ranges.csv:2" in refusal(4, "score", run)


def test_invalid_tables_are_refused_with_reason(tmp_path: Path) -> None:
    truth_folder(tmp_path)
    belief = belief_table(BELIEF)
    broken = {
        "no column count": {"cues": cue_table(CUES).drop_columns(["count"])},
        "outside 0 to 1": {"belief": belief_table({"left": {3: 1.5}})},
        "expected start or end": {"range": range_table(3, 9, reference="middle")},
        "expected integers": {"belief": belief.set_column(0, "t_ns", belief["intersection"])},
        "count -1": {"cues": cue_table({"stop_sign": {3: -1}})},
    }
    for i, (message, tables) in enumerate(broken.items()):
        run = run_folder(tmp_path / f"run{i}", tables)
        assert message in refusal(4, "score", run.path)


def test_run_with_nothing_to_score_reports_reasons(tmp_path: Path) -> None:
    truth_folder(tmp_path)
    bare = run_folder(tmp_path / "bare", {"frames": frame_table(5)})
    only_cues = run_folder(tmp_path / "cues", {"cues": cue_table(CUES)})

    line = refusal(1, "score", bare.path)
    assert "the run has no cues; the run has no belief; the run has no range" in line
    assert "not scored belief: the run has no belief" in output_of("score", only_cues.path)


def _log_of(folder: Path, run: Path) -> tuple[LogRow, ...]:
    return (log_row(folder / "drive.mcap", RunFolder(run), folder.name),)


@pytest.mark.slow
@pytest.mark.parametrize("workers", ["1", "2"])
def test_run_that_cannot_be_scored_does_not_stop_others(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], workers: str
) -> None:
    for name in ("a", "b", "c"):
        truth_folder(tmp_path / "drives" / name)
        run = tmp_path / "runs" / name
        run_folder(run, logs=_log_of(tmp_path / "drives" / name, run))
    (tmp_path / "runs" / "b" / "manifest.json").unlink()
    argv = ["score", str(tmp_path / "runs"), "-o", str(tmp_path / "all"), "--workers", workers]

    assert cli.run(argv) == 3
    reported = capsys.readouterr()
    assert "runs/b: no manifest.json" in reported.err
    assert "failed     1 of 3 runs" in reported.out
    pooled = json.loads((tmp_path / "all" / "metrics.json").read_text())
    assert [one["drive"][-6:] for one in pooled["coverage"]["by_drive"]] == ["runs/a", "runs/c"]
    assert list(pooled["coverage"]["failed"]) == [str(tmp_path / "runs" / "b")]


def test_scores_of_many_runs_begin_with_the_result_in_25_lines(tmp_path: Path) -> None:
    for name in "abc":
        drive, run = tmp_path / "drives" / name, tmp_path / "runs" / name
        truth_folder(drive)
        (drive / "drive.mcap").write_text(name)
        run_folder(run, logs=_log_of(drive, run))
    argv = ["score", str(tmp_path / "runs"), "-o", str(tmp_path / "all"), "--without-figures"]

    printed = output_of(*argv).splitlines()
    assert printed[0].startswith("approaches 3 true")
    assert len(printed) <= 25
    assert printed[-1] == f"written to {tmp_path / 'all' / 'report.html'}"

    printed = output_of(*argv, "-v").splitlines()
    assert [one for one in printed if one.startswith(f"{tmp_path}/runs/a: detected")]


def test_score_of_one_run_is_also_written_to_output_folder(tmp_path: Path) -> None:
    run, out = _one(tmp_path), tmp_path / "scored"

    assert f"written to {out}" in output_of("score", run, "-o", out).replace("\n", " ")
    for name in ("metrics.json", "curves.parquet", "cue_frames.parquet"):
        assert (out / name).read_bytes() == (run / "score" / name).read_bytes()
    assert (out / "report.html").exists()


SECTIONS = ("cues", "approaches", "belief", "range")


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
    found = json.loads(strict_json(as_metrics(crosscue.score(tables, truth))))

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


def test_table_that_is_not_scored_is_refused() -> None:
    with pytest.raises(UsageError, match="tables: ranges; expected frames, cues, range or belief"):
        crosscue.score({"ranges": pa.table({})}, good_truth().truth)


def test_metrics_of_unpaired_drives_are_not_reported_as_lost() -> None:
    """A fleet with one more drive has conditions that the other lacks."""

    def of(log: str, metric: str) -> DriveMetric:
        return DriveMetric(log, metric, "mean", 1.0, 1)

    dusk, recall = "cues.stop_sign.by_condition.dusk.recall", "cues.stop_sign.recall"
    before = [of("monday", recall), of("tuesday", recall), of("tuesday", dusk)]

    assert no_longer_scored(before, [of("monday", recall)]) == ()
    assert no_longer_scored(before, [of("monday", recall), of("tuesday", recall)]) == (dusk,)


@pytest.fixture
def scored(tmp_path: Path) -> tuple[Path, Path]:
    """Score a run with a truth that is not next to its log; return both."""
    run, truth = scene_run(tmp_path / "drive").path, truth_folder(tmp_path / "elsewhere")
    crosscue.score_run(run, truth)
    return run, truth


def test_failures_and_score_use_the_truth_of_the_last_score(scored: tuple[Path, Path]) -> None:
    run, truth = scored
    told = crosscue.failures(run, truth=truth).failures

    assert told
    assert crosscue.failures(run).failures == told
    assert crosscue.score_run(run).one.truth_path.samefile(truth)


def test_changed_truth_is_refused_until_the_run_is_scored_again(
    scored: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    run, truth = scored
    truth.write_text(truth.read_text().replace('"A"', '"B"'))

    assert cli.run(["failures", str(run)]) != 0
    printed = capsys.readouterr()
    assert "changed since" in printed.out + printed.err
    with pytest.raises(SchemaError, match="changed since"):
        view.save_recording(run, run / "drive.rrd")
    assert cli.run(["score", str(run), "-q"]) == 3
    assert crosscue.failures(run).failures


def test_truth_that_is_gone_counts_as_none(scored: tuple[Path, Path]) -> None:
    run, truth = scored
    truth.rename(truth.with_name("moved.json"))

    assert crosscue.failures(run).without_truth


def test_recording_draws_the_truth_of_the_last_score(
    scored: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[object] = []
    monkeypatch.setattr(view, "save_rrd", lambda *given: drawn.append(given[3]))
    run, truth = scored

    view.save_recording(run, run / "told.rrd", truth)
    view.save_recording(run, run / "drive.rrd")
    truth.unlink()
    view.save_recording(run, run / "drive.rrd")

    assert [ranges is None for ranges in drawn] == [False, False, True]
