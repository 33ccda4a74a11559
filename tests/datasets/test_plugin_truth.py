"""Failures of a plug-in's function that writes truth."""

import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest

from crosscue.datasets.truth import truth as truth_file
from crosscue.replay.errors import AnnotationError
from crosscue.replay.formats import DataSet, Format

NAME = "line-drive"
FUNCTION = "dummy_lines:truth"


def _install(monkeypatch: pytest.MonkeyPatch, function: Callable[[Path, Path], object]) -> None:
    module = ModuleType("dummy_lines")
    vars(module)["truth"] = function
    monkeypatch.setitem(sys.modules, "dummy_lines", module)
    data_set = DataSet(Format((), ("drive.lines",), "dummy_lines:open_drive", "folder"), FUNCTION)
    monkeypatch.setattr(truth_file, "data_sets", lambda: {NAME: data_set})


def test_plugin_error_about_log_is_unchanged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def truth(log: Path, folder: Path) -> Path:
        raise AnnotationError(f"{log}: no times; record it again")

    _install(monkeypatch, truth)

    with pytest.raises(AnnotationError, match=r"no times; record it again$"):
        truth_file.write_carried(NAME, tmp_path, tmp_path / "out")
