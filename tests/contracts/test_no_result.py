"""Valid input without a result: one line, exit status 1, and no files."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from support.empty_inputs import COMMANDS, empty_inputs
from support.refusals import refusal


@pytest.fixture(scope="module")
def names(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A drive and its run, and valid empty inputs of every kind."""
    return empty_inputs(tmp_path_factory.mktemp("inputs"))


@pytest.mark.parametrize("command", COMMANDS)
def test_empty_result_is_reported_in_one_line_without_files(
    command: str, names: dict[str, Path], tmp_path: Path
) -> None:
    shutil.rmtree(names["run"] / "score", ignore_errors=True)
    argv = COMMANDS[command].format(**names, out=tmp_path / "out").split()

    refusal(1, *command.split(), *argv)
    assert not list(tmp_path.iterdir())
    assert not (names["run"] / "score").exists()
