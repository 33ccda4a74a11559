"""``crosscue model init`` from files of each layout, made here, to a card that runs."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import onnx
import pytest

from crosscue.detectors.catalog.card import read_card
from crosscue.detectors.catalog.recognise import class_names
from crosscue.eval.cli import run
from support.data import shared
from support.onnx_models import Array, bright_box_model, constant_model

ULTRALYTICS = {"names": "{0: 'person', 1: 'car', 2: 'stop-sign'}", "imgsz": "[64, 128]"}


def _rows(*shape: int) -> Array:
    return np.zeros(shape, np.float32)


LAYOUTS: dict[str, tuple[tuple[int, ...], Mapping[str, Array], bool]] = {
    "yolov8": ((1, 3, 64, 128), {"output0": _rows(1, 7, 168)}, True),
    "yolov5": ((1, 3, 64, 128), {"output0": _rows(1, 504, 8)}, True),
    "yolov8-seg": (
        (1, 3, 64, 128),
        {"output0": _rows(1, 39, 168), "output1": _rows(1, 32, 16, 32)},
        True,
    ),
    "end-to-end": ((1, 3, 64, 128), {"output0": _rows(1, 300, 6)}, True),
    "detr": ((1, 3, 64, 128), {"dets": _rows(1, 50, 4), "labels": _rows(1, 50, 3)}, True),
    "torchvision": (
        (3, 64, 128),
        {"boxes": _rows(2, 4), "labels": np.ones(2, np.int64), "scores": _rows(2)},
        True,
    ),
    "ssd": ((1, 3, 64, 128), {"detection_out": -np.ones((1, 1, 9, 7), np.float32)}, True),
    "ssd-tensorflow": (
        (1, 64, 128, 3),
        {
            "detection_boxes": _rows(1, 9, 4),
            "detection_classes": _rows(1, 9) + 1,
            "detection_scores": _rows(1, 9),
        },
        True,
    ),
}


def _file(folder: Path, kind: str, metadata: Mapping[str, str]) -> Path:
    shape, outputs, _ = LAYOUTS[kind]
    model = onnx.load_model_from_string(constant_model(shape, outputs))
    if kind == "ssd-tensorflow":
        model.graph.input[0].type.tensor_type.elem_type = onnx.TensorProto.UINT8
    for key, value in metadata.items():
        entry = model.metadata_props.add()
        entry.key, entry.value = key, value
    path = folder / "my.onnx"
    path.write_bytes(model.SerializeToString())
    return path


@pytest.mark.parametrize("kind", LAYOUTS)
def test_a_fresh_export_gets_a_card_that_runs(
    tmp_path: Path, kind: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path = _file(tmp_path, kind, ULTRALYTICS)

    assert run(["model", "init", str(path)]) == 0

    said = capsys.readouterr().out
    assert f"my.toml: {kind}; the network runs with it" in said
    card = read_card(tmp_path / "my.toml")
    assert card.output.kind == kind
    assert card.output.classes == ("person", "car", "stop-sign")
    assert card.meaning(2) == "stop sign"
    assert (card.input.width_px, card.input.height_px) == (128, 64)
    assert run(["model", "check", str(tmp_path / "my.toml")]) == 0


def test_what_the_file_does_not_say_is_assumed_aloud(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = _file(tmp_path, "detr", {})
    names = tmp_path / "names.txt"
    names.write_text("person\ncar\nstop sign\n", encoding="utf-8")

    assert run(["model", "init", str(path)]) == 2
    assert "3 classes and no names in the file" in capsys.readouterr().err
    assert run(["model", "init", str(path), "--class-names", str(names)]) == 0

    said = capsys.readouterr().out
    assert "assumed    logits become scores by the logistic function" in said
    text = (tmp_path / "my.toml").read_text(encoding="utf-8")
    assert "# Assumed, please check: logits become scores" in text


def test_sizes_that_a_file_leaves_open_are_found_by_running_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model = onnx.load_model_from_string(bright_box_model())
    model.graph.output[0].type.tensor_type.shape.dim[2].dim_param = "columns"
    path = tmp_path / "my.onnx"
    path.write_bytes(model.SerializeToString())
    names = tmp_path / "names.txt"
    names.write_text("bright\n", encoding="utf-8")

    args = ["--class-names", str(names), "--size", "96x64"]
    assert run(["model", "init", str(path), *args]) == 0

    assert "my.toml: end-to-end" in capsys.readouterr().out
    card = read_card(tmp_path / "my.toml")
    assert (card.input.width_px, card.input.height_px) == (96, 64)


def test_several_layouts_are_listed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """One row a cell, all zero: YOLOX's offsets, or boxes without size."""
    model = constant_model((1, 3, 64, 128), {"output": _rows(1, 168, 85)})
    path = tmp_path / "my.onnx"
    path.write_bytes(model)

    assert run(["model", "init", str(path)]) == 2

    said = capsys.readouterr().err
    assert "may be yolox (" in said
    assert "; yolov5 (" in said
    assert "choose one with --kind" in said
    assert run(["model", "init", str(path), "--kind", "yolox"]) == 0


def test_the_real_yolox_is_reported_from_its_twin_by_running_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "yolox.onnx"
    path.write_bytes(shared("weights", "yolox_nano", "yolox_nano.onnx").read_bytes())
    picture = tmp_path / "street.jpg"
    picture.write_bytes(
        shared("sequences", "pandaset_002", "camera", "front_camera", "00.jpg").read_bytes()
    )

    args = ["--size", "1280x736", "--picture", str(picture)]
    assert run(["model", "init", str(path), *args]) == 0

    assert "yolox; the network runs with it" in capsys.readouterr().out
    assert (tmp_path / "street.found.jpg").stat().st_size > 10_000


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("my.onnx", b"not a model", "not a whole model file"),
        ("my.pkl", b"", "a pickle runs code when it is read"),
        ("my.torchscript", b"", "a TorchScript archive carries code"),
        ("my.bin", b"", "expected .onnx, .xml, or weights"),
    ],
)
def test_what_is_no_model_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str, content: bytes, said: str
) -> None:
    path = tmp_path / name
    path.write_bytes(content)

    assert run(["model", "init", str(path)]) == 2

    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1
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
def test_class_names_are_read_and_never_run(text: str, names: tuple[str, ...]) -> None:
    assert class_names({"names": text}) == names
