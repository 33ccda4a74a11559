"""A picture of a log that cannot be used is a dropped row in every command that looks at it.

It is named with its reason, the other pictures are processed, and the exit status is 3.
"""

import ast
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Final

import cv2
import numpy as np
import pytest

from crosscue.eval import cli
from crosscue.eval.vehicle.mounting import estimate_mounting
from crosscue.replay.columns import Images, Int64s
from crosscue.replay.logs.opening import open_log
from crosscue.replay.losses import losses_heard
from crosscue.replay.vehicle.drafting.camera import Intrinsics
from crosscue.replay.vehicle.drafting.series import Series
from support.coco import stop_signs
from support.commands import json_of
from support.failures import table_of_failures
from support.gap_drive import (
    BEGIN,
    FOCAL_PX,
    ROW,
    SIZE,
    SPEED_MPS,
    Clock,
    png_pictures,
    replayed,
    write_drive,
)
from support.landmark_files import empty_database
from support.pictures import OVERSIZED, SIDE_PX

PRODUCT: Final = ("datasets", "detectors", "eval", "fusion", "localization", "replay")
# Functions that decode or measure an encoded picture.
DECODERS: Final = {"check", "decode", "draw_frame", "grey_of", "size_of"}

# By file that looks at a log's pictures: commands that reach it.
LOOKS_AT_A_LOG: Final[dict[str, dict[str, str]]] = {
    "detectors/runner.py": {
        "detect": "detect {log} -o {out} --vehicle {car} --detectors grey --no-cache",
        "replay": "replay {log} -o {out} --vehicle {car} --detectors grey --no-cache",
    },
    "eval/pipeline/landmarks.py": {
        "replay --landmarks": "replay {log} -o {out} --vehicle {car} --detectors grey --no-cache "
        "--landmarks {db}"
    },
    "eval/fit/log_images.py": {
        "truth import": "truth import {coco} --log {log} -o {out}.json --vehicle {car}",
        "check of truth": "check {labelled} {log} {car}",
    },
    "eval/fit/signs/labels.py": {
        "fit signs": "fit signs {drive} --label stop/sign --threshold 0.5"
    },
    "eval/fit/landmarks/database.py": {
        "landmarks add": "landmarks add {out}.db {log} --poses {truth} --vehicle {car}"
    },
    "eval/vehicle/check.py": {"check": "check {log} {car} -o {out}.html"},
    "eval/recording/camera.py": {"view": "view {run} -o {out}.rrd"},
    "eval/failures/labels.py": {"export": "export {failures} -o {out}"},
    "eval/report/frame_pictures.py": {"browse": "browse {failures} -o {out}"},
}
# Reasons why other files have no command in the table above.
HOW_OTHERS_DO: Final = {
    "datasets/scenes/single_frames.py": "files that the user names",
    "detectors/catalog/cards.py": "files that the user names",
    "detectors/images.py": "the functions themselves",
    "detectors/overlay.py": "for eval/report/frame_pictures.py",
    "detectors/training/samples.py": "files that the user names",
    "eval/fit/landmarks/fit.py": "files that the user names",
    "eval/landmarks.py": "files that the user names",
    "eval/logs/log.py": "a call of the user for one picture, which raises",
    "eval/pipeline/visual.py": "frames with detections, thus decoded before",
    "eval/drives/detector_score.py": "frames with detections, thus decoded before",
    "eval/studies/intersections/figures.py": "frames with detections, thus decoded before",
    "eval/vehicle/picture_pass.py": "a function of its own below, because it needs intrinsics",
    "localization/landmarks/images.py": "for the commands of landmarks",
}


def _uses_decoder(path: Path) -> bool:
    names = {
        node.func.id
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)
    }
    text = path.read_text(encoding="utf-8")
    is_of_pictures = "images import" in text or "overlay import" in text
    return bool(names & DECODERS) and is_of_pictures


def test_every_file_that_looks_at_pictures_is_classified() -> None:
    root = Path(__file__).parents[2]
    found = {
        path.relative_to(root).as_posix()
        for part in PRODUCT
        for path in (root / part).rglob("*.py")
        if _uses_decoder(path)
    }

    assert found | {"detectors/images.py"} == LOOKS_AT_A_LOG.keys() | HOW_OTHERS_DO.keys()


def _valid(number: int) -> bytes:
    """A picture with enough corners for a landmark."""
    noise = np.random.default_rng(number).integers(0, 256, (*SIZE[::-1], 3), np.uint8)
    large = cv2.resize(noise[::4, ::4], SIZE, interpolation=cv2.INTER_NEAREST)
    return cv2.imencode(".png", large)[1].tobytes()


# Contents of an unusable picture and words of its reason.
LOST: Final[dict[str, tuple[Callable[[], bytes], str]]] = {
    "oversized": (OVERSIZED["png"], f"{SIDE_PX} x {SIDE_PX}"),
    "truncated": (lambda: _valid(0)[:-100], "cut short"),
}
# Frames with such a picture.
AT: Final = (0, 12)


@pytest.fixture(scope="module", params=LOST)
def names(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> dict[str, Path | str]:
    """A drive with unusable pictures, its run, and other inputs of commands."""
    content, reason = LOST[request.param]
    folder = tmp_path_factory.mktemp(request.param)
    drive = folder / "drive"

    def pictures(numbers: Int64s) -> Images:
        return png_pictures([content() if n in AT else _valid(n) for n in numbers.tolist()])

    log = write_drive(drive, Clock(), seconds=4, pictures=pictures)
    (drive / "vehicle.toml").write_bytes((drive / "car.toml").read_bytes())
    run = replayed(drive, log, "../run")
    labels = [(f"{t}.png", t) for t in (BEGIN + number * ROW for number in range(40))]
    (drive / "objects.json").write_text(stop_signs(labels, SIZE))
    labelled = folder / "labelled"
    shutil.copytree(drive, labelled, ignore=shutil.ignore_patterns("*.mcap"))
    tree = json.loads((labelled / "truth.json").read_text())
    (labelled / "truth.json").write_text(json.dumps({**tree, "objects": "objects.json"}))
    times = [BEGIN + number * ROW for number in (*AT, 20)]
    database = empty_database(folder / "known.db")
    added = ["landmarks", "add", database, log, "--poses", drive / "truth.json", "--every", "1"]
    assert cli.run([*map(str, added), "--vehicle", str(drive / "car.toml")]) == 3
    return {
        "drive": drive,
        "log": log,
        "run": run.path,
        "car": drive / "car.toml",
        "truth": drive / "truth.json",
        "coco": drive / "objects.json",
        "labelled": labelled,
        "db": database,
        "failures": table_of_failures(run.path, folder / "failures.parquet", *times),
        "reason": reason,
    }


@pytest.mark.parametrize(
    "line",
    [line for commands in LOOKS_AT_A_LOG.values() for line in commands.values()],
    ids=[name for commands in LOOKS_AT_A_LOG.values() for name in commands],
)
def test_unusable_picture_of_log_is_dropped_row(
    line: str, names: dict[str, Path | str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    argv = [part.format(**names, out=tmp_path / "out") for part in line.split()]

    status = cli.run([one.replace("stop/sign", "stop sign") for one in argv])

    printed = capsys.readouterr()
    output = " ".join((printed.out + printed.err).split())
    assert status == 3, output
    assert "camera: picture not decoded" in output
    assert str(names["reason"]) in output


def test_picture_that_two_stages_drop_is_counted_once(
    names: dict[str, Path | str], tmp_path: Path
) -> None:
    line = LOOKS_AT_A_LOG["eval/pipeline/landmarks.py"]["replay --landmarks"]

    account = json_of(*line.format(**names, out=tmp_path / "out").split(), status=3)["account"]
    (log,) = account["reading"]
    camera = log["topics"]["camera"]
    assert (camera["in"], camera["used"], camera["dropped"]) == (40, 38, {"picture not decoded": 2})


def test_mounting_is_estimated_from_other_pictures(names: dict[str, Path | str]) -> None:
    t_ns = BEGIN + np.arange(40) * ROW
    intrinsics = Intrinsics(FOCAL_PX, (80.0, 45.0), "made up", SIZE)
    with open_log(Path(names["log"])) as log, losses_heard() as losses:
        estimate = estimate_mounting(
            log, "camera", intrinsics, Series("", t_ns, np.full(40, SPEED_MPS))
        )

    assert any("of a straight road" in one for one in estimate.why_not)
    assert len(losses) == len(AT)
    assert all(str(names["reason"]) in loss for loss in losses)
