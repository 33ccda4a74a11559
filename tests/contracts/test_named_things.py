"""A name in an option is looked up before a log is read, and refused if nothing has it."""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

import numpy as np
import pytest

from crosscue.eval import cli
from support.empty_inputs import empty_inputs
from support.failures import table_of_failures
from support.gap_drive import BEGIN, BUS, Clock, write_drive
from support.landmark_files import database_of
from support.mcap_files import McapFile
from support.onnx_models import bright_box_model
from support.pictures import picture

COCO: Final = "--data {labels} --images {empty} -o {out}.safetensors"
# A command line of each command with such options, without the option to be tested.
BASE: Final[dict[str, str]] = {
    "info": "{log}",
    "convert": "{log} -o {out}.mcap",
    "vehicle init": "{log} -o {out}.toml",
    "check": "{card}",
    "decode": "{log} -o {out} --vehicle {car}",
    "detect": "{log} -o {out} --vehicle {car} --no-cache",
    "estimate": "{run}",
    "replay": "{log} -o {out} --vehicle {car} --no-cache",
    "score": "{run} -o {out} --without-figures --without-images",
    "score detector": "{run} -o {out} --labels {labels}",
    "compare": "{run} {run}",
    "history": "{runs} -o {out}.html",
    "tag": "{run}",
    "view": "{run} -o {out}.rrd",
    "report": "{run} -o {out}.html",
    "failures": "{run}",
    "browse": "{run} -o {out}",
    "export": "{failures} -o {out}",
    "model init": "{weights}",
    "model fetch": "yolox-nano",
    "fit compass": "{log} --vehicle {car}",
    "fit odometry": "{log} --vehicle {car}",
    "fit signs": "{signs} --label a",
    "fit ranges": "--cue stop_sign --truth {truth}",
    "fit detector": "{run} --labels {labels}",
    "fit messages": "{run} --truth {truth}",
    "fit temporal": "{run} --truth {truth}",
    "fit landmarks": "{log} --database {db} --poses {truth}",
    "landmarks add": "{out}.db {log} --poses {truth}",
    "landmarks list": "{db}",
    "landmarks match": "{db} {empty}/a.png",
    "truth from-gnss": "{log} -o {out}",
    "truth import": "{empty}/coco.json --log {log} -o {out}.json",
    "train mask-rcnn": COCO,
    "train road": "--layouts L0 -o {out}.safetensors",
    "study intersections": "-o {out} --layouts A --runs 1 --width 160 --no-attribution",
    "study range": "-o {out}",
    "study landmarks": "-o {out}",
    "study field": "-o {out}",
    "demo": "-o {out} --real",
}

OTHER_BASE: Final[dict[tuple[str, str], str]] = {
    ("landmarks add", "--images"): "{out}.db --coordinates {empty}/places.csv",
    ("landmarks add", "--coordinates"): "{out}.db --images {empty}",
    ("fit landmarks", "--pairs"): "",
    ("compare", "--runs"): "{runs} --against true",
    ("compare", "--against"): "{runs} --runs true",
    ("fit detector", "--test-labels"): "{run} --labels {labels} --test {run}",
    ("fit detector", "--test"): "{run} --labels {labels} --test-labels {labels}",
    ("fit ranges", "--test"): "{ranges} --cue stop_sign",
    ("train mask-rcnn", "--val-data"): COCO + " --val-images {empty}",
    ("train mask-rcnn", "--val-images"): COCO + " --val-data {labels}",
    ("train mask-rcnn", "--measure"): "--data {labels} --images {empty}",
    ("train road", "--measure"): "--test-layouts A",
    ("train road", "--data"): "-o {out}.safetensors",
    ("study intersections", "--layouts"): "-o {out}",
    ("train road", "--layouts"): "-o {out}.safetensors",
    ("truth import", "--export"): "{empty}/coco.json -o {out}",
}

FILE: Final = ("{gone}", "{noise}")
# A file that is missing, one of another kind, and one nested 3,000 levels deep.
TREE: Final = (*FILE, "{deep}")

# How to spell a thing that does not exist, by option.
NONEXISTENT: Final[dict[str, tuple[str, ...]]] = {
    "--against": ("nosuch=1",),
    "--card": TREE,
    "--class-names": ("{gone}",),
    "--coordinates": FILE,
    "--data": FILE,
    "--database": FILE,
    "--dbc": FILE,
    "--detector": ("nosuch",),
    "--detectors": ("nosuch", "{gone}.toml", "{deep}", "nosuch.module:build", "os:nosuch"),
    "--export": ("{gone}",),
    "--gate": TREE,
    "--images": ("{gone}",),
    "--init": FILE,
    "--kind": ("nosuch",),
    "--labels": FILE,
    "--landmarks": FILE,
    "--layouts": ("nosuch",),
    "--log": FILE,
    "--logs": ("{gone}",),
    "--map": ("nosuch=a",),
    "--matcher": ("nosuch", "nosuch.module:build", "os:nosuch"),
    "--measure": FILE,
    "--only": ("nosuch",),
    "--pairs": FILE,
    "--picture": FILE,
    "--poses": TREE,
    "--runs": ("nosuch=1",),
    "--settings": TREE,
    "--start": TREE,
    "--test": FILE,
    "--test-labels": FILE,
    "--test-layouts": ("nosuch",),
    "--topics": ("/nosuch",),
    "--truth": TREE,
    "--val-data": FILE,
    "--val-images": ("{gone}",),
    "--val-layouts": ("nosuch",),
    "--vehicle": TREE,
    "--where": ("nosuch=1",),
}

OTHER_NONEXISTENT: Final[dict[tuple[str, str], tuple[str, ...]]] = {
    ("model fetch", "--from"): ("{gone}",),
    ("fit ranges", "--runs"): FILE,
    ("fit signs", "--test"): FILE,
    ("demo", "--data"): ("{gone}",),
}

# Options whose value is not the name of something that exists.
NAMES_NOTHING: Final[dict[str, str]] = {
    "--at": "a time",
    "--by": "a tag that runs may lack; if all do, the result is empty, see test_history.py",
    "--cache": "made if missing",
    "--classes": "new names of the user",
    "--date": "a date to store",
    "--experiment": "made if missing",
    "--figure": "written",
    "--from": "a time",
    "--junit": "written",
    "--label": "a label that files may lack; if all do, the result is empty",
    "--max-chunk": "a number",
    "--metrics": "a pattern; one that fits nothing has an empty result, see test_history.py",
    "--mlflow": "an address that only the server can refuse, see test_mlflow_sink.py",
    "--near": "numbers",
    "--output": "written",
    "--ray": "an address that only a cluster can refuse",
    "--remove": "a tag that a run may lack",
    "--shard": "numbers",
    "--sheet": "written",
    "--size": "numbers",
    "--source": "a name to store",
    "--subset": "numbers",
    "--to": "a time",
    "--tolerance": "a pattern; one that fits nothing allows nothing",
}

# Options whose value is looked up in the log itself, or in labels of its pictures.
NEEDS_LOG: Final = {"--topics", "--map"}

NUMBERS: Final = ("int", "float", "metres", "_fraction")
LOGS: Final = ("log", "bus_log", "empty_log")


def _options() -> Iterator[tuple[str, str]]:
    """Yield each command and option whose value the parser does not check by itself."""
    for name in cli.COMMANDS:
        for action in cli.parser_of(name)[1]._actions:
            kind = getattr(action.type, "__name__", "")
            is_free = action.nargs != 0 and not action.choices and kind not in NUMBERS
            if action.option_strings and is_free and not _is_help(action):
                yield name, action.option_strings[-1]


def _is_help(action: argparse.Action) -> bool:
    return "--help" in action.option_strings


OPTIONS: Final = tuple(_options())


def _spellings(name: str, option: str) -> tuple[str, ...]:
    if (name, option) in OTHER_NONEXISTENT:
        return OTHER_NONEXISTENT[name, option]
    return () if option in NAMES_NOTHING else NONEXISTENT.get(option, ())


def _base(name: str, option: str) -> str:
    return OTHER_BASE.get((name, option), BASE.get(name, ""))


CASES: Final = [
    (name, option, spelling, "log" if option == "--map" else LOGS[number % len(LOGS)])
    for name, option in OPTIONS
    for number, spelling in enumerate(_spellings(name, option), len(name))
]


def test_every_option_has_spelling_of_nonexistent_thing_or_names_nothing() -> None:
    assert {option for _, option in OPTIONS} == NONEXISTENT.keys() | NAMES_NOTHING.keys()
    assert not NONEXISTENT.keys() & NAMES_NOTHING.keys()
    assert all(name in BASE for name, option in OPTIONS if _spellings(name, option))
    assert {*OTHER_BASE, *OTHER_NONEXISTENT} <= {*OPTIONS}


_opened: list[str] | None = None


def _hook(event: str, args: tuple[object, ...]) -> None:
    if event == "open" and _opened is not None and isinstance(args[0], str | bytes):
        _opened.append(os.fsdecode(args[0]))


sys.addaudithook(_hook)


@contextmanager
def _watched() -> Iterator[list[str]]:
    """Collect the paths of all files that this process opens."""
    global _opened
    found: list[str] = []
    _opened = found
    try:
        yield found
    finally:
        _opened = None


@pytest.fixture(scope="module")
def names(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Valid inputs of every kind, and things that do not exist."""
    folder = tmp_path_factory.mktemp("inputs")
    found = empty_inputs(folder)
    drive = found["car"].parent
    (folder / "nosuch_noise").write_bytes(b"\xff\x00[]{}" * 300)
    (folder / "nosuch_deep.toml").write_text(f"a = {'[' * 3000}{']' * 3000}\n")
    (folder / "empty.mcap").write_bytes(McapFile([]).coded())
    bus = found["car"].read_text().replace('camera = "camera"\n', "")
    (drive / "bus.toml").write_text(bus)
    table_of_failures(found["run"], folder / "failures.parquet")
    for place in ("weights", "model"):
        (folder / place).mkdir()
        (folder / place / "net.onnx").write_bytes(bright_box_model())
    (folder / "names.txt").write_text("bright\n")
    card = ["--class-names", f"{folder}/names.txt", "--size", "96x64"]
    assert cli.run(["model", "init", f"{folder}/model/net.onnx", *card]) == 0
    score = ["score", str(found["run"]), "--truth", f"{drive}/truth.json", "--without-figures"]
    assert cli.run(score) == 0
    annotation = {"id": 1, "image_id": 1, "category_id": 1, "bbox": [5, 5, 20, 20]}
    labels = {
        "categories": [{"id": 1, "name": "stop sign"}],
        "images": [{"id": 1, "file_name": "a.png", "width": 160, "height": 90, "t_ns": BEGIN}],
        "annotations": [annotation],
    }
    (folder / "labels.json").write_text(json.dumps(labels))
    (folder / "a.png").write_bytes(picture(0))
    (folder / "signs.csv").write_text("picture,label,x0,y0,x1,y1\na.png,a,1,1,9,9\n")
    (folder / "ranges.csv").write_text(
        "height_px,range_m\n" + "".join(f"{h},{600 / h}\n" for h in range(10, 50))
    )
    return {
        **found,
        "truth": drive / "truth.json",
        "gone": folder / "nosuch_gone",
        "noise": folder / "nosuch_noise",
        "deep": folder / "nosuch_deep.toml",
        "bus_log": write_drive(folder / "bus", Clock(), seconds=4, topics=[BUS]),
        "empty_log": folder / "empty.mcap",
        "db": database_of(folder / "known.db", np.array([[0.0, 1.0]])),
        "runs": found["run"].parent,
        "weights": folder / "weights" / "net.onnx",
        "card": folder / "model" / "net.toml",
        "labels": folder / "labels.json",
        "signs": folder / "signs.csv",
        "ranges": folder / "ranges.csv",
        "failures": folder / "failures.parquet",
    }


@pytest.mark.parametrize(
    ("name", "option", "spelling", "log"), CASES, ids=lambda one: str(one).strip("{}-")
)
def test_option_that_names_nonexistent_thing_is_refused_before_log_is_read(
    name: str,
    option: str,
    spelling: str,
    log: str,
    names: dict[str, Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    known = {**names, "log": names[log], "out": tmp_path / "out"}
    word = spelling.format(**known)
    argv = [*name.split(), *_base(name, option).format(**known).split(), option, word]

    with _watched() as opened:
        status = cli.run(argv)

    captured = capsys.readouterr()
    assert status in (2, 4), captured
    assert captured.out == ""
    assert captured.err.startswith("crosscue: ")
    assert captured.err.count("\n") == 1
    assert Path(word.partition("=")[0]).name in captured.err
    assert not list(tmp_path.iterdir())
    if option not in NEEDS_LOG:
        assert str(known["log"]) not in opened
