"""Where the real recordings lie, and a visible skip where they do not."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

_ROOT = Path(__file__).parents[2]


def shared(*parts: str) -> Path:
    """Path of a real recording below the data folder; skips the test when it is missing."""
    base = Path(os.environ.get("CROSSCUE_DATA", _ROOT.parent / "shared" / "data"))
    path = base.joinpath(*parts)
    if not path.exists():
        pytest.skip(f"real data not at hand: {path}; set CROSSCUE_DATA")
    return path
