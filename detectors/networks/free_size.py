"""Make the input size of an ONNX network variable."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

Size = tuple[int, int]


def free_size(content: bytes) -> bytes:
    """Return an ONNX file whose input accepts pictures of any size."""
    import onnx

    model: Any = onnx.load_model_from_string(content)
    weights = {tensor.name for tensor in model.graph.initializer}
    given = [one for one in model.graph.input if one.name not in weights]
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
