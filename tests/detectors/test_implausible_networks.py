"""A network whose boxes cannot be right gets no card, and an existing card fails its check."""

from __future__ import annotations

import hashlib
from pathlib import Path

import cv2
import numpy as np
import onnx
import pytest
from numpy.typing import NDArray

import crosscue
from crosscue.detectors.catalog.cards import check_card
from crosscue.detectors.catalog.recognise import guesses, read_interface
from crosscue.eval import cli
from crosscue.replay.errors import VehicleError
from support.onnx_models import bright_box_model, constant_model

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


def card(folder: Path, model: bytes, output: str) -> Path:
    """Write ``net.onnx`` and a card for it, and return the card."""
    (folder / "net.onnx").write_bytes(model)
    text = f'version = 1\nweights = "net.onnx"\nsha256 = "{hashlib.sha256(model).hexdigest()}"\n'
    text += f"[input]\nwidth_px = 256\nheight_px = 128\n[output]\n{output}\n"
    path = folder / "net.toml"
    path.write_text(text)
    return path


def names(folder: Path) -> Path:
    """Write a file of two class names."""
    path = folder / "names.txt"
    path.write_text("dog\ncat\n")
    return path


@pytest.mark.parametrize("seen", GARBAGE)
def test_card_is_refused_with_what_was_seen(tmp_path: Path, seen: str) -> None:
    net = tmp_path / "net.onnx"
    net.write_bytes(constant_model(SHAPE, {"rows": GARBAGE[seen]}))

    with pytest.raises(VehicleError, match=f"net.toml: not written: on noise, .*{seen}"):
        crosscue.draft_card(net, kind="end-to-end", class_names=names(tmp_path))

    assert sorted(one.name for one in tmp_path.iterdir()) == ["names.txt", "net.onnx"]


@pytest.mark.parametrize("seen", GARBAGE)
def test_check_refuses_the_card(tmp_path: Path, seen: str) -> None:
    model = constant_model(SHAPE, {"rows": GARBAGE[seen]})

    with pytest.raises(VehicleError, match=f"net.toml: on noise, .*{seen}"):
        check_card(card(tmp_path, model, END_TO_END))


def test_sensible_boxes_pass(tmp_path: Path) -> None:
    model = constant_model(SHAPE, {"rows": rows()})

    found = check_card(card(tmp_path, model, END_TO_END))

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
        check_card(card(tmp_path, model, output))


def blue_box_model() -> bytes:
    """The network that finds a bright box, in the first channel only."""
    model = onnx.load_model_from_string(bright_box_model())
    graph = model.graph
    graph.initializer.append(onnx.numpy_helper.from_array(np.array([0]), "first"))
    grey = next(node for node in graph.node if "images" in node.input)
    grey.input[0] = "blue"
    graph.node.insert(0, onnx.helper.make_node("Gather", ["images", "first"], ["blue"], axis=1))
    return bytes(model.SerializeToString())


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
    model = blue_box_model() if key == "colour" else bright_box_model()
    path = card(tmp_path, model, END_TO_END)
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
    path = card(tmp_path, model.SerializeToString(), END_TO_END)

    doubt = check_card(path, street).doubt

    assert doubt is not None
    assert "boxes with scores up to 1.00 above 0.3 in the picture" in doubt
    assert "with scale = 1/255, pixels from 0 to 1" in doubt
