"""Small ONNX networks with known outputs."""

import hashlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import onnx
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


def bright_box_model(*, by_brightness: bool = False) -> bytes:
    """A network that returns one box around all pixels above 127, shape (N, 1, 6), with class 0.

    The input has shape (N, 3, H, W) of any size. The score is 1 if any pixel is bright and 0
    otherwise; with ``by_brightness`` it is the value of the brightest pixel divided by 255.
    """
    scored = [helper.make_node("ReduceMax", ["columns"], ["score"], axes=[1], keepdims=1)]
    if by_brightness:
        scored = [
            helper.make_node("ReduceMax", ["grey"], ["brightest"], axes=[1], keepdims=0),
            helper.make_node("ReduceMax", ["brightest"], ["most"], axes=[1], keepdims=1),
            helper.make_node("Constant", [], ["each"], value=_scalar(1.0 / 255.0)),
            helper.make_node("Mul", ["most", "each"], ["score"]),
        ]
    nodes = [
        helper.make_node("Constant", [], ["half"], value=_scalar(127.0)),
        helper.make_node("ReduceMax", ["images"], ["grey"], axes=[1], keepdims=0),
        helper.make_node("Greater", ["grey", "half"], ["bright"]),
        helper.make_node("Cast", ["bright"], ["light"], to=TensorProto.FLOAT),
        helper.make_node("ReduceMax", ["light"], ["columns"], axes=[1], keepdims=0),
        helper.make_node("ReduceMax", ["light"], ["rows"], axes=[2], keepdims=0),
        *scored,
    ]
    ends = []
    for name in ("columns", "rows"):
        for last in (0, 1):
            end = f"{name}{last}"
            nodes.append(
                helper.make_node(
                    "ArgMax", [name], [f"{end}_index"], axis=1, keepdims=1, select_last_index=last
                )
            )
            nodes.append(
                helper.make_node("Cast", [f"{end}_index"], [f"{end}_raw"], to=TensorProto.FLOAT)
            )
            nodes.append(
                helper.make_node("Constant", [], [f"{end}_plus"], value=_scalar(float(last)))
            )
            nodes.append(helper.make_node("Add", [f"{end}_raw", f"{end}_plus"], [end]))
            ends.append(end)
    nodes += [
        helper.make_node("Constant", [], ["zero"], value=_scalar(0.0)),
        helper.make_node("Mul", ["score", "zero"], ["class"]),
        helper.make_node(
            "Concat", [ends[0], ends[2], ends[1], ends[3], "score", "class"], ["row"], axis=1
        ),
        helper.make_node("Constant", [], ["axis"], value=numpy_helper.from_array(np.array([1]))),
        helper.make_node("Unsqueeze", ["row", "axis"], ["boxes"]),
    ]
    given = helper.make_tensor_value_info("images", TensorProto.FLOAT, ["n", 3, "h", "w"])
    out = helper.make_tensor_value_info("boxes", TensorProto.FLOAT, ["n", 1, 6])
    return _file(helper.make_graph(nodes, "bright box", [given], [out]))


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


def _scalar(value: float) -> TensorProto:
    return numpy_helper.from_array(np.array(value, np.float32))


def _file(graph: onnx.GraphProto, metadata: Mapping[str, str] | None = None) -> bytes:
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=8)
    helper.set_model_props(model, dict(metadata or {}))
    onnx.checker.check_model(model)
    content: bytes = model.SerializeToString()
    return content
