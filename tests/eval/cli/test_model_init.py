"""``crosscue model init`` writes a card that runs, for generated files of each layout."""

from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest

import crosscue
from crosscue.detectors.catalog.card import read_card
from crosscue.detectors.catalog.cards import check_card
from crosscue.detectors.catalog.recognise import class_names
from crosscue.detectors.decoders.detr import DetrOutput
from crosscue.detectors.decoders.torchvision_export import TorchvisionOutput
from crosscue.detectors.networks.backends import load_network
from crosscue.detectors.networks.openvino import import_openvino
from crosscue.detectors.networks.weights import Weights
from crosscue.eval.cli import run
from support.commands import output_of
from support.decoder_samples import CLASSES, SAMPLES, SIZE, export
from support.onnx_models import Array, bright_box_model, constant_model
from support.pictures import picture
from support.refusals import refusal

ULTRALYTICS = {"names": str(dict(enumerate(CLASSES))), "imgsz": str([SIZE[1], SIZE[0]])}
LAYOUTS = (
    "yolov8",
    "yolov5",
    "yolov8-seg",
    "end-to-end",
    "detr",
    "torchvision",
    "ssd",
    "ssd-tensorflow",
)


def _zeros(*shape: int) -> Array:
    return np.zeros(shape, np.float32)


def _write_export(folder: Path, kind: str, metadata: Mapping[str, str]) -> Path:
    (folder / "my.onnx").write_bytes(export(SAMPLES[kind](), metadata=metadata))
    return folder / "my.onnx"


METADATA = "task: detect\nimgsz:\n- 64\n- 128\nnames:\n  0: person\n  1: car\n  2: stop sign\n"


def _openvino_file(folder: Path, labels: list[str] | None = None) -> Path:
    """A YOLOv8 network as an OpenVINO file, with labels in the place that Ultralytics uses."""
    if find_spec("openvino") is None:
        pytest.skip("the extra openvino is not installed")
    ov = import_openvino()
    op: Any = ov.opset13
    given = op.parameter((1, 3, 64, 128), np.float32, name="images")
    zero = op.multiply(op.reduce_max(given, op.constant([0, 1, 2, 3])), np.float32(0.0))
    rows = op.add(op.constant(_zeros(1, 7, 168)), zero)
    rows.output(0).set_names({"output0"})
    model = ov.Model([rows], [given])
    if labels is not None:
        model.set_rt_info(labels, ["model_info", "labels"])
    path = folder / "my.xml"
    ov.serialize(model, path)
    return path


@pytest.mark.parametrize(
    ("metadata", "labels", "classes"),
    [
        (METADATA, None, ("person", "car", "stop sign")),
        ("rosbag2_bagfile_information: {}\n", ["cat", "stop_sign", "dog"], None),
        (None, ["cat", "stop_sign", "dog"], None),
    ],
)
def test_class_names_of_openvino_file_are_read(
    tmp_path: Path, metadata: str | None, labels: list[str] | None, classes: tuple[str, ...] | None
) -> None:
    path = _openvino_file(tmp_path, labels)
    if metadata is not None:
        (tmp_path / "metadata.yaml").write_text(metadata)

    crosscue.draft_card(path)

    card = read_card(tmp_path / "my.toml")
    assert card.input.decode == "full"
    assert card.output.classes == (classes or tuple(labels or ()))
    assert "stop sign" in map(card.meaning, range(3))


@pytest.mark.parametrize(
    ("names", "columns", "activation", "is_normalised"),
    [
        (("logits", "pred_boxes"), 80, "sigmoid", False),
        (("logits", "pred_boxes"), 92, "softmax", True),
        (("labels", "dets"), 91, "sigmoid", True),
        (("logits", "pred_boxes"), 91, "sigmoid", True),
    ],
    ids=("RT-DETR", "DETR", "RF-DETR", "Deformable DETR"),
)
def test_detr_variants_are_distinguished(
    tmp_path: Path, names: tuple[str, str], columns: int, activation: str, is_normalised: bool
) -> None:
    path = tmp_path / "my.onnx"
    outputs = {names[0]: _zeros(1, 50, columns), names[1]: _zeros(1, 50, 4)}
    path.write_bytes(constant_model((1, 3, 64, 128), outputs))

    crosscue.draft_card(path)

    card = read_card(tmp_path / "my.toml")
    assert isinstance(card.output, DetrOutput)
    assert card.output.activation == activation
    assert (card.input.mean != (0.0, 0.0, 0.0)) == is_normalised
    number = card.output.classes.index("stop sign") + card.output.first_class
    assert number == (11 if columns == 80 else 13)


@pytest.mark.parametrize(
    ("shape", "said"),
    [((2, 3, 64, 128), "runs on 2 pictures at once"), ((1, 1, 64, 128), "input 1x1x64x128: exp")],
)
def test_network_for_other_inputs_than_one_coloured_picture_is_refused(
    tmp_path: Path, shape: tuple[int, ...], said: str
) -> None:
    path = tmp_path / "my.onnx"
    path.write_bytes(constant_model(shape, {"output0": _zeros(2, 300, 6)}))

    with pytest.raises(crosscue.UsageError, match=rf"my\.onnx: {said}"):
        crosscue.draft_card(path, class_names=["a"])


def test_card_of_a_link_is_beside_the_link(tmp_path: Path) -> None:
    """A cache of downloads names its files by their hash, and links to them."""
    (tmp_path / "blobs").mkdir()
    blob, path = tmp_path / "blobs" / "0f3a", tmp_path / "my.onnx"
    blob.write_bytes(constant_model((1, 3, 64, 128), {"output0": _zeros(1, 300, 6)}))
    path.symlink_to(blob)

    drafted = crosscue.draft_card(path, class_names=["a"], kind="end-to-end")

    assert drafted.path == tmp_path / "my.toml"
    assert read_card(drafted.path).weights == "my.onnx"


def test_operation_that_no_back_end_knows_is_named(tmp_path: Path) -> None:
    path = tmp_path / "my.onnx"
    model = onnx.load_model_from_string(constant_model((1, 3, 64, 128), {"rows": _zeros(1, 9, 6)}))
    model.opset_import.append(onnx.helper.make_opsetid("TRT", 1))
    plugin = onnx.helper.make_node("EfficientNMS_TRT", ["rows"], ["more"], domain="TRT")
    model.graph.node.append(plugin)
    path.write_bytes(model.SerializeToString())

    said = r"the operation TRT:EfficientNMS_TRT is unknown; export it without that"
    with pytest.raises(crosscue.errors.VehicleError, match=said):
        crosscue.draft_card(path, class_names=["a"], kind="end-to-end")


def test_class_names_tell_detr_with_a_column_for_no_object(tmp_path: Path) -> None:
    """DETR and YOLOS of Transformers have one column more than classes, RT-DETR has not."""
    path = tmp_path / "my.onnx"
    outputs = {"logits": _zeros(1, 50, 4), "pred_boxes": _zeros(1, 50, 4)}
    path.write_bytes(constant_model((1, 3, 64, 128), outputs))

    found = []
    for names in (["a", "b", "c"], ["a", "b", "c", "d"]):
        card = read_card(crosscue.draft_card(path, class_names=names, overwrite=True).path)
        assert isinstance(card.output, DetrOutput)
        found.append((card.output.activation, card.input.mean != (0.0, 0.0, 0.0)))

    assert found == [("softmax", True), ("sigmoid", False)]


def test_network_with_size_input_receives_the_picture_size(tmp_path: Path) -> None:
    """RT-DETR's own exporter adds an input of width and height, by which it scales boxes."""
    tensors = {"labels": np.array([[11]]), "scores": np.array([[0.9]], np.float32)}
    model = onnx.load_model_from_string(constant_model((1, 3, 64, 128), tensors))
    graph, helper = model.graph, onnx.helper
    given = helper.make_tensor_value_info("orig_target_sizes", onnx.TensorProto.INT64, [1, 2])
    graph.input.append(given)
    unit = np.array([[[0.25, 0.5, 0.5, 1.0]]], np.float32)
    graph.initializer.append(onnx.numpy_helper.from_array(unit, "unit"))
    graph.node.extend(
        [
            helper.make_node("Cast", ["orig_target_sizes"], ["size"], to=onnx.TensorProto.FLOAT),
            helper.make_node("Concat", ["size", "size"], ["sides"], axis=1),
            helper.make_node("Mul", ["unit", "sides"], ["boxes"]),
        ]
    )
    graph.output.append(
        helper.make_tensor_value_info("boxes", onnx.TensorProto.FLOAT, [1, None, 4])
    )
    path, street = tmp_path / "my.onnx", tmp_path / "street.jpg"
    path.write_bytes(model.SerializeToString())
    street.write_bytes(picture(0, ".jpg"))

    drafted = crosscue.draft_card(path)
    checked = check_card(drafted.path, street)

    assert checked.found == {"stop sign": 1}
    output = read_card(drafted.path).output
    assert isinstance(output, TorchvisionOutput)
    network = load_network(Weights(name=str(path), content=path.read_bytes()))
    outputs = network(np.zeros((1, 3, 64, 128), np.float32))
    np.testing.assert_allclose(
        output.candidates(outputs, (128, 64)).boxes_px, [[32.0, 32.0, 64.0, 64.0]]
    )


def test_check_picture_is_not_written_to_an_image_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The folder is a log, and every image in it is a frame."""
    log, home = tmp_path / "log", tmp_path / "home"
    for folder in (log, home):
        folder.mkdir()
    (log / "00.jpg").write_bytes(picture(0, ".jpg"))
    (home / "net.onnx").write_bytes(bright_box_model())
    monkeypatch.chdir(home)

    crosscue.draft_card("net.onnx", class_names=["a"], size_px=(96, 64), picture=log / "00.jpg")
    checked = check_card("net.toml", log / "00.jpg")

    assert checked.picture == Path("net.00.found.jpg")
    assert [path.name for path in log.iterdir()] == ["00.jpg"]
    assert sorted(path.name for path in home.iterdir()) == [
        "net.00.found.jpg",
        "net.onnx",
        "net.toml",
    ]


@pytest.mark.parametrize("kind", LAYOUTS)
def test_export_of_each_layout_gets_a_working_card(tmp_path: Path, kind: str) -> None:
    path = _write_export(tmp_path, kind, ULTRALYTICS)

    message = output_of("model", "init", path)
    assert f"my.toml: {kind}; the network runs with it" in message
    card = read_card(tmp_path / "my.toml")
    assert card.output.kind == kind
    assert card.output.classes == CLASSES
    assert (card.input.width_px, card.input.height_px) == SIZE
    assert run(["check", str(tmp_path / "my.toml")]) == 0


def test_assumptions_are_reported_and_written_to_the_card(tmp_path: Path) -> None:
    path = _write_export(tmp_path, "detr", {})
    names = tmp_path / "names.txt"
    names.write_text("person\ncar\nstop sign\n", encoding="utf-8")

    assert "3 classes without names" in refusal(2, "model", "init", path)
    message = output_of("model", "init", path, "--class-names", names)
    assert "assumed    logits become scores by the logistic function" in message
    text = (tmp_path / "my.toml").read_text(encoding="utf-8")
    assert "# Assumed, please check: logits become scores" in text


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("my.onnx", b"not a model", "not a complete model file"),
        ("my.pkl", b"", "a pickle runs code when it is read"),
        ("my.torchscript", b"", "a TorchScript archive carries code"),
        ("my.bin", b"", "expected .onnx, .xml, .tflite, or weights"),
    ],
)
def test_unsupported_model_file_is_refused_in_one_line(
    tmp_path: Path, name: str, content: bytes, message: str
) -> None:
    path = tmp_path / name
    path.write_bytes(content)

    assert message in refusal(2, "model", "init", path)
    assert not list(tmp_path.glob("*.toml"))
    assert not list(tmp_path.glob(".*.toml"))


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("{0: 'a', 1: 'b'}", ("a", "b")),
        ("['a', 'b']", ("a", "b")),
        ("{0: 'a', 2: 'b'}", ()),
        ("__import__('os').getcwd()", ()),
        ("[" * 5000, ()),
        ("", ()),
    ],
)
def test_class_names_are_parsed_without_execution(text: str, names: tuple[str, ...]) -> None:
    assert class_names({"names": text}) == names
