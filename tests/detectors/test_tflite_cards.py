"""Cards are drafted from TFLite files: layout, names, types and quantised numbers are read."""

from collections.abc import Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import crosscue
from crosscue.detectors.base import Detections, Frame, RoadMask
from crosscue.detectors.catalog.card import read_card
from crosscue.detectors.catalog.draft import draft_card_text
from crosscue.detectors.catalog.recognise import _suppressed_classes, guesses
from crosscue.detectors.decoders.base import Array, Interface, Size, Tensor, cell_count, cell_grid
from crosscue.detectors.networks.backends import _random_operation, load_network, missing_operation
from crosscue.detectors.networks.model_detector import build
from crosscue.detectors.networks.weights import Weights
from support.data import shared
from support.decoder_samples import BOX, CLASSES, SIZE, TALL, export
from support.decoder_samples import EVERY as FAMILIES
from support.tflite_models import constant_tflite

pytest.importorskip("ai_edge_litert")
SIZES = pytest.mark.parametrize("size", [SIZE, TALL], ids=["wide", "tall"])
JSON = {"metadata.json": '{"names": {"0": "person", "1": "car", "2": "stop sign"}, "nms": false}'}
NAMES = {"temp_meta.txt": "{'names': {0: 'person', 1: 'car', 2: 'stop sign'}, 'task': 'detect'}"}


def found_in(card: Path, size: Size) -> Detections:
    """Detections in a black picture of this size."""
    width, height = size
    (found,) = build(card=str(card))(
        [Frame(0, "", np.zeros((height, width, 3), np.uint8), (width, height))]
    )
    assert isinstance(found, Detections)
    return found


def tflite(folder: Path, size: Size, outputs: Mapping[str, Array], **more: Any) -> Path:
    """Write a network for pictures of this size, with the same outputs for each."""
    net = folder / "net.tflite"
    net.write_bytes(constant_tflite((1, size[1], size[0], 3), outputs, **more))
    return net


def yolov8(folder: Path) -> Path:
    """Write an ONNX file without class names."""
    net = folder / "net.onnx"
    net.write_bytes(export(FAMILIES["yolov8"](SIZE)))
    return net


def columns(size: Size) -> NDArray[np.float32]:
    """Ultralytics' TFLite output: boxes in fractions around all cells, one of them known."""
    corner, stride = cell_grid(size, (8, 16, 32))
    table = np.hstack(
        [(corner + 0.5) * stride, stride * [2.0, 2.0], np.full((len(corner), 3), 0.01)]
    )
    table[3] = [*(BOX[:2] + BOX[2:]) / 2, *(BOX[2:] - BOX[:2]), 0.1, 0.2, 0.75]
    table[:, :4] /= np.tile(size, 2)
    return table.T[None].astype(np.float32)


@pytest.mark.parametrize("files", [NAMES, JSON], ids=["text", "JSON"])
@SIZES
def test_boxes_in_fractions_are_exact(tmp_path: Path, size: Size, files: dict[str, str]) -> None:
    card = crosscue.draft_card(
        tflite(tmp_path, size, {"Identity": columns(size)}, files=files)
    ).path

    output = read_card(card).output
    assert (output.kind, output.classes) == ("yolov8", CLASSES)
    found = found_in(card, size)
    np.testing.assert_allclose(found.boxes_px, [BOX], atol=1e-3)
    assert found.labels == ("stop sign",)


@SIZES
def test_suppressed_boxes_in_fractions_are_exact(tmp_path: Path, size: Size) -> None:
    """Ultralytics' YOLO26 as TFLite: the rows of its ONNX file, in fractions."""
    rows = np.zeros((1, 300, 6), np.float32)
    rows[0, :, :4] = np.array([0.1, 0.2, 0.3, 0.6])
    rows[0, 0] = [*BOX / np.tile(size, 2), 0.75, 2.0]

    card = crosscue.draft_card(tflite(tmp_path, size, {"Identity": rows}, files=NAMES)).path

    assert read_card(card).output.kind == "end-to-end"
    found = found_in(card, size)
    np.testing.assert_allclose(found.boxes_px, [BOX], atol=1e-3)
    assert found.labels == ("stop sign",)


def test_boxes_in_pixels_are_exact(tmp_path: Path) -> None:
    table = columns(SIZE)
    table[0, :4] *= np.tile(SIZE, 2)[:, None]
    net = tflite(tmp_path, SIZE, {"Identity": table}, files=NAMES)

    card = crosscue.draft_card(net, kind="yolov8").path

    np.testing.assert_allclose(found_in(card, SIZE).boxes_px, [BOX], atol=1e-3)


def test_quantised_numbers_are_read(tmp_path: Path) -> None:
    """Input and output are int8, as in Ultralytics' exports with int8."""
    values = np.clip(np.rint(columns(SIZE) * 256.0) - 128, -128, 127).astype(np.int8)
    scales = {"images": (1 / 255, -128), "Identity": (1 / 256, -128)}
    net = tflite(tmp_path, SIZE, {"Identity": values}, dtype="int8", scales=scales, files=NAMES)

    card = crosscue.draft_card(net).path

    found = found_in(card, SIZE)
    np.testing.assert_allclose(found.boxes_px, [BOX], atol=3.0)
    np.testing.assert_allclose(found.scores, [0.75])


@pytest.mark.parametrize(
    "names",
    [
        ["TFLite_Detection_PostProcess", "", ":1", ":2", ":3"],
        ["StatefulPartitionedCall", ":3", ":2", ":1", ":0"],
    ],
    ids=["TF 1", "TF 2"],
)
@SIZES
def test_suppressed_boxes_are_exact(tmp_path: Path, names: list[str], size: Size) -> None:
    x0, y0, x1, y1 = BOX / np.tile(size, 2)
    numbers: list[Any] = [
        [[[y0, x0, y1, x1], [0.0] * 4]], [[2.0, 0.0]], [[0.75, 0.0]], [1.0],
    ]  # fmt: skip
    outputs = {
        names[0] + end: np.array(values, np.float32)
        for end, values in zip(names[1:], numbers, strict=True)
    }
    files = {"labelmap.txt": "a\nb\nstop sign\n"}

    card = crosscue.draft_card(tflite(tmp_path, size, outputs, dtype="uint8", files=files)).path

    found = found_in(card, size)
    np.testing.assert_allclose(found.boxes_px, [BOX], atol=1e-3)
    assert found.labels == ("stop sign",)
    assert read_card(card).input.dtype == "uint8"


@pytest.mark.parametrize("is_numbers", [True, False])
def test_road_is_read(tmp_path: Path, *, is_numbers: bool) -> None:
    numbers = np.zeros((1, 32, 64), np.int64)
    numbers[:, 16:] = 1
    scores = np.eye(2, dtype=np.float32)[numbers]
    outputs = {"ArgMax": numbers} if is_numbers else {"scores": scores}
    net = tflite(tmp_path, (128, 64), outputs, dtype="uint8")

    card = crosscue.draft_card(net, classes="background,road").path

    (found,) = build(card=str(card))([Frame(0, "", np.zeros((64, 128, 3), np.uint8), (128, 64))])
    assert isinstance(found, RoadMask)
    np.testing.assert_array_equal(found.pixels()[:, 0], np.arange(32) >= 16)
    assert read_card(card).output.kind == "segmentation"


def test_published_network_is_drafted(tmp_path: Path) -> None:
    folder = shared("weights/deeplab_cityscapes_slim")
    net = tmp_path / "net.tflite"
    net.write_bytes(next(folder.glob("*.tflite")).read_bytes())

    drafted = crosscue.draft_card(net, class_names=folder / "cityscapes_segmentation_labels.txt")

    assert drafted.draft.kind == "segmentation"
    assert read_card(drafted.path).input.dtype == "uint8"


@pytest.mark.parametrize("content", [b"", b"TFL3" * 9, b"\x1c\x00\x00\x00TFL3" + bytes(90)])
def test_damaged_file_is_refused_in_one_line(tmp_path: Path, content: bytes) -> None:
    net = tmp_path / "net.tflite"
    net.write_bytes(content)

    with pytest.raises(crosscue.UsageError, match=r"^[^\n]*net.tflite: not a complete model file"):
        crosscue.draft_card(net)


@pytest.mark.parametrize(("first", "label"), [(None, "car"), (1, "car"), (0, "stop sign")])
def test_first_class_is_as_given(tmp_path: Path, first: int | None, label: str) -> None:
    """Networks of Open Model Zoo count their classes from 0 or from 1, and no file says it."""
    net = tmp_path / "net.onnx"
    sample = FAMILIES["ssd"](SIZE)
    sample.outputs["detection_out"][0, 0, 0, 1] = 2
    net.write_bytes(export(sample))

    card = crosscue.draft_card(net, class_names=CLASSES, first_class=first).path

    assert found_in(card, SIZE).labels == (label,)


@pytest.mark.parametrize(
    "text", ["names: [person, car, stop sign]", "names: {0: person, 1: car, 2: stop sign}"]
)
def test_class_names_are_read_from_a_data_set_file(tmp_path: Path, text: str) -> None:
    (tmp_path / "data.yaml").write_text(f"path: ..\n{text}\n")

    card = crosscue.draft_card(yolov8(tmp_path), class_names=tmp_path / "data.yaml").path

    assert read_card(card).output.classes == CLASSES


def test_options_that_say_nothing_of_a_network_are_refused(tmp_path: Path) -> None:
    net, data = yolov8(tmp_path), tmp_path / "data.yaml"
    data.write_text("path: ..\n")

    with pytest.raises(crosscue.UsageError, match=r"data.yaml: expected class names under names"):
        crosscue.draft_card(net, class_names=data)
    with pytest.raises(crosscue.UsageError, match=r"first_class: 0, .*not yolov8"):
        crosscue.draft_card(net, class_names=CLASSES, first_class=0)


def test_number_of_classes_is_that_of_the_suppression() -> None:
    """The operation is given a column for each class and one for the background."""
    scores = {"index": 7, "shape": np.array([1, 1917, 6])}
    operation = {"op_name": "TFLite_Detection_PostProcess", "inputs": [3, 7, 9]}
    net = SimpleNamespace(
        _get_ops_details=lambda: [{"op_name": "CONV_2D", "inputs": [1, 2]}, operation],
        get_tensor_details=lambda: [{"index": 3, "shape": np.array([1, 1917, 4])}, scores],
    )

    assert _suppressed_classes(net) == 5
    net._get_ops_details = list
    assert _suppressed_classes(net) is None


def test_suppressed_network_of_other_classes_asks_for_their_names(tmp_path: Path) -> None:
    numbers = {"": (1, 9, 4), ":1": (1, 9), ":2": (1, 9), ":3": (1,)}
    outputs = tuple(
        Tensor(f"TFLite_Detection_PostProcess{end}", shape) for end, shape in numbers.items()
    )
    given = Tensor("image", (1, 224, 224, 3), is_bytes=True)
    model = Interface((given,), outputs, {}, class_count=5)
    (guess,) = guesses(model)
    net = tmp_path / "net.tflite"
    net.write_bytes(b"")

    with pytest.raises(crosscue.UsageError, match="5 classes without names"):
        draft_card_text(net, model, guess)


@SIZES
def test_masks_with_channels_last_are_exact(tmp_path: Path, size: Size) -> None:
    """Ultralytics' segmentation networks in TFLite have prototypes (1, h, w, 32)."""
    width, height = size
    table = columns(size)
    # Noise may have a box or two beyond the picture.
    table[0, :4, 9] = [1.5, 1.5, 2.0, 2.0]
    weights = np.zeros((1, 32, table.shape[2]), np.float32)
    weights[0, 7, 3] = 1.0
    prototypes = np.full((1, height // 4, width // 4, 32), -9.0, np.float32)
    # The upper half of the box.
    prototypes[0, 10:22, 25:55, 7] = 9.0
    outputs = {"Identity": np.concatenate([table, weights], axis=1), "Identity_1": prototypes}
    files = {"temp_meta.txt": NAMES["temp_meta.txt"].replace("detect", "segment")}

    drafted = crosscue.draft_card(tflite(tmp_path, size, outputs, files=files))

    assert drafted.draft.kind == "yolov8-seg"
    found = found_in(drafted.path, size)
    np.testing.assert_allclose(found.boxes_px, [BOX], atol=1e-3)
    assert found.mask(0)[60, 160]
    assert not found.mask(0)[120, 160]


@pytest.mark.parametrize(
    ("scale", "zero", "darkest"),
    [(1 / 127.5, -1, -1.0), (1 / 255, -128, 0.0), (1.0, -128, 0.0), (4.0, -100, 0.0)],
)
def test_quantised_input_says_how_pixels_are_scaled(
    tmp_path: Path, scale: float, zero: int, darkest: float
) -> None:
    """A YOLOX export in int8 has pixels from 0 to 255, or what it was calibrated with."""
    rows = np.zeros((1, cell_count(SIZE, (8, 16, 32)), 8), np.float32)
    scales = {"images": (scale, zero)}
    net = tflite(tmp_path, SIZE, {"Identity": rows}, dtype="int8", scales=scales)

    drafted = crosscue.draft_card(net, kind="yolox", class_names=CLASSES)

    given = read_card(drafted.path).input
    (low, high) = ((np.array([0.0, 255.0]) - given.mean[0]) * given.scale[0]).tolist()
    brightest = darkest + 255.0 * min(scale, 1.0)
    np.testing.assert_allclose((low, high), (darkest, brightest), atol=1.01 * scale)
    is_usual = scale >= 1.0
    assert any("its input is quantised for" in why for why in drafted.draft.certain) != is_usual


@pytest.mark.parametrize("kind", [np.int8, np.float32])
def test_network_with_int8_numbers_runs_without_xnnpack(kind: type[np.number[Any]]) -> None:
    """In Ultralytics' segmentation in int8, it returned NaN for 1,000 numbers in some processes."""
    rows = np.zeros((1, 6, 50), kind)
    content = constant_tflite((1, 64, 64, 3), {"rows": rows}, scales={"rows": (0.1, 0)})

    network = load_network(Weights(name="net.tflite", content=content))

    assert network.backend.endswith(" without XNNPACK") == (kind is np.int8)
    assert not network(np.zeros((1, 64, 64, 3), np.float32))["rows"].any()


@pytest.mark.parametrize(
    ("operation", "kinds", "scales", "is_sound"),
    [
        ("DEPTHWISE_CONV_2D", (np.float32, np.int8, np.float32), 1, False),
        ("DEPTHWISE_CONV_2D", (np.float32, np.int8, np.float32), 128, True),
        ("DEPTHWISE_CONV_2D", (np.int8, np.int8, np.int32), 1, True),
        ("DEPTHWISE_CONV_2D", (np.float32, np.float32, np.float32), 0, True),
        ("CONV_2D", (np.float32, np.int8, np.float32), 1, True),
    ],
)
def test_operation_with_results_at_random_is_refused(
    operation: str, kinds: tuple[type[np.number[Any]], ...], scales: int, is_sound: bool
) -> None:
    """Two segmentations with one scale for all channels had other boxes in each process."""
    quantised = {"scales": np.ones(scales)}
    net = SimpleNamespace(
        _get_ops_details=lambda: [{"op_name": operation, "inputs": np.array([4, 5, -1, 6])}],
        get_tensor_details=lambda: [
            {"index": index, "dtype": kind, "quantization_parameters": quantised}
            for index, kind in zip((4, 5, 6), kinds, strict=True)
        ],
    )

    assert (_random_operation(net) is None) == is_sound


def test_operations_of_tensorflow_are_named() -> None:
    error = RuntimeError("Select TensorFlow op(s), included in the given model, is(are) not")

    assert "operation Flex, of TensorFlow itself, is unknown" in (missing_operation(error) or "")
