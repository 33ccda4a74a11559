"""With ``--json`` every command prints exactly one strict JSON document."""

import json
import re
from pathlib import Path
from typing import Any, Final

import numpy as np
import pytest

from crosscue.datasets.simulated.drive import DriveSettings
from crosscue.datasets.simulated.log_files import write_drive as simulated
from crosscue.eval import cli
from crosscue.results import Result
from support.coco import stop_signs
from support.gap_drive import BEGIN, ROW, SIZE, Clock, write_drive
from support.kitti_drive import raw_drive
from support.landmark_files import database_of, write_walls
from support.onnx_models import bright_box_model
from support.pictures import picture
from support.scenes import shorten
from support.street_map import write_crossing

# The order matters: commands read results of earlier ones. LOG is a drive with a gap.
LINES: Final[dict[str, tuple[str, int]]] = {
    "info": ("LOG --vehicle CAR", 3),
    "seal": ("LOG", 0),
    "vehicle init": ("LOG -o made.toml", 0),
    "check": ("LOG CAR TRUTH -o check.html", 0),
    "convert": ("LOG -o converted.mcap", 0),
    "decode": ("LOG --vehicle CAR -o tables", 3),
    "detect": ("LOG --vehicle CAR -o found --no-cache", 3),
    "replay": ("LOG --vehicle CAR -o runs/a --no-cache", 3),
    "estimate": ("runs/a", 3),
    "score": ("runs/a --truth TRUTH", 0),
    "score detector": ("runs/a --labels road/coco.json", 0),
    "fit detector": ("runs/a --labels road/coco.json", 1),
    "compare": ("runs/a runs/a", 0),
    "merge": ("runs -o merged", 0),
    "failures": ("runs/a --truth TRUTH -o worst.parquet", 0),
    "browse": ("runs/a --truth TRUTH -o site", 0),
    "export": ("worst.parquet -o labelling", 0),
    "query": ("runs SQL", 0),
    "tag": ("runs/a weather=rain", 0),
    "report": ("runs/a", 0),
    "status": ("runs", 0),
    "history": ("runs --by version", 0),
    "truth schema": ("", 0),
    "landmarks list": ("marks.sqlite", 0),
    "model list": ("", 0),
    "model show": ("yolox-nano", 0),
    "plugins": ("", 0),
}
ALWAYS_JSON: Final = frozenset({"truth schema"})
NO_JSON: Final = frozenset({"view", "completion"})
# The same for commands that create or fit something.
MADE: Final[dict[str, tuple[str, int]]] = {
    "fit ranges": ("photos/heights.csv --cue stop_sign", 0),
    "fit signs": ("photos/labels.csv --label yield", 1),
    "fit compass": ("COMPASS --vehicle ITS_CAR", 0),
    "fit odometry": ("COMPASS --vehicle ITS_CAR --truth ITS_TRUTH --keep", 0),
    "fit landmarks": ("--pairs photos/pairs.csv --false-match-rate 0.4", 0),
    "landmarks add": ("new.db --images photos --coordinates photos/places.csv", 0),
    "landmarks match": ("new.db photos/seen1.png", 0),
    "model init": ("net.onnx", 0),
    "truth from-gnss": ("KITTI -o from_gnss", 0),
    "truth from-map": ("KITTI streets.osm -o from_map", 0),
    "truth": ("KITTI -o its_truth", 0),
    "truth import": ("road/coco.json --log LOG -o imported.json", 0),
    "simulate": ("A -o simulated --width 64 --fps 10", 0),
    "study landmarks": ("-o marks --drives 1", 0),
    "train frames": ("L400 -o frames --per-layout 1 --width 64", 0),
    "train road": (
        "--data road -o road.safetensors --steps 1 --batch 1 --width 128 --device cpu",
        0,
    ),
    "train mask-rcnn": (
        "--data road/coco.json --images road/images -o net.safetensors --steps 1 --batch 1 "
        "--check-every 1 --window 64 64 --width 128 --device cpu",
        0,
    ),
}
# A single thing in the plural: "1 drives". Verbs and units that end with s are none.
ONE_OF_MANY: Final = re.compile(
    r"(?<![\w.,+-])(?<!of )1 (?!(?:is|has|was|as|ms|ns|us|s|means|differs)\b)[a-z]+s\b"
)
# Commands that are not run, and why.
ELSEWHERE: Final[dict[str, str]] = {
    "demo": "simulates and replays for minutes",
    "fetch": "downloads; tests/eval/drives/test_demo.py",
    "study intersections": "simulates and replays for minutes",
    "study layouts": "simulates and replays for minutes",
    "study range": "simulates for half a minute, and prints what study landmarks does",
    "study field": "simulates for minutes",
    "fit temporal": "needs many drives; tests/eval/fit/test_message_fit.py parses it",
    "fit messages": "needs many approaches; tests/eval/fit/test_message_fit.py parses it",
    "model fetch": "needs a network's weights",
}


def strict(text: str) -> Any:
    """Parse a text as one document without NaN, infinities or duplicate keys."""

    def refuse(name: str) -> Any:
        raise ValueError(f"{name} is not JSON")

    def once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        assert len(dict(pairs)) == len(pairs)
        return dict(pairs)

    return json.loads(text, parse_constant=refuse, object_pairs_hook=once)


def test_every_command_is_tested_or_excluded_with_reason() -> None:
    assert LINES.keys() | MADE.keys() | NO_JSON | ELSEWHERE.keys() == cli.COMMANDS.keys()
    assert not (LINES.keys() | MADE.keys()) & ELSEWHERE.keys()


def test_json_of_reading_commands_is_one_strict_document(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    texts: list[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    log = write_drive(tmp_path, Clock(pause_s=(5.0, 9.0)))
    database_of(tmp_path / "marks.sqlite", np.array([[0.0, 1.0], [2.0, 3.0]]))
    _write_road(tmp_path / "road")
    places = {"LOG": str(log), "CAR": "car.toml", "TRUTH": "truth.json", "SQL": "from runs"}
    _run(LINES, places, capsys, texts)


def test_json_of_creating_commands_is_one_strict_document(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    texts: list[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    shorten(monkeypatch, pictures=2)
    log = write_drive(tmp_path, Clock(), seconds=4)
    compass = simulated(tmp_path / "compass", DriveSettings(seed=3, blocks=1, block_m=40.0))
    _write_photos(tmp_path / "photos")
    _write_road(tmp_path / "road")
    write_crossing(tmp_path / "streets.osm")
    (tmp_path / "net.onnx").write_bytes(bright_box_model())
    places = {
        "LOG": str(log),
        "COMPASS": str(compass.log),
        "ITS_CAR": str(compass.vehicle),
        "ITS_TRUTH": str(compass.truth),
        "KITTI": str(raw_drive(tmp_path / "kitti")),
    }
    _run(MADE, places, capsys, texts)


@pytest.fixture(autouse=True)
def texts(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The text of every result that is printed as JSON."""
    found: list[str] = []
    as_dict = Result.as_dict

    def kept(result: Result) -> Any:
        found.append(repr(result))
        return as_dict(result)

    monkeypatch.setattr(Result, "as_dict", kept)
    return found


def _run(
    lines: dict[str, tuple[str, int]],
    places: dict[str, str],
    capsys: pytest.CaptureFixture[str],
    texts: list[str],
) -> None:
    """Run commands; one thing is named in the singular in what they print."""
    ended = {}
    for name, (line, status) in lines.items():
        words = [*name.split(), *(places.get(word, word) for word in line.split())]
        got = cli.run(words if name in ALWAYS_JSON else [*words, "--json"])
        printed = capsys.readouterr()
        assert printed.out, f"{name}: {printed.err}"
        assert isinstance(strict(printed.out), dict | list), name
        if got != status:
            ended[name] = (got, printed.err)
    assert not ended
    assert texts
    found = [line for text in texts for line in text.splitlines() if ONE_OF_MANY.search(line)]
    assert "\n".join(found) == ""


def _write_photos(folder: Path) -> None:
    """Write two pictures of each of four walls, and one table of each kind about them."""
    folder.mkdir()
    write_walls(folder)
    places = ["image,x_m,y_m,sd_m", *(f"{k}.png,{100 * k},0,1" for k in range(4))]
    heights = ["height_px,range_m", *(f"{200 / m},{m}" for m in range(5, 60))]
    labels = ["picture,label,x0,y0,x1,y1", "0.png,yield,1,1,40,40", "seen0.png,,,,,"]
    tables = {"places": places, "heights": heights, "labels": labels}
    for name, rows in tables.items():
        (folder / f"{name}.csv").write_text("\n".join(rows) + "\n")


def _write_road(folder: Path) -> None:
    """Write road masks and two annotated pictures at the times of the drive's first two frames."""
    for place in ("images", "masks"):
        (folder / place).mkdir(parents=True)
        for k in range(2):
            content = picture(k, width=SIZE[0], height=SIZE[1])
            (folder / place / f"{k}.png").write_bytes(content)
    labels = stop_signs(((f"{k}.png", BEGIN + k * ROW) for k in range(2)), SIZE)
    (folder / "coco.json").write_text(labels)


@pytest.mark.parametrize("clock", [Clock(pause_s=(0.3, 13.5)), Clock(pause_s=(2.0, 20.0))])
def test_missing_values_are_null_in_json(
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
