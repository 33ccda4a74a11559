"""Read the input size of an ONNX network, or make it variable."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

Size = tuple[int, int]


def _read(content: bytes) -> tuple[Any, list[Any]]:
    """Return the model, and its inputs that are not weights."""
    import onnx

    model: Any = onnx.load_model_from_string(content)
    weights = {tensor.name for tensor in model.graph.initializer}
    return model, [one for one in model.graph.input if one.name not in weights]


def input_shape(content: bytes) -> tuple[int | None, ...]:
    """Shape of the first input of an ONNX file; None for variable sizes.

    OpenCV runs a network on other sizes, too, and returns meaningless numbers.
    """
    given = _read(content)[1][0]
    return tuple(side.dim_value or None for side in given.type.tensor_type.shape.dim)


def free_size(content: bytes) -> bytes:
    """Return an ONNX file whose input accepts pictures of any size."""
    model, given = _read(content)
    for value in given:
        for dimension in value.type.tensor_type.shape.dim[1:]:
            if dimension.dim_value != 3:
                dimension.ClearField("value")
    for value in model.graph.output:
        for dimension in value.type.tensor_type.shape.dim:
            dimension.ClearField("value")
    # Shapes between layers are only hints, and no longer correct.
    del model.graph.value_info[:]
    freed: bytes = model.SerializeToString()
    return freed


def replace_size(shape: Sequence[int], size_px: Size) -> list[int]:
    """Replace width and height in an input's shape (1, 3, h, w) or (1, h, w, 3)."""
    width, height = size_px
    return [shape[0], 3, height, width] if shape[1] == 3 else [shape[0], height, width, 3]
