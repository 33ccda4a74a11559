"""Lights and stop signs of real pictures; far lights placed by their bearings."""

import csv
import json
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from runpy import run_path
from typing import cast

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from scipy.spatial.transform import Rotation

from crosscue.detectors.base import Detections, Detector, DetectorChoice, Frame
from crosscue.detectors.catalog import entries
from crosscue.detectors.registry import make
from crosscue.detectors.signs.second_look import OTHER_SIGNS, with_looks
from crosscue.eval.cli import run
from crosscue.eval.runs.folder import RunFolder, open_run
from crosscue.eval.runs.manifest import EstimateManifest
from crosscue.eval.runs.tables.stored_frames import stored_frames
from support.data import fetch_networks, shared
from support.pictures import picture_log

CAR = 'version = 1\n[cars]\nlabels = ["car", "truck", "bus"]\n'
SIGN = ("stop sign",)


@pytest.fixture(scope="module")
def network(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Detector]:
    with pytest.MonkeyPatch.context() as patch:
        fetch_networks(patch, tmp_path_factory.mktemp("models"), "yolox-nano")
        yield make(DetectorChoice("yolox-nano", "yolox-nano"))


def replayed(folder: Path, pictures: list[Path], rate_hz: float) -> RunFolder:
    """A run over pictures alone."""
    picture_log(folder / "front", pictures, rate_hz)
    (folder / "car.toml").write_text(CAR)
    argv = ["replay", str(folder / "front"), "--vehicle", str(folder / "car.toml"), "--no-cache"]
    assert run([*argv, "-o", str(folder / "run"), "--detectors", "yolox-nano"]) == 0
    return open_run(folder / "run")


def positive(drive: RunFolder, cue: str) -> int:
    rows = drive.table("cues", ["cue", "count"]).to_pylist()
    return sum(row["cue"] == cue and row["count"] > 0 for row in rows)


@pytest.mark.slow
@pytest.mark.usefixtures("network")
def test_dark_lights_of_a_queue_are_found_though_one_box_of_78_frames_is_sure(
    tmp_path: Path,
) -> None:
    pictures = sorted(shared("sequences", "kitti_red_light_queue").glob("*.jpg"))

    drive = replayed(tmp_path, pictures, 10.0)

    rows = drive.table("detections", ["label", "score"]).to_pylist()
    assert sum(row["label"] == "traffic light" and row["score"] > 0.5 for row in rows) == 1
    assert positive(drive, "traffic_light") >= 30
    assert positive(drive, "stop_sign") == 0
    manifest = drive.drive_manifest()
    assert isinstance(manifest, EstimateManifest)
    assert manifest.detect is not None
    (found,) = next(stored_frames(drive, manifest.detect, manifest.settings)).objects
    assert found.log_ratios == {
        "traffic light": entries.entry("yolox-nano").scores["traffic light"].log_ratio
    }


@pytest.mark.slow
@pytest.mark.usefixtures("network")
def test_road_without_lights_and_signs_has_none(tmp_path: Path) -> None:
    pictures = sorted(shared("sequences", "kitti_t_junction", "image_0").glob("*.jpg"))[::2]

    drive = replayed(tmp_path, pictures, 4.82)

    assert positive(drive, "traffic_light") == positive(drive, "stop_sign") == 0


def looked_at(network: Detector, path: Path) -> Detections:
    """The stop signs of one picture, from the threshold of its cue on, with the second look."""
    pixels = np.asarray(cv2.imread(str(path)), np.uint8)
    frame = Frame(0, "front", pixels, (pixels.shape[1], pixels.shape[0]))
    (found,) = network([frame])
    assert isinstance(found, Detections)
    signs = found.of("stop sign")
    return with_looks(signs.taken(signs.scores >= 0.5), frame, SIGN)


@pytest.mark.slow
def test_second_look_keeps_every_stop_sign_of_photographs_and_rejects_no_entry(
    network: Detector,
) -> None:
    folder = shared("signs", "stop_vs_nostop_us_streets")
    with (folder / "labels.tsv").open() as file:
        labelled = {row[0].split()[0] for row in csv.reader(file, delimiter="\t") if row}
    streets = [one for one in folder.iterdir() if one.name in labelled]
    lisa = sorted(shared("images", "lisa_stop_sign_frames").glob("stop_*.png"))
    no_entry = sorted(shared("signs", "no_entry", "images").glob("*.png"))

    signs, others = (
        Counter(look for path in paths for look in looked_at(network, path).looks)
        for paths in (streets + lisa, no_entry)
    )

    # The only other sign among the first is the back of one, which the network calls a stop sign.
    assert signs["pale"] == sum(signs[look] for look in OTHER_SIGNS) == 1
    assert signs["stop"] >= 30
    assert others["bar"] >= 5
    assert others["stop"] == 0


BENCHMARK = Path(__file__).parents[3] / "benchmarks" / "far_lights.py"
FOCAL_PX, CENTER_PX = 1900.0, (960.0, 540.0)
LIGHT_M = np.array([70.0, 4.0, 5.0])
AHEAD_M, BIAS_M = 1.8, 2.0


def written(folder: Path) -> tuple[Path, Path]:
    """A drive of 40 m, straight towards a light, with poses each metre; the run has every frame."""
    camera, run = folder / "drive/camera/front_camera", folder / "run"
    camera.mkdir(parents=True)
    run.mkdir()
    # Camera axes (right, down, ahead) in a world with x ahead and y to the left.
    axes = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    heading = dict(zip("xyzw", Rotation.from_matrix(axes).as_quat().tolist(), strict=True))
    at_m = np.array([[float(i), 0.0, 1.6] for i in range(40)])
    poses = [
        {"position": dict(zip("xyz", one.tolist(), strict=True)), "heading": heading}
        for one in at_m
    ]
    (camera / "poses.json").write_text(json.dumps(poses))
    lens = {"fx": FOCAL_PX, "fy": FOCAL_PX, "cx": CENTER_PX[0], "cy": CENTER_PX[1]}
    (camera / "intrinsics.json").write_text(json.dumps(lens))
    t_ns = [1_000_000_000 + 100_000_000 * i for i in range(40)]
    # A run with odometry lists its frames in another order than that of their times.
    pq.write_table(pa.table({"t_ns": t_ns[::-1]}), run / "frames.parquet")
    rows = []
    for i in range(40):
        x, y, z = (LIGHT_M - at_m[i]) @ axes
        u, v = CENTER_PX[0] + FOCAL_PX * x / z, CENTER_PX[1] + FOCAL_PX * y / z
        for number, facing in ((3, "toward"), (8, "away")):
            rows.append(
                {
                    "t_ns": t_ns[i], "object": number, "facing": facing, "x0": u - 4, "x1": u + 4,
                    "y0": v - 9, "y1": v + 9, "reference": "end" if number == 3 else "start",
                    "range_m": float(z) + AHEAD_M + BIAS_M,
                }
            )  # fmt: skip
    pq.write_table(pa.Table.from_pylist(rows), run / "ranged_objects.parquet")
    return folder / "drive", run


def test_far_light_is_placed_and_the_range_compared(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    sequence, run = written(tmp_path)
    main = cast("Callable[[], None]", run_path(str(BENCHMARK))["main"])
    monkeypatch.setattr(sys, "argv", ["far_lights.py", str(sequence), str(run)])

    main()

    head, *lights = capsys.readouterr().out.splitlines()
    assert head == "40 ranges to the end, from 1.8 m behind the camera"
    (line,) = lights
    assert line.startswith("light 3: 70.0 +- ")
    assert f"bias {BIAS_M:+.1f} m, worst {100.0 * BIAS_M / (31.0 + AHEAD_M):.1f} %" in line
