"""Invalid networks, cards and labels are refused in one line, and no run folder remains."""

import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import crosscue
from crosscue.detectors.base import Frame, View
from crosscue.detectors.box_detector import BoxDetector, ScoredBox
from crosscue.eval import cli
from support.onnx_models import constant_model, write_card
from support.pictures import picture_folder
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
