"""Networks with model cards: drafts, boxes, masks, damaged files and implausible results."""

import hashlib
import shutil
from pathlib import Path

import cv2
import numpy as np
import onnx
import pytest
from numpy.typing import NDArray

import crosscue
from crosscue.detectors import rle
from crosscue.detectors.base import Detections, Detector, Frame
from crosscue.detectors.catalog.card import Input
from crosscue.detectors.catalog.cards import check_card
from crosscue.detectors.catalog.recognise import closed, guesses, read_interface
from crosscue.detectors.networks.model_detector import RoadModel, build
from crosscue.detectors.networks.picture_input import prepared
from crosscue.eval import cli
from crosscue.replay.errors import UsageError, VehicleError
from support.data import shared
from support.detecting import yolox_card
from support.onnx_models import bright_box_model, constant_model, open_model


def card(folder: Path, model: bytes, output: str, **more: str) -> Path:
    """Write a card for an ONNX file, with further sections as TOML."""
    (folder / "net.onnx").write_bytes(model)
    sections = {"input": "width_px = 64\nheight_px = 32\n"} | more
    text = f'version = 1\nweights = "net.onnx"\nsha256 = "{hashlib.sha256(model).hexdigest()}"\n'
    text += "".join(f"[{name}]\n{body}\n" for name, body in sections.items())
    path = folder / "net.toml"
    path.write_text(f"{text}[output]\n{output}\n", encoding="utf-8")
    return path


def card_of_boxes(folder: Path, model: bytes, output: str) -> Path:
    """Write a card for an ONNX file with an input of 256 x 128."""
    return card(folder, model, output, input="width_px = 256\nheight_px = 128\n")


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


def test_enlarged_middle_finds_small_objects_once_and_in_their_place(tmp_path: Path) -> None:
    """A box of 4 pixels vanishes if 1024 pixels become 128, but remains in the middle half."""
    path = str(card(tmp_path, bright_box_model(), BRIGHT, input="width_px = 128\nheight_px = 64"))
    size = (1024, 512)
    small, large = frame(*size, (565, 285, 569, 289)), frame(*size, (400, 192, 496, 288))
    cut, outside = frame(*size, (720, 192, 816, 288)), frame(*size, (32, 32, 128, 128))
    whole, enlarged = build(card=path), build(card=path, enlarged=True)

    assert whole.identity != enlarged.identity
    assert not len(detections_of(whole, small)[0])
    np.testing.assert_allclose(
        detections_of(enlarged, small)[0].boxes_px, [[565, 285, 569, 289]], atol=4.0
    )
    for one in (large, cut, outside):
        (found,) = detections_of(enlarged, one)
        np.testing.assert_allclose(found.boxes_px, detections_of(whole, one)[0].boxes_px, atol=8.0)


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
    ("output", "sections", "message"),
    [
        (BRIGHT, {"labels": 'bike = "car"\nbus = "car"'}, "not in output.classes: 'bike', 'bus'"),
        ('kind = "yolo12"\nclasses = ["car"]', {}, "yolox"),
    ],
)
def test_invalid_card_is_reported_on_one_line(
    tmp_path: Path, output: str, sections: dict[str, str], message: str
) -> None:
    path = card(tmp_path, bright_box_model(), output, **sections)

    with pytest.raises(VehicleError, match=rf"^.*{message}.*$"):
        build(card=str(path))


def _yolox(folder: Path, width: int, height: int, backend: str) -> Detections:
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


@pytest.mark.parametrize("backend", ["onnxruntime", "openvino"])
def test_fully_convolutional_network_runs_at_the_size_of_the_card(
    tmp_path: Path, backend: str
) -> None:
    """More objects are found at 1280 x 736 than at the 416 x 416 declared in the file."""
    small = _yolox(tmp_path, 416, 416, "onnxruntime")
    large = _yolox(tmp_path, 1280, 736, backend)

    assert large.labels.count("traffic light") > small.labels.count("traffic light")
    assert large.labels.count("car") > small.labels.count("car")


# Cells of strides 8, 16 and 32 at 256 x 128.
CELLS = 32 * 16 + 16 * 8 + 8 * 4
SHAPE = (1, 3, 128, 256)
END_TO_END = 'kind = "end-to-end"\nclasses = ["dog", "cat"]\nscore = 0.3\noverlap = 1.0'
Table = NDArray[np.float32]


def rows(count: int = 200) -> Table:
    """Sensible boxes with scores from 0.31 to 0.9."""
    left = np.linspace(0.0, 200.0, count)
    table = np.column_stack([left, left / 4, left + 40.0, left / 4 + 30.0, left, 0 * left])
    table[:, 4] = np.linspace(0.31, 0.9, count)
    return table[None].astype(np.float32)


def changed(**columns: float) -> Table:
    """The sensible boxes with other values in columns named x0, y0, x1, y1 and score."""
    table = rows()
    for name, value in columns.items():
        table[0, :, ("x0", "y0", "x1", "y1", "score").index(name)] = value
    return table


# What is seen, with the output in which it is seen.
GARBAGE = {
    "200 boxes cover the whole picture": changed(x0=-5.0, y0=-5.0, x1=900.0, y1=300.0),
    "200 detections have the score 0.7": changed(score=0.7),
    "200 of 200 boxes are outside the picture": changed(x0=300.0, x1=400.0),
    "200 of 200 boxes have a negative size": changed(x0=300.0, x1=10.0),
    "200 of 200 boxes are more than four times as large": changed(x0=0.0, x1=90_000.0),
    "within 2 pixels of the corner": changed(x0=0.2, y0=0.3, x1=0.5, y1=0.9),
    "scores from -4 to -4": changed(score=-4.0),
}


@pytest.mark.parametrize("seen", GARBAGE)
def test_card_of_garbage_is_neither_passed_nor_written_and_says_what_was_seen(
    tmp_path: Path, seen: str
) -> None:
    path = card_of_boxes(tmp_path, constant_model(SHAPE, {"rows": GARBAGE[seen]}), END_TO_END)

    with pytest.raises(VehicleError, match=f"net.toml: on noise, .*{seen}"):
        check_card(path)
    path.unlink()
    with pytest.raises(VehicleError, match=f"net.toml: not written: on noise, .*{seen}"):
        crosscue.draft_card(tmp_path / "net.onnx", kind="end-to-end", class_names=["dog", "cat"])

    assert [one.name for one in tmp_path.iterdir()] == ["net.onnx"]


def test_sensible_boxes_pass(tmp_path: Path) -> None:
    model = constant_model(SHAPE, {"rows": rows()})

    found = check_card(card_of_boxes(tmp_path, model, END_TO_END))

    assert str(found) == f"{tmp_path / 'net.toml'}: fits its network"


def pixel_boxes_and_scores() -> dict[str, Table]:
    """Outputs in YOLO-NAS's layout: corners in pixels, and final scores of three classes."""
    boxes = np.tile(rows()[:, :1, :4], (1, CELLS, 1))
    return {"904": boxes, "913": np.full((1, CELLS, 3), 0.01, np.float32)}


def test_boxes_in_pixels_are_not_taken_for_queries_in_fractions(tmp_path: Path) -> None:
    net = tmp_path / "nas.onnx"
    net.write_bytes(constant_model(SHAPE, pixel_boxes_and_scores()))

    kinds = [guess.settings["kind"] for guess in guesses(read_interface(net))]

    assert "detr" not in kinds


def test_pixel_boxes_read_as_fractions_are_refused(tmp_path: Path) -> None:
    output = 'kind = "detr"\nboxes = "904"\nlogits = "913"\nclasses = ["a", "b", "c"]'
    model = constant_model(SHAPE, pixel_boxes_and_scores())

    with pytest.raises(VehicleError, match=r"on noise, .* boxes are more than four times as large"):
        check_card(card_of_boxes(tmp_path, model, output))


@pytest.mark.parametrize(
    ("key", "line", "said"),
    [
        ("scale", "scale = [0.00392, 0.00392, 0.00392]", "scale = 1, pixels from 0 to 255"),
        ("mean", "mean = [300.0, 300.0, 300.0]", "scale = 1, pixels from 0 to 255"),
        ("colour", 'colour = "rgb"', 'colour = "bgr"'),
    ],
)
def test_check_says_with_which_input_a_network_finds_something(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], key: str, line: str, said: str
) -> None:
    model = bright_box_model(channels="blue" if key == "colour" else "images")
    path = card_of_boxes(tmp_path, model, END_TO_END)
    text = path.read_text()
    street = tmp_path / "street.png"
    cv2.imwrite(str(street), np.full((128, 256, 3), (255, 40, 40), np.uint8))
    assert check_card(path, street).doubt is None

    path.write_text(text.replace("[output]", f"{line}\n[output]"))
    status = cli.run(["check", str(path), "--picture", str(street)])

    assert status == 3
    (doubt,) = [one for one in capsys.readouterr().out.splitlines() if one.startswith("doubt")]
    assert f"0 boxes above 0.3 in the picture, 1 boxes with scores up to 1.00 with {said}" in doubt


def test_check_says_with_which_input_there_is_no_flood_of_sure_boxes(tmp_path: Path) -> None:
    """Scores of 200 boxes are about the brightness, at most 1."""
    model = onnx.load_model_from_string(constant_model(SHAPE, {"rows": rows()}))
    graph, helper = model.graph, onnx.helper
    for name, values in (("boxes", rows()[..., :4]), ("class", rows()[..., 5:])):
        graph.initializer.append(onnx.numpy_helper.from_array(values, name))
    spread = np.linspace(0.0, 0.015, 200, dtype=np.float32).reshape(1, 200, 1)
    graph.initializer.append(onnx.numpy_helper.from_array(spread, "spread"))
    del graph.node[:], graph.output[:]
    graph.node.extend(
        [
            helper.make_node("ReduceMean", ["images"], ["grey"], axes=[1, 2, 3], keepdims=0),
            helper.make_node("Clip", ["grey", "", "one"], ["most"]),
            helper.make_node("Sub", ["most", "spread"], ["score"]),
            helper.make_node("Concat", ["boxes", "score", "class"], ["rows"], axis=2),
        ]
    )
    graph.initializer.append(onnx.numpy_helper.from_array(np.array(1.0, np.float32), "one"))
    given = helper.make_tensor_value_info("rows", onnx.TensorProto.FLOAT, [1, 200, 6])
    graph.output.append(given)
    street = tmp_path / "street.png"
    cv2.imwrite(str(street), np.full((128, 256, 3), 140, np.uint8))
    path = card_of_boxes(tmp_path, model.SerializeToString(), END_TO_END)

    doubt = check_card(path, street).doubt

    assert doubt is not None
    assert "boxes with scores up to 1.00 above 0.3 in the picture" in doubt
    assert "with scale = 1/255, pixels from 0 to 1" in doubt


def test_open_sizes_of_an_input_of_bytes_are_found_by_a_run(tmp_path: Path) -> None:
    net = tmp_path / "net.onnx"
    net.write_bytes(open_model((1, 3, "height", "width"), {}, is_bytes=True))

    model = closed(net, read_interface(net), (64, 32))

    assert model.inputs[0].is_bytes
    assert model.inputs[0].shape == (1, 3, 32, 64)
    assert model.outputs[0].shape == (1, 84, 100)


# Real networks, with their class names behind the background.
ROAD_NETWORKS = {
    "road-segmentation-adas-0001/road-segmentation-adas-0001.xml": "road,curb,mark",
    "twinlitenet/twinlitenet_best.onnx": "road",
}
PICTURE = Path("sequences", "pandaset_002", "camera", "front_camera", "00.jpg")


def scores(size: tuple[int, int], classes: int = 3) -> NDArray[np.float32]:
    """Class scores (1, C, h, w): class 1 in the lower half, class 0 above it."""
    values = np.zeros((1, classes, size[1], size[0]), np.float32)
    values[0, 0, : size[1] // 2] = values[0, 1, size[1] // 2 :] = 1.0
    return values


def network(folder: Path, size: tuple[int, int] = (64, 32), **outputs: object) -> Path:
    """Write a network for pictures of a size."""
    path = folder / "road.onnx"
    values = {name: np.asarray(value) for name, value in outputs.items()}
    path.write_bytes(constant_model((1, 3, size[1], size[0]), values))
    return path


@pytest.mark.parametrize("size", [(64, 32), (16, 8)], ids=["whole size", "a quarter"])
@pytest.mark.parametrize("names", ["sky,road,curb", "road,curb"], ids=["all", "no background"])
def test_card_is_written_and_road_is_found(
    tmp_path: Path, size: tuple[int, int], names: str
) -> None:
    card = crosscue.draft_card(network(tmp_path, mask=scores(size)), classes=names).path

    detector = build(card=str(card))
    assert isinstance(detector, RoadModel)
    mask = detector.road_mask(Frame(0, "", np.zeros((64, 128, 3), np.uint8), (128, 64)))
    np.testing.assert_array_equal(mask.mean(axis=1), np.arange(size[1]) >= size[1] // 2)


@pytest.mark.parametrize(
    ("size", "outputs"),
    [
        ((64, 32), {"depth": np.zeros((1, 1, 32, 64), np.float32)}),
        ((64, 32), {"cells": np.zeros((1, 85, 1, 2), np.float32)}),
        ((64, 32), {"a": scores((64, 32), 4), "b": scores((16, 8), 4)}),
        # Edge Impulse's FOMO has a grid of 12 x 12 for a picture of 96 x 96.
        ((96, 96), {"grid": scores((12, 12), 2)}),
    ],
    ids=["one channel", "cells of stride 32", "maps of two sizes", "grid of centres"],
)
def test_other_maps_are_not_taken_for_classes(
    tmp_path: Path, size: tuple[int, int], outputs: dict[str, NDArray[np.float32]]
) -> None:
    with pytest.raises(UsageError, match=f"{next(iter(outputs))} .*: not supported"):
        crosscue.draft_card(network(tmp_path, size, **outputs), classes="road,face")


def test_maps_of_points_are_not_taken_for_classes(tmp_path: Path) -> None:
    """A pose network's maps are zero but for a spot; a pixel's class has a high score."""
    maps = np.zeros((1, 17, 8, 16), np.float32)
    maps[0, :, 5, 7] = 0.9

    with pytest.raises(VehicleError, match=r"not written: .*maps of points"):
        crosscue.draft_card(
            network(tmp_path, maps=maps), classes=",".join(["road", *map(str, range(16))])
        )


@pytest.mark.parametrize(
    ("left", "right", "beside"),
    [
        (16, 16, 11),
        # A column more or less is the compression's.
        (16, 17, 12),
        # Dark on one side, or a dark edge, is a part of the picture.
        (16, 0, 0),
        (2, 2, 0),
        # A black picture is no bar.
        (64, 64, 0),
    ],
)
def test_black_bars_beside_a_picture_are_no_road_and_are_not_looked_at(
    left: int, right: int, beside: int, tmp_path: Path
) -> None:
    card = crosscue.draft_card(network(tmp_path, mask=scores((64, 32))), classes="sky,road,curb")
    detector = build(card=str(card.path))
    assert isinstance(detector, RoadModel)
    pixels = np.full((64, 128, 3), 33, np.uint8)
    pixels[:, :left] = pixels[:, 128 - right :] = 32

    mask = detector.road_mask(Frame(0, "", pixels, (128, 64)))

    # The network is given all that is between the bars, and nothing else.
    assert mask.shape == (32, 64 + 2 * beside)
    assert mask[16:, beside : 64 + beside].all()
    assert mask.sum() == 16 * 64


def test_weak_scores_of_both_signs_are_classes(tmp_path: Path) -> None:
    """Logits of a network with random weights."""
    weak = np.random.default_rng(0).normal(0.0, 0.02, (1, 11, 8, 16)).astype(np.float32)

    names = ",".join(["road", *map(str, range(10))])
    assert crosscue.draft_card(network(tmp_path, logits=weak), classes=names).path.exists()


@pytest.mark.parametrize("weights", ROAD_NETWORKS)
def test_real_network_draws_its_road(tmp_path: Path, weights: str) -> None:
    given = shared("weights") / weights
    for path in (given, given.with_suffix(".bin")):
        if path.exists():
            shutil.copy(path, tmp_path)

    picture = shared(*PICTURE.parts)
    found = crosscue.draft_card(
        tmp_path / given.name, classes=ROAD_NETWORKS[weights], picture=picture
    )

    detector = build(card=str(found.path))
    assert isinstance(detector, RoadModel)
    pixels = np.asarray(cv2.imread(str(picture)), np.uint8)
    mask = detector.road_mask(Frame(0, "", pixels, (pixels.shape[1], pixels.shape[0])))
    above, below = np.array_split(mask, 2)
    assert below.mean() > 0.3
    assert above.mean() < 0.1
    drawn = np.asarray(cv2.imread(str(found.picture)), np.int64)
    assert np.abs(drawn - pixels).max(axis=2).mean() > 10.0


def test_networks_of_transformers_get_imagenet_s_mean(tmp_path: Path) -> None:
    path = network(tmp_path, logits=scores((16, 8)))
    model = onnx.load(path)
    assert all(model.graph.input[0].name not in node.input for node in model.graph.node)
    model.graph.input[0].name = "pixel_values"
    onnx.save(model, path)

    given = crosscue.model(crosscue.draft_card(path, classes="road,curb").path).card.input

    assert (given.colour, given.mean[0]) == ("rgb", 123.675)
