"""Small TFLite networks with known outputs."""

import io
import zipfile
from collections.abc import Mapping
from importlib import import_module
from typing import Any

import flatbuffers
import numpy as np

from crosscue.detectors.decoders.base import Array


def constant_tflite(
    shape: tuple[int, ...],
    outputs: Mapping[str, Array],
    *,
    dtype: str = "float32",
    scales: Mapping[str, tuple[float, int]] | None = None,
    files: Mapping[str, str] | None = None,
) -> bytes:
    """A network that returns the same outputs for every input of a shape.

    Args:
        shape: Shape of the input.
        outputs: Outputs by name.
        dtype: Type of the input.
        scales: Scale and zero of quantised tensors by name; of the input as ``images``.
        files: Files of the ZIP archive with metadata that is appended.
    """
    schema: Any = import_module("ai_edge_litert.schema_py_generated")
    tensors, buffers = [], [schema.BufferT()]
    for name, values in {"images": None, **outputs}.items():
        sides, kind = (shape, dtype) if values is None else (values.shape, values.dtype.name)
        tensor = schema.TensorT([*sides], getattr(schema.TensorType, kind.upper()), name=name)
        if scales is not None and name in scales:
            scale, zero = scales[name]
            tensor.quantization = schema.QuantizationParametersT(scale=[scale], zeroPoint=[zero])
        if values is not None:
            tensor.buffer = len(buffers)
            buffers.append(schema.BufferT(np.frombuffer(values.tobytes(), np.uint8)))
        tensors.append(tensor)
    graph = schema.SubGraphT(tensors, [0], [*range(1, len(tensors))], [])
    build = flatbuffers.Builder(1024)
    build.Finish(schema.ModelT(3, [], [graph], None, buffers).Pack(build), b"TFL3")
    content = bytes(build.Output())
    if files is None:
        return content
    archive = io.BytesIO(content)
    with zipfile.ZipFile(archive, "a") as zipped:
        for name, text in files.items():
            zipped.writestr(name, text)
    return archive.getvalue()
