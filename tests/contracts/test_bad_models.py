"""Networks with model cards in commands: invalid ones, masks, and all five commands."""

import json
import re
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

import crosscue
from crosscue.datasets.truth.truth import CueTruth, Truth, save
from crosscue.detectors.base import Frame, View
from crosscue.detectors.box_detector import BoxDetector, ScoredBox
from crosscue.detectors.catalog.card import read_card
from crosscue.eval import cli
from crosscue.eval.runs.folder import open_run
from support.decoder_samples import CLASSES, SAMPLES, export
from support.mask_rcnn import network
from support.onnx_models import constant_model, write_card
from support.pandaset_drive import START_S, pandaset_drive
from support.pictures import picture, picture_folder
from support.refusals import refusal

ROWS = np.array([[[4.0, 4.0, 20.0, 20.0, 0.9, 1.0]]], np.float32)
OUTPUT = 'kind = "end-to-end"\nscore = 0.3\nclasses = {}\n'
CAMERA = "version = 1\n[camera]\nfocal_px = 900.0\ncenter_px = [960.0, 540.0]\n"
COUNTED = 'version = 1\n[cues.own.pets]\nlabels = ["dog"]\n'
# Defects of a network for three pictures, and a part of the error line.
BAD = {
    "nan": "net.toml: output: 1 of 1 candidates are not finite numbers; correct the card",
    "other-shape": "net.toml: output: expected (1, N, 6)",
    "other-classes": "class numbers 1 to 1, but 1 classes are listed; correct the card",
    "no-classes": "net.toml: output.classes is empty; list the network's classes",
    "other-size": "the network does not run on input 40 x 32",
    "empty-card": "net.toml:1: version, weights, sha256, input, output: missing; add them",
    "other-weights": "; fetch the weights again, or write a card for this file",
    "no-weights": "net.onnx: No such file",
    "other-camera": "outside the images of 24 x 16 pixels",
    "not-counted": "net: no cue counts any of its 2 labels (cat, dog); state what its classes mean",
}


class Everything(BoxDetector):
    """A detector with a custom label whose box covers the whole picture; named as text below."""

    name, labels, view = "everything", ("whatever",), View(is_grey=True)

    def boxes_in(self, frame: Frame) -> Iterator[ScoredBox]:
        """Yield one box."""
        yield "whatever", 1.0, (0, 0, frame.pixels.shape[1], frame.pixels.shape[0])


def write_invalid_model(folder: Path, bad: str) -> None:
    """Write ``net.toml`` with its network, and ``car.toml``."""
    rows = {"nan": np.full_like(ROWS, np.nan), "other-shape": ROWS[:, :, :5]}.get(bad, ROWS)
    classes = {"other-classes": ["dog"], "no-classes": []}.get(bad, ["dog", "cat"])
    model = constant_model((1, 3, 32, 64), {"rows": rows})
    size = (40 if bad == "other-size" else 64, 32)
    card = write_card(folder, model, OUTPUT.format(json.dumps(classes)), size)
    if bad == "empty-card":
        card.write_text("")
    if bad == "other-weights":
        (folder / "net.onnx").write_bytes(model + b" ")
    if bad == "no-weights":
        (folder / "net.onnx").unlink()
    cars = {
        "other-camera": COUNTED + CAMERA.removeprefix("version = 1\n"),
        "not-counted": "version = 1\n",
    }
    (folder / "car.toml").write_text(cars.get(bad, COUNTED))


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three pictures."""
    return picture_folder(tmp_path_factory.mktemp("log") / "front", 3, "rate_hz: 10\n")


@pytest.mark.parametrize("command", ["replay", "detect"])
@pytest.mark.parametrize("bad", BAD)
def test_invalid_network_is_refused_in_one_line(
    log: Path, tmp_path: Path, bad: str, command: str
) -> None:
    write_invalid_model(tmp_path, bad)
    out, net, car = tmp_path / "out", tmp_path / "net.toml", tmp_path / "car.toml"
    argv = [command, log, "--detectors", net, "--vehicle", car, "--no-cache", "-o", out]

    assert BAD[bad] in refusal(2, *argv)
    assert not out.exists()


def test_python_detector_with_uncounted_label_runs_with_notice(log: Path, tmp_path: Path) -> None:
    detectors, vehicle = [f"{__name__}:Everything.build"], crosscue.Vehicle(version=1)

    run = crosscue.replay_drive(log, tmp_path / "out", vehicle, detectors)

    assert set(run.detections["label"].to_pylist()) == {"whatever"}
    assert "no cue counts its labels (whatever)" in str(run)
    assert '[cues.own.NAME] labels = ["whatever"]' in str(run)


def test_model_init_writes_no_card_for_network_with_nan_output(tmp_path: Path) -> None:
    (tmp_path / "names.txt").write_text("dog\ncat\n")
    net = tmp_path / "net.onnx"
    net.write_bytes(constant_model((1, 3, 32, 64), {"rows": np.full_like(ROWS, np.nan)}))
    before = sorted(tmp_path.iterdir())

    argv = ["model", "init", net, "--class-names", tmp_path / "names.txt", "--kind", "end-to-end"]
    assert "net.toml: not written, the network does not run with it: output: 1 of 1" in refusal(
        2, *argv
    )
    assert sorted(tmp_path.iterdir()) == before


def test_labels_of_other_pictures_are_refused_without_scores(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_invalid_model(tmp_path, "nothing")
    out, car = tmp_path / "out", tmp_path / "car.toml"
    argv = ["detect", log, "--detectors", tmp_path / "net.toml", "--vehicle", car, "--no-cache"]
    assert cli.run([*map(str, argv), "-o", str(out)]) == 0
    capsys.readouterr()

    box = {"id": 1, "image_id": 1, "category_id": 1, "bbox": [1, 1, 9, 9]}
    picture = {"id": 1, "file_name": "elsewhere.png", "width": 24, "height": 16}
    coco = {"categories": [{"id": 1, "name": "dog"}], "images": [picture], "annotations": [box]}
    labels = tmp_path / "coco.json"
    labels.write_text(json.dumps(coco))
    for command in ("score detector", "fit detector"):
        argv = [*command.split(), out, "--labels", labels]
        assert "none of its 1 images is in" in refusal(1, *argv)
    assert not (out / "score").exists()
    shutil.rmtree(out)


# Size of the network's input; pictures of 24 x 16 pixels are stretched to it.
WIDTH, HEIGHT = 64, 32
# Box of one car: four times as long as high in the input, and three times in the picture.
BOX = np.array([8.0, 12.0, 56.0, 24.0])
VEHICLE = """version = 1
[cars]
kind = "pairs"
[regions]
kind = "picture"
left = [[0.0, 0.0], [0.25, 0.0], [0.25, 1.0], [0.0, 1.0]]
straight = [[0.25, 0.0], [0.75, 0.0], [0.75, 1.0], [0.25, 1.0]]
right = [[0.75, 0.0], [1.0, 0.0], [1.0, 1.0], [0.75, 1.0]]
"""


def prototypes(nose: str) -> NDArray[np.float32]:
    """32 masks at a quarter of the input's size; the first is a car with its nose at ``nose``."""
    masks = np.full((1, 32, HEIGHT // 4, WIDTH // 4), -9.0, np.float32)
    masks[0, 0, 3:6, 2:14] = 9.0
    masks[0, 0, 3:5, 9:14] = -9.0
    if nose == "left":
        masks[0, 0, :, 2:14] = masks[0, 0, :, 13:1:-1].copy()
    return masks


def seg(nose: str) -> tuple[str, dict[str, NDArray[np.generic]]]:
    """Outputs of an Ultralytics ``-seg`` network."""
    columns = np.zeros((1, 4 + 1 + 32, 50), np.float32)
    x0, y0, x1, y1 = BOX
    columns[0, :6, 30] = [(x0 + x1) / 2, (y0 + y1) / 2, x1 - x0, y1 - y0, 0.99, 1.0]
    output = 'kind = "yolov8-seg"\nname = "output0"\nprototypes = "output1"\n'
    return output, {"output0": columns, "output1": prototypes(nose)}


def end_to_end(nose: str) -> tuple[str, dict[str, NDArray[np.generic]]]:
    """Outputs of a network with built-in suppression."""
    rows = np.zeros((1, 5, 6 + 32), np.float32)
    rows[0, 0, :7] = [*BOX, 0.99, 0.0, 1.0]
    output = 'kind = "end-to-end"\nname = "output0"\nprototypes = "output1"\n'
    return output, {"output0": rows, "output1": prototypes(nose)}


def torchvision(nose: str) -> tuple[str, dict[str, NDArray[np.generic]]]:
    """Outputs of a Mask R-CNN of torchvision, whose masks cover the whole input."""
    mask = (prototypes(nose)[0, :1] > 0).repeat(4, axis=1).repeat(4, axis=2).astype(np.float32)
    return 'kind = "torchvision"\nmasks = "masks"\n', {
        "boxes": BOX[None].astype(np.float32),
        "labels": np.ones(1, np.int64),
        "scores": np.full(1, 0.99, np.float32),
        "masks": mask[None],
    }


LAYOUTS = {"yolov8-seg": seg, "end-to-end": end_to_end, "torchvision": torchvision}


def replay_constant_network(
    folder: Path, output: str, classes: list[str], outputs: Mapping[str, NDArray[np.generic]]
) -> Path:
    """Replay three pictures with a network that returns the same outputs for each."""
    model = constant_model((1, 3, HEIGHT, WIDTH), outputs)
    output += f"classes = {json.dumps(classes)}"
    write_card(folder, model, output, (WIDTH, HEIGHT), 'fit = "stretch"')
    (folder / "car.toml").write_text(VEHICLE)
    log, out = picture_folder(folder / "front", 3, "rate_hz: 10\n"), folder / "out"
    argv = ["replay", log, "--detectors", folder / "net.toml", "--vehicle", folder / "car.toml"]
    assert cli.run([*map(str, argv), "--no-cache", "-q", "-o", str(out)]) == 0
    return out


def positive(out: Path) -> dict[str, int]:
    """Return the number of positive frames of each cue."""
    counts: dict[str, int] = {}
    for row in open_run(out).table("cues").to_pylist():
        counts[row["cue"]] = counts.get(row["cue"], 0) + (row["count"] > 0)
    return counts


@pytest.mark.parametrize("nose", ["left", "right"])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_mask_shows_orientation_of_parked_car(tmp_path: Path, layout: str, nose: str) -> None:
    output, outputs = LAYOUTS[layout](nose)

    out = replay_constant_network(tmp_path, output, ["car"], outputs)

    found = positive(out)
    other = "right" if nose == "left" else "left"
    assert (found[f"parked_{nose}"], found[f"parked_{other}"]) == (2, 0)
    detected = open_run(out).drive_manifest().detected
    assert detected is not None
    (detector,) = detected.detectors
    assert (detector.with_mask, detector.boxes_only) == (("car",), ())


def test_road_segmentation_card_yields_road_cue_on_its_side_only(tmp_path: Path) -> None:
    """The network reports road in the left quarter of the picture."""
    scores = np.zeros((1, 2, HEIGHT // 4, WIDTH // 4), np.float32)
    scores[0, 1, :, : WIDTH // 16] = 1.0
    scores[0, 0] = 0.5

    output = 'kind = "segmentation"\nroad = ["road"]\n'
    out = replay_constant_network(tmp_path, output, ["other", "road"], {"map": scores})

    (row, *_) = open_run(out).table("road").to_pylist()
    assert [row[f"fraction_{side}"] for side in ("left", "straight", "right")] == [1.0, 0.0, 0.0]
    found = positive(out)
    assert [found[f"road_{side}"] for side in ("left", "straight", "right")] == [3, 0, 0]


PAGE = Path(__file__).parents[2] / "docs" / "howto" / "networks.md"
# Folder in which the page expects the vehicle file and the truth of its drive.
HOME = Path("datasets") / "real" / "pandaset_002"
FRAMES = 3


def commands() -> list[str]:
    """Return the commands of the page's first block; ``view`` writes a recording instead."""
    page = PAGE.read_text(encoding="utf-8")
    block = re.search(r"```bash\n(crosscue model init.*?)```", page, re.S)
    assert block is not None
    return block[1].replace("view run", "view run -o drive.rrd").splitlines()


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with all inputs of the page except the network; pictures have 24 x 16 pixels."""
    place = tmp_path_factory.mktemp("place")
    camera = pandaset_drive(place / "PANDASET", FRAMES) / "camera" / "front_camera"
    (camera / "intrinsics.json").write_text('{"fx": 20.0, "fy": 20.0, "cx": 12.0, "cy": 8.0}')
    (place / "street.jpg").write_bytes(picture(0, ".jpg"))
    (place / "names.txt").write_text("\n".join(CLASSES))
    (place / HOME).mkdir(parents=True)
    (place / HOME / "vehicle.toml").write_text('version = 1\n[cues]\nkind = "frames"\n')
    start_ns, end_ns = round(1e9 * (START_S - 1.0)), round(1e9 * (START_S + 1.0))
    cue = CueTruth(cue="stop_sign", present=True, start_ns=start_ns, end_ns=end_ns)
    save(Truth(version=1, start_ns=start_ns, end_ns=end_ns, cues=(cue,)), place / HOME)
    return place


def follow_page(
    place: Path,
    weights: str,
    kind: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> tuple[int, int, int]:
    """Run the page's commands; return right and all positives and frames of the stop sign cue.

    The recording of ``view`` does not depend on the network: it is written for one.
    """
    monkeypatch.chdir(place)
    lines = commands()
    assert len(lines) == 5
    for line in lines if kind == "torchvision" else lines[:-1]:
        words = line.replace("my.onnx", weights).removeprefix("crosscue ").split()
        more = {
            "model init": ["--overwrite"],
            "replay PANDASET": ["--overwrite", "--no-cache"],
            "view run": ["--overwrite"],
        }
        assert cli.run([*words, *more.get(" ".join(words[:2]), [])]) == 0, capsys.readouterr().err
    metrics = json.loads(Path("run", "score", "metrics.json").read_text())
    found = metrics["cues"]["stop_sign"]
    right = found["precision"]
    return int(right["right"]), int(right["of"]), int(found["scored"])


@pytest.mark.parametrize("kind", SAMPLES)
def test_exported_network_is_scored_with_commands_of_page(
    place: Path, kind: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (place / "my.onnx").write_bytes(export(SAMPLES[kind]()))

    scored = follow_page(place, "my.onnx", kind, capsys, monkeypatch)

    assert read_card(place / "my.toml").output.kind == kind
    assert scored == (FRAMES, FRAMES, FRAMES)


def test_torchvision_weights_are_scored_with_commands_of_page(
    place: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    state = network("ssdlite320_mobilenet_v3_large", classes=1 + len(CLASSES)).state_dict()
    torch.save(state, place / "my.pth")

    scored = follow_page(place, "my.pth", "torchvision", capsys, monkeypatch)

    assert scored[2] == FRAMES
    assert Path("drive.rrd").stat().st_size
