"""Declared sizes are limited in every command that opens logs, pictures or networks."""

import re
import shutil
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from crosscue.datasets.simulated.drive import DriveSettings
from crosscue.datasets.simulated.log_files import write_drive as simulated
from crosscue.detectors.images import MAX_PIXELS
from crosscue.eval import cli
from crosscue.replay.limits import MIB
from support.coco import annotate, stop_signs
from support.every_format import EVERY_FORMAT
from support.failures import table_of_failures
from support.gap_drive import BEGIN, SIZE, Clock, replayed, write_drive
from support.landmark_files import empty_database
from support.mcap_files import MAGIC, record, text
from support.onnx_models import bright_box_model, open_model
from support.pictures import OVERSIZED as CODED
from support.pictures import SIDE_PX, picture
from support.refusals import refusal
from support.rosbag_files import START_NS, Row, write_bag, write_folder
from support.street_map import write_crossing

DECLARED = 3 * MIB
LIMIT_MIB = 2

# Arguments with which each command reads every chunk of a log, and its exit status.
OPENS_LOGS: dict[str, tuple[str, int]] = {
    "info": ("{log}", 3),
    "convert": ("{log} -o {out}.mcap", 3),
    "decode": ("{log} -o {out} --vehicle {car}", 3),
    "detect": ("{log} -o {out} --vehicle {car} --detectors grey --no-cache", 3),
    "replay": ("{log} -o {out} --vehicle {car} --detectors grey --no-cache", 3),
    "estimate": ("{run}", 3),
    "score": ("{run} --truth {truth}", 3),
    "score detector": ("{run} --labels {coco}", 3),
    "fit detector": ("{run} --labels {coco}", 1),
    "view": ("{run} -o {out}.rrd", 3),
    "report": ("{run} -o {out}.html", 3),
    "vehicle init": ("{log} -o {out}.toml", 3),
    "check": ("{log} {car} {truth} -o {out}.html", 3),
    "fit compass": ("{compass} --vehicle {its_car}", 4),
    "truth from-gnss": ("{compass} -o {out} --vehicle {gnss_car}", 4),
    "truth from-map": ("{compass} {streets} -o {out} --vehicle {gnss_car}", 4),
    "fit odometry": ("{compass} --vehicle {its_car} --truth {its_truth}", 4),
    "fit signs": ("{drive} --label stop_sign", 1),
    "landmarks add": ("{out}.db {log} --poses {truth} --vehicle {car}", 1),
    "truth import": ("{coco} --log {log} -o {out}.json --vehicle {car}", 3),
    "browse": ("{run} --truth {truth} --any-log -o {out}", 3),
    "export": ("{failures} -o {out}", 3),
}
# Commands that read few pictures or none, and report only the messages that the run dropped.
REPORTS_THE_RUN = {"score", "score detector", "fit detector", "browse", "export", "report"}
OPENS_NO_LOG: dict[str, str] = {
    "compare": "tables", "query": "tables", "tag": "texts", "merge": "tables",
    "status": "the journal", "failures": "tables",
    "fit ranges": "tables", "fit messages": "tables", "fit temporal": "tables",
    "history": "tables",
    "landmarks list": "a database", "landmarks match": "a picture", "train road": "pictures",
    "fit landmarks": "pictures",
    "train mask-rcnn": "pictures", "train frames": "nothing", "truth schema": "nothing",
    "fetch": "nothing",
    "demo": "what it made", "simulate": "nothing", "study range": "what it made",
    "study landmarks": "what it made", "study field": "what it made",
    "model fetch": "a network", "model init": "a network", "model list": "nothing",
    "model show": "a card", "completion": "nothing", "plugins": "nothing",
    "study intersections": "what it made", "study layouts": "what it made",
    "seal": "bytes as they are", "truth": "arrays and texts of data sets, not compressed",
}  # fmt: skip


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A drive whose last chunk is a decompression bomb, its run, and other inputs of commands."""
    folder = tmp_path_factory.mktemp("inputs")
    drive = folder / "drive"
    log = write_drive(drive, Clock(), seconds=4)
    with_bomb(log)
    run = replayed(drive, log, "../run")
    compass = simulated(folder / "compass", DriveSettings(seed=3, blocks=1, block_m=60.0))
    with_bomb(compass.log)
    (drive / "vehicle.toml").write_bytes((drive / "car.toml").read_bytes())
    gnss_car = folder / "gnss.toml"
    gnss_car.write_text('version = 1\n[topics]\ngnss = "/imu"\n')
    objects = drive / "objects.json"
    objects.write_text(stop_signs([("0.png", BEGIN)], SIZE))
    return {
        "drive": drive,
        "log": log,
        "run": run.path,
        "car": drive / "car.toml",
        "truth": drive / "truth.json",
        "coco": objects,
        "db": empty_database(folder / "known.db"),
        "compass": compass.log,
        "its_car": compass.vehicle,
        "gnss_car": gnss_car,
        "streets": write_crossing(folder / "streets.osm"),
        "its_truth": compass.truth,
        "failures": table_of_failures(run.path, folder / "failures.parquet", BEGIN + 10**9),
    }


@pytest.fixture
def names(inputs: dict[str, Path], tmp_path: Path) -> dict[str, Path]:
    """A copy of the inputs."""
    home = inputs["drive"].parent.resolve()
    shutil.copytree(home, tmp_path / "all")
    copied = {
        name: tmp_path / "all" / path.resolve().relative_to(home) for name, path in inputs.items()
    }
    return {**copied, "out": tmp_path / "out"}


def _words(flags: str, names: dict[str, Path]) -> list[str]:
    return [word.replace("_sign", " sign") for word in flags.format(**names).split()]


def with_bomb(log: Path) -> None:
    """Insert a chunk that declares more than the limit at the end of the recording's data."""
    coded, at = log.read_bytes(), len(MAGIC)
    while coded[at] != 0x0F:
        at += 9 + int(struct.unpack_from("<Q", coded, at + 1)[0])
    body = bytes(100)
    head = struct.pack("<QQQI", 1, 1, DECLARED, 0) + text("zstd") + struct.pack("<Q", len(body))
    log.write_bytes(coded[:at] + record(6, head + body))


def test_every_command_is_classified_by_whether_it_opens_logs() -> None:
    assert not OPENS_LOGS.keys() & OPENS_NO_LOG.keys()
    assert OPENS_LOGS.keys() | OPENS_NO_LOG.keys() == cli.COMMANDS.keys()


@pytest.mark.parametrize("command", sorted(OPENS_LOGS))
def test_max_chunk_option_limits_every_command_that_opens_log(
    command: str, names: dict[str, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    flags, expected_status = OPENS_LOGS[command]
    argv = _words(flags, names)

    status = cli.run([*command.split(), *argv, "--max-chunk", str(LIMIT_MIB)])

    output = " ".join("".join(capsys.readouterr()).split())
    assert status == expected_status, output
    if command not in REPORTS_THE_RUN:
        expected = rf"declares \d{{7}} bytes, the limit is {LIMIT_MIB * MIB} \(--max-chunk\)"
        assert re.search(expected, output), output


def _folder(folder: Path, pictures: list[tuple[str, bytes]]) -> Path:
    log = folder / "cam"
    log.mkdir()
    for number, (kind, content) in enumerate(pictures):
        (log / f"frame_{number}.{kind}").write_bytes(content)
    (log / "timestamps.txt").write_text("rate_hz: 10\n")
    return log


def _ros1(kind: str, content: bytes) -> bytes:
    names = b"".join(struct.pack("<I", len(one)) + one for one in (b"cam", kind.encode()))
    return struct.pack("<III", 0, 10, 0) + names + struct.pack("<I", len(content)) + content


def _ros2(kind: str, content: bytes) -> bytes:
    made = struct.pack("<iI", 10, 0)
    for one in (b"cam\0", kind.encode() + b"\0"):
        made += bytes(-len(made) % 4) + struct.pack("<I", len(one)) + one
    made += bytes(-len(made) % 4) + struct.pack("<I", len(content)) + content
    return b"\0\1\0\0" + made


def _rows(pictures: list[tuple[str, bytes]], wrap: Callable[[str, bytes], bytes]) -> list[Row]:
    return [
        Row("/camera/image", START_NS + i * 100_000_000, wrap(*one))
        for i, one in enumerate(pictures)
    ]


HOLDERS: dict[str, Callable[[Path, list[tuple[str, bytes]]], Path]] = {
    "folder": _folder,
    "bag": lambda folder, pictures: write_bag(folder / "cam.bag", _rows(pictures, _ros1), "bz2"),
    "db3": lambda folder, pictures: write_folder(
        folder / "cam", _rows(pictures, _ros2), compression="message"
    ),
    "mcap": lambda folder, pictures: write_folder(folder / "cam", _rows(pictures, _ros2), "mcap"),
}
# Commands that decode a camera's pictures, or at least their headers, and their exit status.
READS_CAMERA: dict[str, tuple[str, int]] = {
    "detect": ("{log} -o {out} --detectors support.gap_drive:build --no-cache", 3),
    "replay": ("{log} -o {out} --detectors support.gap_drive:build --no-cache", 3),
    "truth import": ("{coco} --log {log} -o {out}.json", 3),
    "landmarks add": ("{out}.db {log} --poses {truth}", 1),
    "fit signs": ("{drive} --label stop_sign", 1),
}


@pytest.mark.parametrize("holder", HOLDERS)
@pytest.mark.parametrize("command", READS_CAMERA)
def test_oversized_camera_picture_is_reported_with_size_and_limit(
    command: str, holder: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    drive = tmp_path / "drive"
    drive.mkdir()
    coded = [*CODED][[*HOLDERS].index(holder) % len(CODED)]
    valid = [("png", picture(number)) for number in range(3)]
    log = HOLDERS[holder](drive, [(coded, CODED[coded]()), *valid])
    annotate(drive, 0 if holder == "folder" else START_NS)
    names = {
        "log": log,
        "out": tmp_path / "out",
        "drive": drive,
        "truth": drive / "truth.json",
        "coco": drive / "objects.json",
        "db": empty_database(tmp_path / "known.db"),
    }

    flags, status = READS_CAMERA[command]

    assert cli.run([*command.split(), *_words(flags, names)]) == status
    _assert_reports_size_and_limit(capsys)


def _assert_reports_size_and_limit(capsys: pytest.CaptureFixture[str]) -> None:
    output = " ".join("".join(capsys.readouterr()).split())
    assert f"{SIDE_PX} x {SIDE_PX}" in output
    assert f"{MAX_PIXELS:,}" in output


# Commands that decode picture files.
READS_FILES: dict[str, str] = {
    "landmarks match": "{db} {picture}",
    "landmarks add": "{db} --images {folder} --coordinates {folder}/places.csv",
    "fit landmarks": "--pairs {folder}/pairs.csv",
    "fit signs": "{folder}/labels.csv --label stop_sign",
    "check": "{folder}/net.toml --picture {picture} -o {out}.jpg",
    "model init": "{folder}/net.onnx -o {folder}/new.toml --picture {picture}",
    "train road": "--data {folder} -o {out}.safetensors",
    "train mask-rcnn": "--data {folder}/coco.json --images {folder}/images -o {out}.safetensors "
    "--steps 1 --batch 1 --check-every 1 --device cpu",
}


@pytest.mark.parametrize("coded", CODED)
@pytest.mark.parametrize("command", READS_FILES)
def test_oversized_picture_file_is_refused_with_status_4(
    command: str, coded: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "photos"
    for place in (folder, folder / "images", folder / "masks"):
        place.mkdir()
        (place / f"a.{coded}").write_bytes(CODED[coded]())
        (place / "b.png").write_bytes(picture(1))
    (folder / "places.csv").write_text(f"image,x_m,y_m,sd_m\na.{coded},0,0,1\n")
    (folder / "pairs.csv").write_text(f"query,known,same\na.{coded},b.png,1\n")
    (folder / "labels.csv").write_text(f"picture,label,x0,y0,x1,y1\na.{coded},stop sign,1,1,9,9\n")
    (folder / "coco.json").write_text(stop_signs([(f"a.{coded}", 0), ("b.png", 1)], (24, 16)))
    (folder / "net.onnx").write_bytes(bright_box_model())
    if command == "check":
        assert cli.run(["model", "init", str(folder / "net.onnx"), "-q"]) == 0
    names = {
        "db": empty_database(tmp_path / "known.db"),
        "picture": folder / f"a.{coded}",
        "folder": folder,
        "out": tmp_path / "out",
    }

    assert cli.run([*command.split(), *_words(READS_FILES[command], names)]) == 4
    _assert_reports_size_and_limit(capsys)
    assert not (folder / "new.toml").exists()


# Declared input shape, metadata, and the expected message.
SIZES: dict[str, tuple[tuple[int | str, ...], dict[str, str], str]] = {
    "size from metadata": (
        (1, 3, "h", "w"),
        {"imgsz": "[200000, 200000]"},
        "120,000,000,000 numbers, the limit is 201,326,592",
    ),
    "batch": ((100_000, 3, 640, 640), {}, "122,880,000,000 numbers, the limit is 201,326,592"),
    "side": ((1, 3, 200_000, 200_000), {}, "120,000,000,000 numbers, the limit is 201,326,592"),
}


@pytest.mark.parametrize("case", SIZES)
def test_network_with_oversized_input_is_refused(case: str, tmp_path: Path) -> None:
    shape, metadata, expected = SIZES[case]
    (tmp_path / "net.onnx").write_bytes(open_model(shape, metadata))

    assert expected in refusal(2, "model", "init", tmp_path / "net.onnx")
    assert not list(tmp_path.glob("*.toml"))


@pytest.mark.parametrize("shape", [(1 << 40,), (1 << 31, 1 << 31), (1 << 62, 4)])
def test_array_header_exceeding_file_is_reported(
    shape: tuple[int, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = EVERY_FORMAT["comma2k19"](tmp_path)
    place = log / "processed_log" / "IMU" / "gyro" / "value"
    assert place.is_file()
    with place.open("wb") as file:
        head = {"descr": "<f8", "fortran_order": False, "shape": shape}
        np.lib.format.write_array_header_1_0(file, head)
        file.write(bytes(64))

    status = cli.run(["info", str(log)])

    printed = capsys.readouterr()
    assert status == (4 if len(shape) == 1 else 3), printed.err
    assert ("copy it again" in printed.err) if status == 4 else ("losses" in printed.out)
