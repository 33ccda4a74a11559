"""Notebooks are stored without outputs; ``make docs`` executes each and fails if one fails."""

import json
import re
from pathlib import Path
from typing import Any

import pytest

FOLDER = Path(__file__).parents[1] / "notebooks"
# Notebooks that do not use the toolkit.
SELF_CONTAINED = {"variable_recruitment"}
# What notebooks use of verbs beside the public names: settings and helpers, at their homes.
HOMES = {
    "crosscue.detectors.signs.templates",
    "crosscue.eval.drives.replay",
    "crosscue.eval.studies.town.settings",
}
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))


def _cells(path: Path) -> list[dict[str, Any]]:
    cells: list[dict[str, Any]] = json.loads(path.read_text(encoding="utf-8"))["cells"]
    return cells


def test_notebooks_are_found() -> None:
    assert NOTEBOOKS


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_is_stored_without_outputs(path: Path) -> None:
    code = [cell for cell in _cells(path) if cell["cell_type"] == "code"]

    assert all(not cell["outputs"] and cell["execution_count"] is None for cell in code)


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_uses_public_interface_only(path: Path) -> None:
    code = "\n".join("".join(one["source"]) for one in _cells(path) if one["cell_type"] == "code")
    modules = re.findall(r"^\s*(?:from|import) ([\w.]+)", code, re.MULTILINE)

    ours = {name for name in modules if name.partition(".")[0] == "crosscue"}
    assert ours or path.stem in SELF_CONTAINED
    assert ours <= {"crosscue", "crosscue.errors", "crosscue.testing", *HOMES}
    if path.stem in SELF_CONTAINED:
        assert {name.partition(".")[0] for name in modules} == {"numpy", "matplotlib"}
