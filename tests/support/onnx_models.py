"""Small ONNX networks with known outputs."""

import hashlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import onnx
import onnx.parser
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

Array = NDArray[np.generic]
OPSET = 17


def constant_model(
    shape: tuple[int, ...],
    outputs: Mapping[str, Array],
    inputs: Mapping[str, tuple[int, ...]] | None = None,
    *,
    is_bytes: bool = False,
    metadata: Mapping[str, str] | None = None,
) -> bytes:
    """A network that returns the same outputs for every input of a shape.

    Args:
        shape: Shape of the input named images.
        outputs: Outputs by name.
        inputs: Shapes of all inputs by name, instead.
        is_bytes: True for inputs of bytes.
        metadata: What the exporter noted, such as names of classes.
    """
    nodes = [
        helper.make_node("Constant", [], [name], value=numpy_helper.from_array(values))
        for name, values in outputs.items()
    ]
    declared = [
        helper.make_tensor_value_info(
            name, helper.np_dtype_to_tensor_dtype(values.dtype), values.shape
        )
        for name, values in outputs.items()
    ]
    kind = TensorProto.UINT8 if is_bytes else TensorProto.FLOAT
    given = [
        helper.make_tensor_value_info(name, kind, sides)
        for name, sides in (inputs or {"images": shape}).items()
    ]
    return _file(helper.make_graph(nodes, "constant", given, declared), metadata)


def open_model(
    shape: tuple[int | str, ...], metadata: Mapping[str, str], *, is_bytes: bool = False
) -> bytes:
    """A network with input ``shape`` and an output whose length is known only when it runs."""
    value = numpy_helper.from_array(np.zeros((1, 84, 100), np.float32))
    node = helper.make_node("Constant", [], ["output0"], value=value)
    kind = TensorProto.UINT8 if is_bytes else TensorProto.FLOAT
    given = helper.make_tensor_value_info("images", kind, shape)
    found = helper.make_tensor_value_info("output0", TensorProto.FLOAT, (1, 84, "boxes"))
    return _file(helper.make_graph([node], "open", [given], [found]), metadata)


BRIGHT_BOX = """<ir_version: 8, opset_import: ["" : 17]>
bright_box (float[n, 3, h, w] images) => (float[n, 1, 6] boxes) {{
  first = Constant <value_ints = [0]> ()
  blue = Gather <axis = 1> (images, first)
  grey = ReduceMax <axes = [1], keepdims = 0> ({channels})
  limit = Constant <value_float = {above}> ()
  bright = Greater (grey, limit)
  light = Cast <to = 1> (bright)
  columns = ReduceMax <axes = [1], keepdims = 0> (light)
  rows = ReduceMax <axes = [2], keepdims = 0> (light)
  x0 = ArgMax <axis = 1, select_last_index = 0> (columns)
  y0 = ArgMax <axis = 1, select_last_index = 0> (rows)
  x1 = ArgMax <axis = 1, select_last_index = 1> (columns)
  y1 = ArgMax <axis = 1, select_last_index = 1> (rows)
  pixels = Concat <axis = 1> (x0, y0, x1, y1)
  first_to_last = Cast <to = 1> (pixels)
  inclusive = Constant <value_floats = [0.0, 0.0, 1.0, 1.0]> ()
  corners = Add (first_to_last, inclusive)
  any = ReduceMax <axes = [1], keepdims = 1> (columns)
  brightest = ReduceMax <axes = [1, 2], keepdims = 0> (grey)
  one = Constant <value_ints = [1]> ()
  most = Unsqueeze (brightest, one)
  each = Constant <value_float = 0.003921569> ()
  share = Mul (most, each)
  zero = Constant <value_float = 0.0> ()
  class = Mul (any, zero)
  row = Concat <axis = 1> (corners, {score}, class)
  boxes = Unsqueeze (row, one)
}}"""


def bright_box_model(
    *, score: str = "any", channels: str = "images", above: float = 127.0
) -> bytes:
    """A network that returns one box around all bright pixels, shape (N, 1, 6), with class 0.

    The input has shape (N, 3, H, W) of any size.

    Args:
        score: ``any`` for 1 if any pixel is bright and 0 otherwise; ``share`` for the value of the
            brightest pixel divided by 255.
        channels: ``images`` for all channels, ``blue`` for the first one only.
        above: Values of bright pixels are higher.
    """
    text = BRIGHT_BOX.format(score=score, channels=channels, above=above)
    model = onnx.parser.parse_model(text)
    onnx.checker.check_model(model)
    return bytes(model.SerializeToString())


def write_card(
    folder: Path, model: bytes, output: str, size: tuple[int, int] = (64, 48), more: str = ""
) -> Path:
    """Write a network and its card; ``output`` and ``more`` are lines of output and input."""
    (folder / "net.onnx").write_bytes(model)
    path = folder / "net.toml"
    path.write_text(
        f'version = 1\nweights = "net.onnx"\nsha256 = "{hashlib.sha256(model).hexdigest()}"\n'
        f"[input]\nwidth_px = {size[0]}\nheight_px = {size[1]}\n{more}\n[output]\n{output}\n"
    )
    return path


def _file(graph: onnx.GraphProto, metadata: Mapping[str, str] | None = None) -> bytes:
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=8)
    helper.set_model_props(model, dict(metadata or {}))
    onnx.checker.check_model(model)
    content: bytes = model.SerializeToString()
    return content
