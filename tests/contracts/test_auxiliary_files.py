"""Every argument and option that names an input file is tested with missing and unusable files.

For a missing or empty file, noise, a folder or other text, the exit status is 4 for input and 2 for
settings. One line names the file, and no file is written. A file of an option is refused before a
log is read.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Final

import pytest

from crosscue.eval import cli
from crosscue.localization.landmarks.database import LandmarkWriter
from support.coco import stop_signs
from support.failures import table_of_failures
from support.gap_drive import BEGIN, BUS, Clock, replayed, write_drive
from support.mcap_files import McapFile
from support.onnx_models import bright_box_model
from support.opened_files import opened_files
from support.pictures import picture
from support.refusals import refusal
from support.street_map import write_crossing
from support.trees import tree

# Command lines in which ``{gone}`` is an input file: exit status 4.
INPUT_FILES: Final[dict[tuple[str, str], str]] = {
    ("info", "LOG"): "{gone}",
    ("convert", "LOG"): "{gone} -o {out}.mcap",
    ("decode", "LOG"): "{gone} -o {out}",
    ("detect", "LOG"): "{gone} -o {out} --detectors signs",
    ("replay", "LOG"): "{gone} -o {out}",
    ("vehicle init", "LOG"): "{gone} -o {out}.toml",
    ("check", "FILE"): "{gone}",
    ("fit compass", "LOG"): "{gone} --vehicle {car}",
    ("truth from-gnss", "LOG"): "{gone} -o {out}",
    ("truth from-map", "LOG"): "{gone} {streets} -o {out}",
    ("truth from-map", "FILE"): "{log} {gone} -o {out}",
    ("fit odometry", "LOG"): "{gone} --vehicle {car}",
    ("landmarks add", "LOG"): "{out}.db {gone} --poses {truth} --vehicle {car}",
    ("truth", "LOG"): "{gone} -o {out}",
    ("estimate", "RUN"): "{gone}",
    ("estimate", "--start"): "{run} --start {gone}",
    ("replay", "--start"): "{log} --vehicle {car} -o {out} --start {gone}",
    ("score", "RUN"): "{gone} --truth {truth}",
    ("score detector", "RUN"): "{gone} --labels {coco}",
    ("score detector", "--labels"): "{run} --labels {gone}.json",
    ("score detector", "--logs"): "{run} --labels {coco} --logs {gone}",
    ("fit detector", "RUN"): "{gone} --labels {coco}",
    ("fit detector", "--labels"): "{run} --labels {gone}.json",
    ("fit detector", "--logs"): "{run} --labels {coco} --logs {gone}",
    ("fit detector", "--test"): "{run} --labels {coco} --test {gone} --test-labels {coco}",
    (
        "fit detector",
        "--test-labels",
    ): "{run} --labels {coco} --test {run} --test-labels {gone}.json",
    ("view", "RUN"): "{gone} -o {out}.rrd",
    ("report", "RUN"): "{gone} -o {out}.html",
    ("compare", "RUN_A"): "{gone} {run}",
    ("compare", "RUN_B"): "{run} {gone}",
    ("merge", "RUNS"): "{gone} -o {out}",
    ("query", "RUNS"): "{gone} --schema",
    ("tag", "RUN"): "{gone} weather=rain",
    ("status", "RUNS"): "{gone}",
    ("failures", "RUN"): "{gone}",
    ("failures", "--truth"): "{run} --truth {gone}",
    ("browse", "RUN"): "{gone} -o {out}",
    ("browse", "--truth"): "{run} -o {out} --truth {gone}",
    ("browse", "--logs"): "{failures} -o {out} --logs {gone}",
    ("export", "FAILURES"): "{gone} -o {out}",
    ("export", "--logs"): "{failures} -o {out} --logs {gone}",
    ("truth import", "--export"): "{coco} --export {gone} -o {out}",
    ("history", "RUNS"): "{gone}",
    ("fit messages", "RUN"): "{gone} --truth {truth} -o {out}.toml",
    ("fit signs", "LABELS"): "{gone}.csv --label stop",
    ("fit ranges", "TABLE"): "{gone} --cue stop_sign",
    ("landmarks add", "DB"): "{gone} --images {pictures} --coordinates {places}",
    ("landmarks list", "DB"): "{gone}",
    ("landmarks match", "DB"): "{gone} {picture}",
    ("landmarks match", "IMAGE"): "{db} {gone}",
    ("truth import", "ANNOTATIONS"): "{gone}.json --log {log} -o {out}.json",
    ("replay", "--landmarks"): "{log} -o {out} --vehicle {car} --landmarks {gone}",
    ("estimate", "--logs"): "{run} --logs {gone}",
    ("score", "--truth"): "{run} --truth {gone}",
    ("score", "--logs"): "{run} --truth {truth} --logs {gone}",
    ("view", "--truth"): "{run} -o {out}.rrd --truth {gone}",
    ("view", "--logs"): "{run} -o {out}.rrd --logs {gone}",
    ("report", "--logs"): "{run} -o {out}.html --logs {gone}",
    ("vehicle init", "--dbc"): "{log} -o {out}.toml --dbc {gone}.dbc",
    ("fit odometry", "--truth"): "{log} --vehicle {car} --truth {gone}",
    ("fit signs", "--test"): "{labels} --label stop --test {gone}.csv",
    ("fit ranges", "--truth"): "--cue stop_sign --truth {gone}",
    ("fit ranges", "--runs"): "--cue stop_sign --truth {truth} --runs {gone}",
    ("fit ranges", "--test"): "{pairs_m} --cue stop_sign --test {gone}",
    ("fit temporal", "RUN"): "{gone} --truth {truth} -o {out}.toml",
    ("fit temporal", "--truth"): "{run} --truth {gone} -o {out}.toml",
    ("fit messages", "--truth"): "{run} --truth {gone} -o {out}.toml",
    ("fit landmarks", "--pairs"): "--pairs {gone}",
    ("landmarks add", "--poses"): "{out}.db {log} --vehicle {car} --poses {gone}",
    ("landmarks add", "--images"): "{out}.db --images {gone} --coordinates {places}",
    ("landmarks add", "--coordinates"): "{out}.db --images {pictures} --coordinates {gone}",
    ("truth import", "--log"): "{coco} --log {gone} -o {out}.json",
    ("model init", "--picture"): "{onnx} -o {there}/new.toml --picture {gone}",
    ("check", "--picture"): "{card} --picture {gone} -o {out}.jpg",
    ("fetch", "--data"): "pandaset_002 --data {gone} -o {out}",
    ("demo", "--data"): "--real --data {gone} -o {out}",
    ("train road", "--data"): "--data {gone} -o {out}.safetensors",
    ("train mask-rcnn", "--data"): "--data {gone} --images {pictures} -o {out}.safetensors",
    ("train mask-rcnn", "--images"): "--data {coco} --images {gone} -o {out}.safetensors",
    (
        "train mask-rcnn",
        "--val-data",
    ): "-o {out}.safetensors --data {coco} --images {pictures} --val-data {gone} "
    "--val-images {pictures}",
    (
        "train mask-rcnn",
        "--val-images",
    ): "-o {out}.safetensors --data {coco} --images {pictures} --val-data {coco} "
    "--val-images {gone}",
}
# The same for files of settings: exit status 2.
SETTINGS_FILES: Final[dict[tuple[str, str], str]] = {
    ("score detector", "--class-names"): "{run} --labels {coco} --class-names {gone}",
    ("fit detector", "--class-names"): "{run} --labels {coco} --class-names {gone}",
    ("fit detector", "--card"): "{run} --labels {coco} --card {gone}",
    ("model init", "MODEL"): "{gone}.onnx",
    ("model show", "MODEL"): "{gone}.toml",
    ("info", "--vehicle"): "{log} --vehicle {gone}",
    ("decode", "--vehicle"): "{log} -o {out} --vehicle {gone}",
    ("detect", "--vehicle"): "{log} -o {out} --vehicle {gone}",
    ("detect", "--detectors"): "{log} -o {out} --detectors {gone}.toml",
    ("replay", "--vehicle"): "{log} -o {out} --vehicle {gone}",
    ("replay", "--detectors"): "{log} -o {out} --vehicle {car} --detectors {gone}.toml",
    ("estimate", "--vehicle"): "{run} --vehicle {gone}",
    ("score", "--gate"): "{run} --truth {truth} --gate {gone}",
    ("fit compass", "--vehicle"): "{log} --vehicle {gone}",
    ("truth from-gnss", "--vehicle"): "{log} -o {out} --vehicle {gone}",
    ("truth from-map", "--vehicle"): "{log} {streets} -o {out} --vehicle {gone}",
    ("fit odometry", "--vehicle"): "{log} --vehicle {gone}",
    ("fit landmarks", "--vehicle"): "--pairs {gone} --vehicle {gone}",
    ("landmarks add", "--vehicle"): "{out}.db {log} --poses {truth} --vehicle {gone}",
    ("landmarks match", "--vehicle"): "{db} {picture} --vehicle {gone}",
    ("truth import", "--vehicle"): "{coco} --log {log} -o {out}.json --vehicle {gone}",
    ("model init", "--class-names"): "{onnx} -o {there}/new.toml --class-names {gone}",
    ("check", "--vehicle"): "{log} --vehicle {gone}",
    ("check", "--spec"): "{log} --spec {gone}",
    ("model fetch", "--from"): "yolox-nano --from {gone}",
    ("study intersections", "--vehicle"): "-o {out} --vehicle {gone}",
    ("train road", "--init"): "--data {masks} -o {out}.safetensors --init {gone}",
    ("train road", "--measure"): "--data {masks} --measure {gone}",
    (
        "train mask-rcnn",
        "--init",
    ): "--data {coco} --images {pictures} -o {out}.safetensors --init {gone}",
    ("train mask-rcnn", "--measure"): "--data {coco} --images {pictures} --measure {gone}",
}
CASES: Final = {
    **{case: (line, 4) for case, line in INPUT_FILES.items()},
    **{case: (line, 2) for case, line in SETTINGS_FILES.items()},
}
# Commands that read the DBC files of a vehicle file.
READS_DBC_FILES: Final[dict[str, str]] = {
    "decode": "{log} -o {out} --vehicle {vehicle}",
    "replay": "{log} -o {out} --vehicle {vehicle} --no-cache",
    "estimate": "{run} --vehicle {vehicle}",
    "info": "{log} --vehicle {vehicle}",
}
# Options whose file is created if it is missing.
WRITTEN: Final = {"--output", "--junit", "--cache", "--page"}
# Arguments that are not files.
NO_FILES: Final = {"LAYOUT", "NAME", "SQL"}
# Commands whose arguments accept any file, or no file.
ANY_BYTES: Final = {"seal", "model fetch", "completion"}
# Arguments whose file is created if it is missing or empty.
CREATED_IF_MISSING: Final = {("landmarks add", "DB")}
# Arguments that accept a folder; an empty folder is another error.
FOLDERS: Final = {
    ("estimate", "--logs"), ("score", "--logs"), ("view", "--logs"), ("report", "--logs"),
    ("score detector", "--logs"), ("fit detector", "--logs"), ("landmarks add", "--images"),
    ("train road", "--data"), ("train mask-rcnn", "--images"), ("train mask-rcnn", "--val-images"),
    ("merge", "RUNS"), ("query", "RUNS"), ("status", "RUNS"), ("history", "RUNS"),
    ("failures", "RUN"), ("browse", "RUN"), ("browse", "--logs"), ("export", "--logs"),
    ("truth import", "--export"), ("truth import", "ANNOTATIONS"),
}  # fmt: skip
DAMAGE: Final[dict[str, Callable[[Path], object]]] = {
    "missing": lambda path: None,
    "empty": lambda path: path.write_bytes(b""),
    "noise": lambda path: path.write_bytes(bytes(range(256)) * 8),
    "a folder": lambda path: path.mkdir(),
    "text": lambda path: path.write_text("nothing of the kind\n"),
    "nested": lambda path: path.write_text(f"a = {'[' * 3000}{']' * 3000}\n"),
}
# A log of the car, one without pictures and one without messages.
LOGS: Final = ("log", "bus_log", "empty_log")


def _named_files() -> set[tuple[str, str]]:
    """Return all arguments, and options whose value is an input path or a network."""
    found = set()
    for name in cli.COMMANDS:
        _, parser = cli.parser_of(name)
        for action in parser._actions:
            if action.option_strings and (action.type is Path or action.metavar == "NETWORK"):
                found.add((name, action.option_strings[-1]))
            elif not action.option_strings and name not in ANY_BYTES:
                found.add((name, str(action.metavar)))
    return {(name, option) for name, option in found if option not in {*WRITTEN, *NO_FILES}}


def test_table_contains_every_file_argument_and_option() -> None:
    detectors = {("detect", "--detectors"), ("replay", "--detectors")}
    assert CASES.keys() - detectors == _named_files()


@pytest.fixture(scope="module")
def names(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Valid inputs of every kind."""
    folder = tmp_path_factory.mktemp("inputs")
    drive, photos = folder / "drive", folder / "photos"
    log = write_drive(drive, Clock(), seconds=4)
    run = replayed(drive, log, "../run")
    (folder / "empty.mcap").write_bytes(McapFile([]).coded())
    with LandmarkWriter(folder / "known.db", "orb"):
        pass
    for place in ("images", "masks"):
        (photos / place).mkdir(parents=True)
        for number in range(2):
            (photos / place / f"{number}.png").write_bytes(picture(number, width=64, height=48))
    (photos / "coco.json").write_text(stop_signs([("0.png", 0), ("1.png", 1)], (64, 48)))
    (photos / "labels.csv").write_text("picture,label,x0,y0,x1,y1\nimages/0.png,stop,1,1,9,9\n")
    (photos / "places.csv").write_text("image,x_m,y_m,sd_m\n0.png,0,0,1\n")
    (photos / "pairs_m.csv").write_text(
        "height_px,range_m\n" + "".join(f"{200 / m},{m}\n" for m in range(5, 60))
    )
    (photos / "net.onnx").write_bytes(bright_box_model())
    assert cli.run(["model", "init", str(photos / "net.onnx"), "-q"]) == 0
    return {
        "log": log,
        "bus_log": write_drive(folder / "bus", Clock(), seconds=4, topics=[BUS]),
        "empty_log": folder / "empty.mcap",
        "run": run.path,
        "car": drive / "car.toml",
        "truth": drive / "truth.json",
        "db": folder / "known.db",
        "pictures": photos / "images",
        "picture": photos / "images" / "0.png",
        "masks": photos,
        "coco": photos / "coco.json",
        "labels": photos / "labels.csv",
        "places": photos / "places.csv",
        "pairs_m": photos / "pairs_m.csv",
        "onnx": photos / "net.onnx",
        "card": photos / "net.toml",
        "there": photos,
        "streets": write_crossing(photos / "streets.osm"),
        "failures": table_of_failures(run.path, photos / "failures.parquet", BEGIN),
    }


@pytest.mark.parametrize("damage", DAMAGE)
@pytest.mark.parametrize("case", CASES, ids=" ".join)
def test_unusable_input_file_is_refused_in_one_line(
    case: tuple[str, str],
    damage: str,
    names: dict[str, Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # Otherwise weights that the user has fetched would be used instead of the file.
    monkeypatch.setenv("CROSSCUE_MODELS", str(tmp_path / "models"))
    command, (line, expected) = case[0], CASES[case]
    DAMAGE[damage](tmp_path / ("gone" + line.partition("{gone}")[2].partition(" ")[0]))
    if damage == "a folder" and case in FOLDERS:
        pytest.skip("expects a folder; an empty one is another error")
    if case in CREATED_IF_MISSING and damage in ("missing", "empty"):
        pytest.skip("created if missing")
    if case[1] == "--class-names" and damage in ("text", "nested"):
        pytest.skip("expects text")
    is_option = case[1].startswith("--")
    log = names[LOGS[[*DAMAGE].index(damage) % len(LOGS) if is_option else 0]]
    places = {**names, "log": log, "gone": tmp_path / "gone", "out": tmp_path / "out"}
    argv = line.format(**places).split()

    opened = _assert_refused([*command.split(), *argv], expected, "gone", names, tmp_path)

    assert not is_option or not {str(names[one]) for one in LOGS} & {*opened}


def _assert_refused(
    argv: list[str], expected: int, named: str, names: dict[str, Path], out: Path
) -> list[str]:
    """Check how a command ends, and return the files that it opened."""
    inputs = names["masks"].parent
    before, here = tree(inputs), tree(out)

    with opened_files() as opened:
        error = refusal(expected, *argv)

    assert named in error
    assert "bug" not in error
    assert tree(inputs) == before
    assert {name for name in tree(out) if Path(out / name).is_file()} == here.keys()
    return opened


@pytest.mark.parametrize("damage", DAMAGE)
@pytest.mark.parametrize("command", READS_DBC_FILES)
def test_unusable_dbc_file_of_vehicle_file_is_refused_in_one_line(
    command: str, damage: str, names: dict[str, Path], tmp_path: Path
) -> None:
    DAMAGE[damage](tmp_path / "gone.dbc")
    vehicle = tmp_path / "strange.toml"
    vehicle.write_text(names["car"].read_text().replace("simulated_car.dbc", "gone.dbc"))
    line = READS_DBC_FILES[command]
    argv = line.format(**names, vehicle=vehicle, out=tmp_path / "out").split()

    _assert_refused([command, *argv], 4, "gone.dbc", names, tmp_path)
