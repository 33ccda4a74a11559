"""Valid empty inputs of every kind, and commands that require more than that."""

import json
from pathlib import Path

from crosscue.datasets.truth.truth import Truth, save
from support.failures import table_of_failures
from support.gap_drive import BEGIN, SECOND, Clock, replayed, write_drive
from support.pictures import picture, picture_folder
from support.rosbag_files import Row, write_folder
from support.street_map import write_crossing

# Commands without a result for such input, and their arguments.
COMMANDS: dict[str, str] = {
    "truth": "{log} -o {out}",
    "truth import": "{empty}/coco.json --log {log} -o {out}.json --vehicle {car}",
    "fit compass": "{log} --vehicle {car}",
    "truth from-gnss": "{log} -o {out} --vehicle {car}",
    "truth from-map": "{log} {empty}/streets.osm -o {out} --vehicle {car}",
    "fit odometry": "{log} --vehicle {car}",
    "fit signs": "{empty}/labels.csv --label stop",
    "fit temporal": "{run} --truth {empty}/truth.json -o {out}.toml",
    "fit messages": "{run} --truth {empty}/truth.json -o {out}.toml",
    "fit ranges": "--cue stop_sign --truth {empty}/truth.json",
    "fit landmarks": "--pairs {empty}/pairs.csv",
    "score": "{run} --truth {empty}/truth.json -o {out}",
    "score detector": "{run} --labels {empty}/coco.json",
    "fit detector": "{run} --labels {empty}/coco.json -o {out}.toml",
    "train mask-rcnn": "--data {empty}/coco.json --images {empty} -o {out}.safetensors",
    "train road": "--data {empty} -o {out}.safetensors",
    "landmarks add": "{out}.db --images {empty} --coordinates {empty}/places.csv",
    "vehicle init": "{strange} -o {out}.toml",
    "check": "{strange} {bare} -o {out}.html",
    "merge": "{empty} -o {out}",
    "browse": "{empty}/failures.parquet -o {out}",
    "export": "{empty}/failures.parquet -o {out}",
}


def empty_inputs(folder: Path) -> dict[str, Path]:
    """Write a drive, its run, and valid empty inputs of every kind."""
    drive, empty = folder / "drive", folder / "empty"
    log = write_drive(drive, Clock(), seconds=4)
    run = replayed(drive, log, "../run")
    for place in (empty / "images", empty / "masks"):
        place.mkdir(parents=True)
    save(Truth(version=1, source="x", start_ns=BEGIN, end_ns=BEGIN + 4 * SECOND), empty)
    coco: dict[str, list[object]] = {"categories": [], "images": [], "annotations": []}
    (empty / "coco.json").write_text(json.dumps(coco))
    (empty / "a.png").write_bytes(picture(1))
    write_crossing(empty / "streets.osm")
    (empty / "labels.csv").write_text("picture,label,x0,y0,x1,y1\na.png,,,,,\n")
    (empty / "pairs.csv").write_text("query,known,same\n")
    (empty / "places.csv").write_text("image,x_m,y_m,sd_m\na.png,0,0,1\n")
    table_of_failures(run.path, empty / "failures.parquet")
    (empty / "bare.toml").write_text("version = 1\n")
    message = Row("/can", BEGIN, b"\0\1\0\0\2\0\0\0a\0")
    return {
        "log": log,
        "run": run.path,
        "car": drive / "car.toml",
        "bare": empty / "bare.toml",
        "empty": empty,
        "other": picture_folder(folder / "front", 3, "rate_hz: 10\n"),
        "strange": write_folder(folder / "strange", [message]),
    }
