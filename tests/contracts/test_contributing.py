"""The worked examples of CONTRIBUTING.md run as printed."""

import re
import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from textwrap import dedent
from types import SimpleNamespace
from typing import Any

import pytest

from crosscue.detectors.base import DetectorChoice
from crosscue.detectors.registry import BUILTIN, make
from crosscue.eval import cli
from crosscue.replay.errors import UsageError
from crosscue.replay.formats import FORMATS, Format
from crosscue.replay.vehicle.cue_spec import CueSpec
from crosscue.testing import check_cue, check_detector, check_reader
from support import one_row
from support.commands import output_of
from support.every_format import _bytes
from support.refusals import refusal

PAGE = (Path(__file__).parents[2] / "CONTRIBUTING.md").read_text(encoding="utf-8")


def _code(title: str) -> list[str]:
    """Return the Python code blocks of one example."""
    (part,) = re.findall(rf"^## Example: {title}\n(.*?)(?=^## |\Z)", PAGE, re.DOTALL | re.MULTILINE)
    return re.findall(r"```python\n(.*?)```", part, re.DOTALL)


def _row(code: str, **names: object) -> Any:
    """Evaluate a row of a table without its trailing comma."""
    code = dedent(code).strip().removesuffix(",")
    return eval("{" + code + "}" if code.startswith('"') else code, names)


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str, str], str]:
    """Return a function that writes an importable module and returns its name."""

    def write(name: str, code: str) -> str:
        (tmp_path / f"{name}.py").write_text(code)
        monkeypatch.syspath_prepend(tmp_path)
        return name

    return write


def test_cue_example_fulfils_contract(module: Callable[[str, str], str]) -> None:
    rule, row = _code("a cue")
    cue: CueSpec = _row(
        row.replace("crosscue.detectors.cues.pedestrians", module("example_cue", rule)),
        CueSpec=CueSpec,
    )

    assert cue.name == "pedestrians"
    check_cue(cue)


def test_reader_example_fulfils_contract(
    module: Callable[[str, str], str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    reader, row, small_log, damage = _code("a reader")
    place = module("example_reader", reader)
    row = row.replace("crosscue.replay.readers.speed.reader", place)
    monkeypatch.setitem(FORMATS, "speed", _row(row, Format=Format)["speed"])
    every = _row(small_log, _bytes=_bytes)
    write, damage_one = _row(damage, EVERY_FORMAT=every, _garbled_line=one_row._garbled_line)[
        "speed"
    ]

    check_reader(write(tmp_path), damage_one)


def test_detector_example_fulfils_contract(module: Callable[[str, str], str]) -> None:
    (code,) = _code("a detector")
    place = f"{module('example_detector', code)}:Lamp.build"

    check_detector(lambda: make(DetectorChoice("lamp", "lamp"), {**BUILTIN, "lamp": place}))


def test_command_example_has_the_described_options(
    module: Callable[[str, str], str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (code,) = _code("a command")
    verb = vars(import_module(module("example_command", code)))["longest_gap"]
    monkeypatch.setitem(cli.COMMANDS, "longest-gap", "eval.logs.longest_gap:longest_gap")
    monkeypatch.setitem(
        sys.modules, "crosscue.eval.logs.longest_gap", SimpleNamespace(longest_gap=verb)
    )

    help_text = output_of("longest-gap", "--help")
    for option in ("LOG", "--from", "--to", "--topics", "--max-chunk", "--min-s S", "--json", "-q"):
        assert option in help_text, option
    assert "--min-s -1.0: expected more than 0" in refusal(
        2, "longest-gap", "drive.mcap", "--min-s", "-1"
    )
    with pytest.raises(UsageError, match=r"min_s: -1\.0, expected more than 0"):
        verb("drive.mcap", min_s=-1.0)
