"""Every family of networks: known boxes are exact at a wide and a tall size, nonsense refused."""

import re
from pathlib import Path
from typing import Final

import cv2
import numpy as np
import onnx
import pytest

import crosscue
from crosscue.detectors.base import Detections, Frame
from crosscue.detectors.catalog.recognise import guesses, input_settings, plausible, read_interface
from crosscue.detectors.decoders.base import BoxOutput, Guess, Size, cell_grid, decoder_name
from crosscue.detectors.decoders.table import DECODERS
from crosscue.detectors.networks.model_detector import build
from crosscue.replay.errors import VehicleError
from support.decoder_samples import (
    BOX,
    CLASS,
    CLASSES,
    EVERY,
    SAMPLES,
    SCORE,
    SIZE,
    TALL,
    Sample,
    export,
    nanodet_of_coco,
)
from support.onnx_models import bright_box_model, constant_model

NAMED: Final = {"names": str(list(CLASSES))}
SIZES: Final = pytest.mark.parametrize("size", [SIZE, TALL], ids=["wide", "tall"])
# Families whose files another one can have as well: --kind, or the number of class names, decides.
TWINS: Final = {"yolox": {"yolox", "yolov5"}, "pp-yoloe": {"pp-yoloe", "yolov5"}}


def boxes_by(card: Path, size: Size, scale: int = 1) -> Detections:
    """What a card's network finds in a black picture of a multiple of its size."""
    width, height = scale * size[0], scale * size[1]
    frame = Frame(0, "", np.zeros((height, width, 3), np.uint8), (width, height))
    (found,) = build(card=str(card))([frame])
    assert isinstance(found, Detections)
    np.testing.assert_allclose(found.boxes_px, [scale * BOX], atol=1e-3)
    return found


def test_every_family_has_an_export() -> None:
    kinds = {make(SIZE).settings["kind"] for make in EVERY.values()}

    assert kinds == set(map(decoder_name, DECODERS))


@SIZES
@pytest.mark.parametrize("family", EVERY)
def test_family_is_recognised_without_options(tmp_path: Path, family: str, size: Size) -> None:
    net = tmp_path / "net.onnx"
    sample = EVERY[family](size)
    net.write_bytes(export(sample, size))

    model = read_interface(net)
    some = guesses(model)
    kept = plausible(net, model, some) if len(some) > 1 else some
    found = {guess.settings["kind"] for guess in kept}

    kind = sample.settings["kind"]
    assert found <= TWINS.get(kind, {kind})
    assert kind in found


@SIZES
@pytest.mark.parametrize("family", EVERY)
def test_known_box_is_exact(tmp_path: Path, family: str, size: Size) -> None:
    """The picture is twice the input, so that it has no margin."""
    net = tmp_path / "net.onnx"
    sample = EVERY[family](size)
    net.write_bytes(export(sample, size))

    card = crosscue.draft_card(net, kind=sample.settings["kind"], class_names=CLASSES)

    found = boxes_by(card.path, size, 2)

    # Outputs are float32.
    np.testing.assert_allclose(found.scores, [SCORE], atol=1e-6)
    assert found.labels == (CLASSES[CLASS],)


@pytest.mark.parametrize("family", EVERY)
def test_family_with_numbers_that_are_not_finite_gets_no_card(tmp_path: Path, family: str) -> None:
    net = tmp_path / "net.onnx"
    sample = EVERY[family](SIZE)
    for values in sample.outputs.values():
        if values.dtype.kind == "f":
            values[...] = np.nan
    net.write_bytes(export(sample))

    with pytest.raises(VehicleError, match=r"not written.*(finite|scores)"):
        crosscue.draft_card(net, kind=sample.settings["kind"], class_names=CLASSES)

    assert not net.with_suffix(".toml").exists()


def test_boxes_decide_between_families(tmp_path: Path) -> None:
    """4 + 3 columns of Paddle's export are 5 + 2 of YOLOX's, but its boxes are corners."""
    net = tmp_path / "net.onnx"
    net.write_bytes(export(EVERY["pp-yoloe, one output"](SIZE)))

    with pytest.raises(crosscue.UsageError, match=r"net\.onnx: 3 classes without names"):
        crosscue.draft_card(net)

    assert crosscue.draft_card(net, class_names=CLASSES).draft.kind == "pp-yoloe"


@SIZES
def test_number_of_coco_s_classes_decides_between_families(tmp_path: Path, size: Size) -> None:
    """80 + 32 columns of NanoDet are 5 + 107 of YOLOX's."""
    net = tmp_path / "net.onnx"
    net.write_bytes(export(nanodet_of_coco(size), size))

    card = crosscue.draft_card(net)

    assert card.draft.kind == "nanodet"
    assert boxes_by(card.path, size, 2).labels == ("car",)


@pytest.mark.parametrize("shape", [(1000, 600), (600, 1000)], ids=["tall", "wide"])
def test_doubt_about_fit_is_said_with_both_results(tmp_path: Path, shape: tuple[int, int]) -> None:
    net, street = tmp_path / "net.onnx", tmp_path / "street.png"
    # Pixels are scaled to 0..1 in such a network's card.
    net.write_bytes(bright_box_model(above=0.5))
    cv2.imwrite(str(street), np.full((*shape, 3), 255, np.uint8))

    drafted = crosscue.draft_card(net, class_names=["bright"], size_px=(96, 64), picture=street)

    (doubt,) = [line for line in drafted.draft.assumed if "input.fit" in line]
    assert '1 boxes with scores up to 1.00 with fit = "letterbox-center"' in doubt
    assert f'1 boxes with scores up to 1.00 with fit = "stretch" in {shape[1]} x' in doubt
    assert f"# Assumed, please check: {doubt}." in drafted.path.read_text()


def test_fit_is_not_in_doubt_where_metadata_or_proportions_decide(tmp_path: Path) -> None:
    street = tmp_path / "street.png"
    for name, metadata, shape in (("a", {}, (640, 960)), ("b", {"names": "['x']"}, (600, 1000))):
        model = onnx.load_model_from_string(bright_box_model())
        onnx.helper.set_model_props(model, metadata)
        net = tmp_path / f"{name}.onnx"
        net.write_bytes(model.SerializeToString())
        cv2.imwrite(str(street), np.full((*shape, 3), 255, np.uint8))

        drafted = crosscue.draft_card(net, class_names=["x"], size_px=(96, 64), picture=street)

        assert not [line for line in drafted.draft.assumed if "input.fit" in line]


@pytest.mark.parametrize("scores", ["ArgMax", "EfficientNMS_TRT"])
@pytest.mark.parametrize("count", [3, 80])
def test_number_of_classes_is_read_from_the_suppression(
    tmp_path: Path, scores: str, count: int
) -> None:
    """YOLOv7's export has no names, and its output, rows of 7, does not say how many there are."""
    net = tmp_path / "net.onnx"
    model = onnx.load_model_from_string(export(EVERY["yolov7-nms"](SIZE)))
    graph, helper = model.graph, onnx.helper
    for name, shape in (("all", (1, 9, count)), ("boxes", (1, 9, 4)), ("best", (1, 1, 9))):
        graph.initializer.append(onnx.numpy_helper.from_array(np.zeros(shape, np.float32), name))
    graph.node.append(helper.make_node("Identity", ["all"], ["scores"]))
    if scores == "ArgMax":
        graph.node.append(helper.make_node("ArgMax", ["scores"], ["unused"], axis=2))
        graph.node.append(helper.make_node("NonMaxSuppression", ["boxes", "best"], ["kept"]))
    else:
        plugin = helper.make_node(scores, ["boxes", "scores"], ["kept"], domain="TRT")
        graph.node.append(plugin)
        model.opset_import.append(helper.make_opsetid("TRT", 1))
    net.write_bytes(model.SerializeToString())

    guess = guesses(read_interface(net))[0]

    assert (guess.settings["kind"], guess.class_count) == ("yolov7-nms", count)


@SIZES
@pytest.mark.parametrize("axes", [(0, 1, 2), (0, 2, 1)], ids=["columns", "rows"])
@pytest.mark.parametrize("form", ["corners", "centers"])
def test_boxes_decide_between_corners_and_centers(
    tmp_path: Path, size: Size, axes: tuple[int, int, int], form: str
) -> None:
    """LibreYOLO's YOLOv9 and RTMDet have the tables of YOLOv8, with boxes as corners."""
    net = tmp_path / "net.onnx"
    corner, stride = cell_grid(size, (8, 16, 32))
    middle = (corner + 0.5) * stride
    boxes = np.hstack([middle - stride, middle + stride])
    boxes[7] = BOX
    if form == "centers":
        boxes = np.hstack([(boxes[:, :2] + boxes[:, 2:]) / 2, boxes[:, 2:] - boxes[:, :2]])
    scores = np.full((len(corner), 3), 0.01)
    scores[7, CLASS] = SCORE
    table = np.hstack([boxes, scores]).T[None].transpose(axes).astype(np.float32)
    shape = (1, 3, size[1], size[0])
    net.write_bytes(constant_model(shape, {"output": table}, metadata=NAMED))

    assert boxes_by(crosscue.draft_card(net).path, size).labels == (CLASSES[CLASS],)


def test_padding_of_an_export_with_suppression_is_no_detection(tmp_path: Path) -> None:
    """LibreYOLO's EfficientDet has class -1 in the rows after its detections."""
    net = tmp_path / "net.onnx"
    rows = np.tile(np.array([0.0, 0.0, 0.0, 0.0, 0.0, -1.0], np.float32), (1, 300, 1))
    rows[0, 0] = [*BOX, SCORE, CLASS]
    net.write_bytes(constant_model((1, 3, SIZE[1], SIZE[0]), {"output": rows}))

    card = crosscue.draft_card(net, kind="end-to-end", class_names=CLASSES)

    assert boxes_by(card.path, SIZE).labels == (CLASSES[CLASS],)


@pytest.mark.parametrize("outputs", ["scores", "numbers"])
def test_task_semantic_in_the_metadata_is_a_segmentation(tmp_path: Path, outputs: str) -> None:
    net = tmp_path / "net.onnx"
    shape = (1, 3, SIZE[1], SIZE[0])
    values = (
        np.zeros(shape, np.float32) if outputs == "scores" else np.zeros((1, *shape[2:]), np.int64)
    )
    metadata = {"names": "['road', 'car', 'sky']", "task": "semantic"}
    net.write_bytes(constant_model(shape, {"semantic_logits": values}, metadata=metadata))

    assert crosscue.draft_card(net).draft.kind == "segmentation"


@pytest.mark.parametrize(
    ("output", "metadata", "pixels"),
    [
        # LibreYOLO's YOLOX stores class names; a row for each cell is YOLOX's, not YOLOv5's.
        ("output", NAMED, {"colour": "bgr", "scale": None}),
        # YOLOv6 has a row for each cell as YOLOX with decoding; its output is called outputs.
        ("outputs", {}, {"colour": "rgb", "fit": "letterbox-center"}),
    ],
)
def test_families_with_a_row_for_each_cell_get_their_own_pixels(
    tmp_path: Path, output: str, metadata: dict[str, str], pixels: dict[str, str | None]
) -> None:
    net = tmp_path / "net.onnx"
    rows = np.zeros((1, len(cell_grid(SIZE, (8, 16, 32))[0]), 8), np.float32)
    net.write_bytes(constant_model((1, 3, SIZE[1], SIZE[0]), {output: rows}, metadata=metadata))

    (guess,) = [one for one in guesses(read_interface(net)) if one.settings["kind"] == "yolov5"]

    assert guess.input is not None
    assert {name: guess.input.get(name) for name in pixels} == pixels


@pytest.mark.parametrize("background", [0, 2])
@pytest.mark.parametrize("count", [2, 90])
def test_classes_are_read_from_detection_output(
    tmp_path: Path, count: int, background: int
) -> None:
    """Open Model Zoo's pedestrians and vehicles are not COCO's first classes.

    Its newer networks have the background last.
    """
    ov = pytest.importorskip("openvino")
    shapes = {"boxes": [1, 400], "scores": [1, 100 * (count + 1)], "priors": [1, 2, 400]}
    given = [ov.opset8.parameter(shape, np.float32, name) for name, shape in shapes.items()]
    picture = ov.opset8.parameter([1, 3, 32, 64], np.float32, "data")
    settings = {
        "background_label_id": background and count,
        "top_k": 400,
        "keep_top_k": [200],
        "nms_threshold": 0.45,
        "confidence_threshold": 0.01,
        "code_type": "caffe.PriorBoxParameter.CENTER_SIZE",
        "normalized": True,
        "share_location": True,
    }
    found = ov.opset8.detection_output(*given, settings)
    ov.save_model(ov.Model([found], [picture, *given]), tmp_path / "net.xml")

    model = read_interface(tmp_path / "net.xml")
    (guess,) = guesses(model)

    assert guess.class_count == count
    assert guess.settings.get("first_class", 1) == (0 if background else 1)


def test_classes_of_open_model_zoo_are_not_taken_for_coco_s(tmp_path: Path) -> None:
    net = tmp_path / "net.onnx"
    net.write_bytes(export(EVERY["mmdeploy, names of Open Model Zoo"](SIZE)))

    with pytest.raises(crosscue.UsageError, match="its classes without names"):
        crosscue.draft_card(net)


def test_openvino_network_of_bytes_scales_its_pixels_itself(tmp_path: Path) -> None:
    """OpenVINO's PrePostProcessor puts mean and scale into the file."""
    ov = pytest.importorskip("openvino")
    given = ov.opset8.parameter([1, 32, 64, 3], np.uint8, "image")
    rows = ov.opset8.constant(np.zeros((1, 43, 6), np.float32))
    ov.save_model(ov.Model([rows], [given]), tmp_path / "net.xml")

    model = read_interface(tmp_path / "net.xml")
    guess = Guess({"kind": "nanodet"}, 1, (), input={"colour": "bgr", "scale": (1 / 255,) * 3})

    assert model.inputs[0].is_bytes
    assert "scale" not in input_settings(model, guess)


def test_outputs_without_names_are_told_apart(tmp_path: Path) -> None:
    """Ultralytics' segmentation in OpenVINO has two of them."""
    ov = pytest.importorskip("openvino")
    given = ov.opset8.parameter([1, 3, 320, 640], np.float32, "x")
    values = [value.astype(np.float32) for value in EVERY["yolov8-seg"](SIZE).outputs.values()]
    net = tmp_path / "net.xml"
    ov.save_model(ov.Model(list(map(ov.opset8.constant, values)), [given]), net)
    net.write_text(re.sub(r' (?:output_)?names="Result[^"]*"', "", net.read_text()))

    card = crosscue.draft_card(net, class_names=CLASSES)

    assert card.draft.kind == "yolov8-seg"


def test_names_beside_a_yolov5_openvino_file_are_read(tmp_path: Path) -> None:
    """Its exporter calls them as the model, other exporters metadata.yaml."""
    ov = pytest.importorskip("openvino")
    given = ov.opset8.parameter([1, 3, 32, 64], np.float32, "images")
    ov.save_model(ov.Model([given], [given]), tmp_path / "best.xml")
    (tmp_path / "best.yaml").write_text("stride: 32\nnames: {0: cube, 1: cone}\n")

    assert read_interface(tmp_path / "best.xml").class_names == ("cube", "cone")


def test_old_openvino_file_is_not_called_incomplete(tmp_path: Path) -> None:
    pytest.importorskip("openvino")
    old = tmp_path / "old.xml"
    old.write_text('<?xml version="1.0"?>\n<net name="vd" version="3" batch="1"><layers/></net>')

    with pytest.raises(crosscue.UsageError, match=r"version 3 of OpenVINO's format.*convert") as e:
        read_interface(old)

    assert "not a complete" not in str(e.value)


@pytest.fixture(params=DECODERS, ids=decoder_name)
def decoder(request: pytest.FixtureRequest) -> type[BoxOutput]:
    found: type[BoxOutput] = request.param
    return found


def _built(decoder: type[BoxOutput]) -> tuple[BoxOutput, Sample]:
    sample = SAMPLES[decoder_name(decoder)]()
    return decoder.model_validate({"classes": CLASSES, **sample.settings}), sample


def test_masks_cover_the_network_input(decoder: type[BoxOutput]) -> None:
    output, sample = _built(decoder)
    found = output.candidates(sample.outputs, SIZE)

    assert (found.masks is not None) == sample.is_masked
    if found.masks is not None:
        (mask,) = found.masks(np.array([int(found.scores.argmax())]))
        columns = (mask > 0.5).mean(axis=0)
        middle = BOX[[0, 2]].mean() / SIZE[0] * len(columns)
        np.testing.assert_array_equal(columns, np.arange(len(columns)) < int(middle))


def test_output_of_another_shape_is_refused(decoder: type[BoxOutput]) -> None:
    output, sample = _built(decoder)
    for name in sample.outputs:
        changed = {**sample.outputs, name: np.zeros((1, 5, 11, 2, 2))}

        with pytest.raises(ValueError, match=r"expected|boxes|masks|prototypes"):
            output.candidates(changed, SIZE)
