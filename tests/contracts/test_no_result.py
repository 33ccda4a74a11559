"""Valid input without a result: one line, exit status 1, and no files."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from crosscue.eval import cli
from support.empty_inputs import COMMANDS, empty_inputs

# Commands that are tested elsewhere or have a result for any valid input.
ELSEWHERE: dict[str, str] = {
    "replay": "test_empty_result.py", "estimate": "test_empty_result.py",
    "detect": "test_empty_result.py", "decode": "test_empty_result.py",
    "convert": "test_empty_result.py",
    "info": "that there is no row is its result", "landmarks list": "an empty list is its result",
    "landmarks match": "that nothing matches is its result",
    "failures": "that nothing went wrong is its result",
    "status": "that no drive is there is its result", "history": "test_history.py",
    "query": "a table without rows is its result", "tag": "sets what it is asked to set",
    "compare": "that nothing changed is its result", "view": "shows whatever a run holds",
    "seal": "seals whatever bytes there are", "train frames": "simulates", "simulate": "simulates",
    "demo": "simulates", "study drive": "simulates", "study field": "simulates",
    "study intersections": "simulates", "study layouts": "simulates",
    "study landmarks": "simulates", "study range": "simulates",
    "truth schema": "prints a constant",
    "run schema": "prints a constant", "completion": "prints a constant",
    "plugins": "an empty list is its result", "model list": "prints a table",
    "model show": "prints a card", "model check": "that nothing is found is its result",
    "model fetch": "copies a file", "model init": "copies a file",
}  # fmt: skip


def test_every_command_is_tested_or_excluded_with_reason() -> None:
    assert not COMMANDS.keys() & ELSEWHERE.keys()
    assert COMMANDS.keys() | ELSEWHERE.keys() == cli.COMMANDS.keys()


@pytest.fixture(scope="module")
def names(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A drive and its run, and valid empty inputs of every kind."""
    return empty_inputs(tmp_path_factory.mktemp("inputs"))


@pytest.mark.parametrize("command", COMMANDS)
def test_empty_result_is_reported_in_one_line_without_files(
    command: str, names: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.rmtree(names["run"] / "score", ignore_errors=True)
    argv = COMMANDS[command].format(**names, out=tmp_path / "out").split()

    status = cli.run([*command.split(), *argv])

    captured = capsys.readouterr()
    assert status == 1, captured.err
    assert captured.out == ""
    assert captured.err.startswith("crosscue: ")
    assert captured.err.count("\n") == 1
    assert not list(tmp_path.iterdir())
    assert not (names["run"] / "score").exists()
