"""Runs named on the command line."""

from pathlib import Path

import pytest

from crosscue.eval.batch.merge import merge_runs
from crosscue.eval.catalog.find_runs import runs_of
from crosscue.eval.runs.folder import create, write_manifest
from crosscue.replay.errors import CrosscueError
from support.manifests import estimated


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    for name, stage in (
        ("a", "estimate"),
        ("b", "estimate"),
        ("deep/c", "estimate"),
        ("merged", "merged"),
    ):
        run = create(tmp_path / "runs" / name, overwrite=False)
        if stage == "merged":
            merge_runs({}, run, {})
        else:
            write_manifest(run, estimated())
    (tmp_path / "runs" / "empty").mkdir()
    (tmp_path / "runs" / ".drives").mkdir()
    return tmp_path / "runs"


def test_folder_names_its_runs_but_not_their_merged_run(runs: Path) -> None:
    assert runs_of([str(runs)]) == (runs / "a", runs / "b", runs / "deep" / "c")


def test_patterns_and_list_files_are_expanded(runs: Path) -> None:
    runs.parent.joinpath("runs.txt").write_text("# two\nruns/b\n\nruns/a\n")

    assert runs_of([f"{runs}/[ab]"]) == (runs / "a", runs / "b")
    assert runs_of([f"@{runs.parent}/runs.txt"]) == (runs / "b", runs / "a")


@pytest.mark.parametrize(
    ("argument", "message"),
    [
        ("{}/empty", "neither a run folder nor a folder of runs"),
        ("{}/z*", "nothing matches"),
        ("@{}/gone", "No such file"),
        ("@{}/a/manifest.json", "neither|names no run|no run folder"),
    ],
)
def test_invalid_run_arguments_are_refused_in_one_line(
    runs: Path, argument: str, message: str
) -> None:
    if "manifest" in argument:
        (runs / "a" / "manifest.json").write_text("# nothing\n")

    with pytest.raises(CrosscueError, match=message) as caught:
        runs_of([argument.format(runs)])

    assert "\n" not in str(caught.value)
