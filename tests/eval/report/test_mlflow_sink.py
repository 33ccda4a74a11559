"""Scores in MLflow, read back by MLflow itself from a store on disk."""

import json
from importlib.util import find_spec
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from crosscue.eval import cli
from crosscue.eval.runs.tags import write_tags
from support.refusals import refusal
from support.scoring import run_folder, truth_folder

needs_mlflow = pytest.mark.skipif(
    find_spec("mlflow") is None, reason="mlflow-skinny is not installed"
)


@pytest.mark.slow
@needs_mlflow
@pytest.mark.filterwarnings("default")
def test_scores_tags_and_report_are_stored_in_mlflow(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from mlflow.tracking import MlflowClient

    monkeypatch.setenv("MLFLOW_ALLOW_FILE_STORE", "true")
    store = (tmp_path / "store").as_uri()
    truth_folder(tmp_path)
    (tmp_path / "drive.mcap").write_text("a drive")
    run = run_folder(tmp_path / "run")
    write_tags(run.path, {"model": "new", "weather": "rain"})

    argv = ["score", str(run.path), "--without-figures", "-q", "--mlflow", store]
    assert cli.run([*argv, "--experiment", "nightly"]) == 0

    client = MlflowClient(tracking_uri=store)
    experiment = client.get_experiment_by_name("nightly")
    assert experiment is not None
    (found,) = client.search_runs([experiment.experiment_id])
    assert found.info.run_name == "run"
    assert found.info.status == "FINISHED"
    metrics = json.loads((run.path / "score" / "metrics.json").read_text())
    precision = metrics["cues"]["stop_sign"]["precision"]
    path = "cues.stop_sign.precision"
    assert found.data.metrics[path] == precision["value"]
    assert found.data.metrics[f"{path}.low"] <= precision["low"]
    assert (found.data.tags["model"], found.data.tags["weather"]) == ("new", "rain")
    assert len(found.data.tags["crosscue.drive"]) == 64
    names = [one.path for one in client.list_artifacts(found.info.run_id)]
    assert names == ["metrics.json", "report.html"]
    report = Path(urlsplit(str(found.info.artifact_uri)).path, "report.html")
    assert report.read_bytes() == (run.path / "score" / "report.html").read_bytes()


@needs_mlflow
@pytest.mark.filterwarnings("default")
@pytest.mark.parametrize(
    ("uri", "status", "message"),
    [("folder", 1, "unless MLFLOW_ALLOW_FILE_STORE=true is set"), ("ftp://nowhere", 1, "ftp")],
)
def test_unusable_mlflow_store_is_refused_before_scoring(
    tmp_path: Path, uri: str, status: int, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("MLFLOW_ALLOW_FILE_STORE", raising=False)
    monkeypatch.chdir(tmp_path)

    assert message in refusal(status, "score", "no_such_run", "--mlflow", uri)
