"""With ``--json`` a command prints one strict JSON document and nothing else, whatever it met."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Final

import numpy as np
import pytest

from crosscue.eval import cli
from support.gap_drive import Clock, write_drive
from support.landmark_files import database_of

# In this order: each reads what those before it wrote. LOG is a drive with a gap.
LINES: Final[dict[str, tuple[str, int]]] = {
    "info": ("LOG --vehicle CAR", 3),
    "seal": ("LOG", 0),
    "vehicle init": ("LOG -o made.toml", 0),
    "convert": ("LOG -o converted.mcap", 0),
    "decode": ("LOG --vehicle CAR -o tables", 3),
    "detect": ("LOG --vehicle CAR -o found --no-cache", 3),
    "replay": ("LOG --vehicle CAR -o runs/a --no-cache", 3),
    "estimate": ("runs/a", 3),
    "score": ("runs/a --truth TRUTH", 0),
    "compare": ("runs/a runs/a", 0),
    "merge": ("runs -o merged", 0),
    "truth check": ("TRUTH --log LOG", 0),
    "truth schema": ("", 0),
    "run schema": ("", 0),
    "landmarks list": ("marks.sqlite", 0),
    "model list": ("", 0),
    "model show": ("yolox-nano", 0),
    "plugins": ("", 0),
}
ALWAYS_JSON: Final = frozenset({"truth schema", "run schema"})
NO_JSON: Final = frozenset({"view", "completion"})
NEEDS_MORE: Final = frozenset(
    {
        "demo", "fit compass", "fit landmarks", "fit messages", "fit ranges", "fit signs",
        "landmarks add", "landmarks match", "model check", "model fetch", "model init", "simulate",
        "study drive", "study field", "study intersections", "study landmarks", "study range",
        "train frames", "train mask-rcnn", "train road", "truth", "truth import",
    }
)  # fmt: skip
"""Networks, downloads, pictures or minutes; tests of their own run and parse most of them."""


def strict(text: str) -> Any:
    """The one document that a text is, without NaN, infinities or a key given twice."""

    def refuse(name: str) -> Any:
        raise ValueError(f"{name} is not JSON")

    def once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        assert len(dict(pairs)) == len(pairs)
        return dict(pairs)

    return json.loads(text, parse_constant=refuse, object_pairs_hook=once)


def test_the_table_is_whole() -> None:
    assert LINES.keys() | NO_JSON | NEEDS_MORE == cli.COMMANDS.keys()


def test_every_result_is_one_strict_document(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    log = write_drive(tmp_path, Clock(pause_s=(5.0, 9.0)))
    database_of(tmp_path / "marks.sqlite", np.array([[0.0, 1.0], [2.0, 3.0]]))
    places = {"LOG": str(log), "CAR": "car.toml", "TRUTH": "truth.json"}
    ended = {}
    for name, (line, status) in LINES.items():
        words = [*name.split(), *(places.get(word, word) for word in line.split())]
        got = cli.run(words if name in ALWAYS_JSON else [*words, "--json"])
        printed = capsys.readouterr()
        assert printed.out, f"{name}: {printed.err}"
        assert isinstance(strict(printed.out), dict | list), name
        if got != status:
            ended[name] = (got, printed.err)
    assert not ended


@pytest.mark.parametrize("clock", [Clock(pause_s=(0.3, 13.5)), Clock(pause_s=(2.0, 20.0))])
def test_figures_that_do_not_exist_are_null(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], clock: Clock
) -> None:
    log = write_drive(tmp_path, clock)
    car, run, truth = (str(tmp_path / name) for name in ("car.toml", "run", "truth.json"))

    cli.run(["replay", str(log), "--vehicle", car, "-o", run, "--no-cache", "--json"])
    printed = capsys.readouterr()
    assert strict(printed.out)["pose"], printed.err
    cli.run(["score", run, "--truth", truth, "--json"])
    printed = capsys.readouterr()
    assert strict(printed.out or "null"), printed.err
    assert strict((Path(run) / "score" / "metrics.json").read_text())
