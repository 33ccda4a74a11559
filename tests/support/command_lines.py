"""A valid command line of each command that reads a file, and its inputs."""

from pathlib import Path
from typing import Final

from crosscue.eval import cli
from support.coco import stop_signs
from support.failures import table_of_failures
from support.gap_drive import BEGIN, BUS, ROW, SIZE, Clock, replayed, write_drive
from support.landmark_files import empty_database
from support.mcap_files import McapFile
from support.onnx_models import bright_box_model
from support.pictures import picture
from support.street_map import write_crossing

# Arguments come first, in their order; names in braces are places of inputs, and ``out`` is new.
VALID: Final[dict[str, str]] = {
    "info": "{log}",
    "convert": "{log} -o {out}.mcap",
    "decode": "{log} -o {out}",
    "detect": "{log} -o {out} --detectors signs",
    "replay": "{log} -o {out} --vehicle {car}",
    "vehicle init": "{log} -o {out}.toml",
    "check": "{log}",
    "fit compass": "{log} --vehicle {car}",
    "fit odometry": "{log} --vehicle {car}",
    "fit detector": "{run} --labels {coco}",
    "fit landmarks": "--pairs {labels}",
    "fit messages": "{run} --truth {truth} -o {out}.toml",
    "fit temporal": "{run} --truth {truth} -o {out}.toml",
    "fit signs": "{labels} --label stop",
    "fit ranges": "{pairs_m} --cue stop_sign",
    "landmarks add": "{out}.db {log} --poses {truth} --vehicle {car}",
    "landmarks list": "{db}",
    "landmarks match": "{db} {picture}",
    "truth": "{log} -o {out}",
    "truth from-gnss": "{log} -o {out}",
    "truth from-map": "{log} {streets} -o {out}",
    "truth import": "{coco} --log {log} -o {out}.json",
    "estimate": "{run}",
    "score": "{run} --truth {truth}",
    "score detector": "{run} --labels {coco}",
    "view": "{run} -o {out}.rrd",
    "report": "{run} -o {out}.html",
    "compare": "{run} {run}",
    "merge": "{run} -o {out}",
    "query": "{run} --schema",
    "tag": "{run} weather=rain",
    "status": "{run}",
    "history": "{run}",
    "failures": "{run}",
    "browse": "{run} -o {out}",
    "export": "{failures} -o {out}",
    "model init": "{onnx} -o {there}/new.toml",
    "model fetch": "yolox-nano",
    "fetch": "pandaset_002 -o {out}",
    "demo": "--real -o {out}",
    "train road": "--data {masks} -o {out}.safetensors",
    "train mask-rcnn": "--data {coco} --images {pictures} -o {out}.safetensors",
    "study intersections": "-o {out}",
}
# A log of the car, one without pictures and one without messages.
LOGS: Final = ("log", "bus_log", "empty_log")


def valid_inputs(folder: Path) -> dict[str, Path]:
    """Valid inputs of every kind."""
    drive, photos = folder / "drive", folder / "photos"
    log = write_drive(drive, Clock(), seconds=4)
    run = replayed(drive, log, "../run")
    (folder / "empty.mcap").write_bytes(McapFile([]).coded())
    for place in ("images", "masks"):
        (photos / place).mkdir(parents=True)
        for number in range(2):
            (photos / place / f"{number}.png").write_bytes(
                picture(number, width=SIZE[0], height=SIZE[1])
            )
    (photos / "coco.json").write_text(stop_signs([("0.png", BEGIN), ("1.png", BEGIN + ROW)], SIZE))
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
        "db": empty_database(folder / "known.db"),
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
