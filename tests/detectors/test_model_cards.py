"""Tests of model cards end to end, mostly with generated networks."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from crosscue.detectors import rle
from crosscue.detectors.base import Detections, Detector, Frame
from crosscue.detectors.catalog.card import Input
from crosscue.detectors.networks.model_detector import build
from crosscue.detectors.networks.picture_input import prepared
from crosscue.replay.errors import VehicleError
from support.data import shared
from support.detecting import yolox_card
from support.onnx_models import bright_box_model, constant_model


def card(folder: Path, model: bytes, output: str, **more: str) -> Path:
    """Write a card for an ONNX file, with further sections as TOML."""
    (folder / "net.onnx").write_bytes(model)
    sections = {"input": "width_px = 64\nheight_px = 32\n"} | more
    text = f'version = 1\nweights = "net.onnx"\nsha256 = "{hashlib.sha256(model).hexdigest()}"\n'
    text += "".join(f"[{name}]\n{body}\n" for name, body in sections.items())
    path = folder / "net.toml"
    path.write_text(f"{text}[output]\n{output}\n", encoding="utf-8")
    return path


def frame(width: int, height: int, box: tuple[int, int, int, int], t_ns: int = 0) -> Frame:
    """Build a frame with a black picture and one white box."""
    pixels = np.zeros((height, width, 3), np.uint8)
    x0, y0, x1, y1 = box
    pixels[y0:y1, x0:x1] = 255
    return Frame(t_ns, "/camera", pixels, (width, height))


def detections_of(detector: Detector, *frames: Frame) -> list[Detections]:
    found = detector(frames)
    assert all(isinstance(one, Detections) for one in found)
    return [one for one in found if isinstance(one, Detections)]


BRIGHT = 'kind = "end-to-end"\nclasses = ["sign", "car"]\nscore = 0.5\noverlap = 1.0'


@pytest.mark.parametrize("fit", ["stretch", "letterbox", "letterbox-center", "crop"])
def test_box_is_mapped_back_to_the_camera_picture(tmp_path: Path, fit: str) -> None:
    given = f'width_px = 128\nheight_px = 64\nfit = "{fit}"\npad = 0'
    detector = build(card=str(card(tmp_path, bright_box_model(), BRIGHT, input=given)))

    (found,) = detections_of(detector, frame(512, 400, (200, 160, 280, 240)))

    assert found.labels == ("sign",)
    np.testing.assert_allclose(found.boxes_px, [[200, 160, 280, 240]], atol=8.0)


def test_batched_detections_match_single_pictures(tmp_path: Path) -> None:
    frames = [frame(128, 64, (8 * i, 4 * i, 8 * i + 24, 4 * i + 16), i) for i in range(5)]
    found = []
    for size in (1, 3):
        given = f"width_px = 128\nheight_px = 64\nmax_batch = {size}"
        path = card(tmp_path, bright_box_model(), BRIGHT, input=given)
        found.append([one.boxes_px for one in detections_of(build(card=str(path)), *frames)])

    np.testing.assert_array_equal(found[0], found[1])


def test_input_is_padded_and_normalised_by_the_card() -> None:
    pixels = np.random.default_rng(3).integers(0, 256, (20, 40, 3), np.uint8)
    expected_input = Input(
        width_px=40,
        height_px=30,
        fit="letterbox-center",
        pad=7,
        colour="rgb",
        mean=(1.0, 2.0, 3.0),
        scale=(0.5, 0.25, 2.0),
    )

    (numbers,), _ = prepared(pixels, expected_input)

    around = np.pad(pixels[:, :, ::-1], ((5, 5), (0, 0), (0, 0)), constant_values=7)
    expected = (around.astype(np.float32) - [1.0, 2.0, 3.0]) * [0.5, 0.25, 2.0]
    np.testing.assert_array_equal(numbers, expected.transpose(2, 0, 1))


def test_tiles_find_objects_too_small_for_the_full_picture(tmp_path: Path) -> None:
    """A bright box of 6 pixels vanishes if 1024 pixels become 128, but remains in a tile."""
    given = "width_px = 128\nheight_px = 64"
    small = frame(1024, 512, (701, 251, 707, 257))
    found = {}
    for name, sections in {"whole": {}, "tiles": {"tiles": "top = 0.4\nbottom = 0.6"}}.items():
        path = card(tmp_path, bright_box_model(), BRIGHT, input=given, **sections)
        (found[name],) = detections_of(build(card=str(path)), small)

    assert not len(found["whole"])
    np.testing.assert_allclose(found["tiles"].boxes_px, [[701, 251, 707, 257]], atol=1.0)


def test_mask_has_the_size_of_the_camera_picture(tmp_path: Path) -> None:
    """The network's mask covers the left half of a box in the centre."""
    boxes = np.zeros((1, 2 + 4 + 32, 40), np.float32)
    boxes[0, :7, 3] = [32, 16, 32, 16, 0.9, 0.0, 1.0]
    prototypes = np.full((1, 32, 8, 16), -9.0, np.float32)
    prototypes[0, 0, :, :8] = 9.0
    model = constant_model((1, 3, 32, 64), {"boxes": boxes, "masks": prototypes})
    output = 'kind = "yolov8-seg"\nname = "boxes"\nprototypes = "masks"\nclasses = ["sign", "car"]'

    (found,) = detections_of(
        build(card=str(card(tmp_path, model, output))), frame(640, 320, (0, 0, 1, 1))
    )

    np.testing.assert_allclose(found.boxes_px, [[160, 80, 480, 240]])
    mask = rle.decode_mask(found.masks[0], (640, 320))
    expected_input = np.zeros((320, 640), bool)
    expected_input[80:240, 160:320] = True
    np.testing.assert_array_equal(mask[:, :300], expected_input[:, :300])
    assert mask[:, 340:].sum() == 0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"values": np.full((1, 3, 6), np.nan, np.float32)}, "3 of 3 candidates are not finite"),
        ({"values": np.zeros((1, 3, 7), np.float32)}, "expected (1, N, 6)"),
        ({"values": np.full((1, 3, 6), 9.0, np.float32)}, "class numbers 9 to 9"),
    ],
)
def test_invalid_output_is_reported_on_one_line(
    tmp_path: Path, change: dict[str, Any], message: str
) -> None:
    path = card(tmp_path, constant_model((1, 3, 32, 64), {"out": change["values"]}), BRIGHT)

    with pytest.raises(VehicleError) as error:
        build(card=str(path))

    assert message in str(error.value)
    assert "net.toml" in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("output", "sections", "message"),
    [
        ('kind = "end-to-end"\nclasses = []', {}, "output.classes is empty"),
        (BRIGHT, {"labels": 'bicycle = "car"'}, "'bicycle' is not one of output.classes"),
        ('kind = "yolo12"\nclasses = ["car"]', {}, "yolox"),
    ],
)
def test_invalid_card_is_reported_on_one_line(
    tmp_path: Path, output: str, sections: dict[str, str], message: str
) -> None:
    path = card(tmp_path, bright_box_model(), output, **sections)

    with pytest.raises(VehicleError) as error:
        build(card=str(path))

    assert message in str(error.value)
    assert "\n" not in str(error.value)


def _yolox(folder: Path, width: int, height: int, backend: str) -> Detections:
    import cv2

    path = yolox_card(folder)
    text = path.read_text(encoding="utf-8").replace("width_px = 416", f"width_px = {width}")
    text = text.replace("height_px = 416", f"height_px = {height}\nis_resizable = true")
    path.write_text(text, encoding="utf-8")
    name = shared("sequences", "pandaset_002", "camera", "front_camera", "00.jpg")
    pixels = np.asarray(cv2.imread(str(name)), np.uint8)
    (found,) = detections_of(
        build(card=str(path), backend=backend),
        Frame(0, "/camera", pixels, (pixels.shape[1], pixels.shape[0])),
    )
    return found


@pytest.mark.parametrize("backend", ["onnxruntime", "openvino", "opencv"])
def test_fully_convolutional_network_runs_at_the_size_of_the_card(
    tmp_path: Path, backend: str
) -> None:
    """More objects are found at 1280 x 736 than at the 416 x 416 declared in the file."""
    small = _yolox(tmp_path, 416, 416, "onnxruntime")
    large = _yolox(tmp_path, 1280, 736, backend)

    assert large.labels.count("traffic light") > small.labels.count("traffic light")
    assert large.labels.count("car") > small.labels.count("car")
