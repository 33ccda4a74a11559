"""Paths of real recordings; tests without them are skipped."""

import os
from pathlib import Path

import pytest

from crosscue.eval.cli import run

_ROOT = Path(__file__).parents[2]


def shared(*parts: str) -> Path:
    """Return the path of a real recording below the data folder; skip the test if it is missing."""
    base = Path(os.environ.get("CROSSCUE_DATA", _ROOT.parent / "shared" / "data"))
    path = base.joinpath(*parts)
    if not path.exists():
        pytest.skip(f"real data missing: {path}; set CROSSCUE_DATA")
    return path


def fetch_networks(patch: pytest.MonkeyPatch, models: Path, *names: str) -> None:
    """Fetch networks from the data folder into a folder of models, which commands then use."""
    patch.setenv("CROSSCUE_DATA", str(shared("weights").parent))
    patch.setenv("CROSSCUE_MODELS", str(models))
    assert run(["model", "fetch", *names]) == 0
