"""Sound input of which nothing comes: one line, exit status 1, nothing that looks finished."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from crosscue.datasets.truth.truth import Truth, save
from crosscue.eval import cli
from support.gap_drive import BEGIN, SECOND, Clock, replayed, write_drive
from support.pictures import picture, picture_folder
from support.rosbag_files import Row, write_folder

CASES: dict[str, str] = {
    "truth": "{log} -o {out}",
    "truth import": "{empty}/coco.json --log {log} -o {out}.json --vehicle {car}",
    "truth check": "{empty}/truth.json --log {other}",
    "fit compass": "{log} --vehicle {car}",
    "fit signs": "{empty}/labels.csv --label stop",
    "fit messages": "{run} --truth {empty}/truth.json -o {out}.toml",
    "fit ranges": "--cue stop_sign --truth {empty}/truth.json",
    "fit landmarks": "--pairs {empty}/pairs.csv",
    "score": "{run} --truth {empty}/truth.json -o {out}",
    "train mask-rcnn": "--data {empty}/coco.json --images {empty} -o {out}.safetensors",
    "train road": "--data {empty} -o {out}.safetensors",
    "landmarks add": "{out}.db --images {empty} --coordinates {empty}/places.csv",
    "vehicle init": "{strange} -o {out}.toml",
    "merge": "{empty} -o {out}",
}
ELSEWHERE: dict[str, str] = {
    "replay": "test_empty_result.py", "estimate": "test_empty_result.py",
    "detect": "test_empty_result.py", "decode": "test_empty_result.py",
    "convert": "test_empty_result.py",
    "info": "that there is no row is its result", "landmarks list": "an empty list is its result",
    "landmarks match": "that nothing matches is its result",
    "compare": "that nothing changed is its result", "view": "shows whatever a run holds",
    "seal": "seals whatever bytes there are", "train frames": "simulates", "simulate": "simulates",
    "demo": "simulates", "study drive": "simulates", "study field": "simulates",
    "study intersections": "simulates", "study landmarks": "simulates", "study range": "simulates",
    "truth schema": "prints a constant",
    "run schema": "prints a constant", "completion": "prints a constant",
    "plugins": "that there are none is its result", "model list": "prints a table",
    "model show": "prints a card", "model check": "that nothing is found is its result",
    "model fetch": "copies a file", "model init": "copies a file",
}  # fmt: skip
"""Commands of which the table above says nothing, and why."""


def test_every_command_is_in_one_of_the_tables() -> None:
    assert not CASES.keys() & ELSEWHERE.keys()
    assert CASES.keys() | ELSEWHERE.keys() == cli.COMMANDS.keys()


@pytest.fixture(scope="module")
def names(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A drive and its run, and inputs of every kind that are whole and hold nothing."""
    folder = tmp_path_factory.mktemp("inputs")
    drive, empty = folder / "drive", folder / "empty"
    log = write_drive(drive, Clock(), seconds=4)
    run = replayed(drive, log, "../run")
    for place in (empty / "images", empty / "masks"):
        place.mkdir(parents=True)
    save(Truth(version=1, source="x", start_ns=BEGIN, end_ns=BEGIN + 4 * SECOND), empty)
    coco: dict[str, list[object]] = {"categories": [], "images": [], "annotations": []}
    (empty / "coco.json").write_text(json.dumps(coco))
    (empty / "a.png").write_bytes(picture(1))
    (empty / "labels.csv").write_text("picture,label,x0,y0,x1,y1\na.png,,,,,\n")
    (empty / "pairs.csv").write_text("query,known,same\n")
    (empty / "places.csv").write_text("image,x_m,y_m,sd_m\na.png,0,0,1\n")
    message = Row("/can", BEGIN, b"\0\1\0\0\2\0\0\0a\0")
    return {
        "log": log,
        "run": run.path,
        "car": drive / "car.toml",
        "empty": empty,
        "other": picture_folder(folder / "front", 3, "rate_hz: 10\n"),
        "strange": write_folder(folder / "strange", [message]),
    }


@pytest.mark.parametrize("command", CASES)
def test_nothing_comes_of_it(
    command: str, names: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.rmtree(names["run"] / "score", ignore_errors=True)
    argv = CASES[command].format(**names, out=tmp_path / "out").split()

    status = cli.run([*command.split(), *argv])

    captured = capsys.readouterr()
    assert status == 1, captured.err
    assert captured.out == ""
    assert captured.err.startswith("crosscue: ")
    assert captured.err.count("\n") == 1
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]
    assert not (names["run"] / "score").exists()
