"""Small TFLite networks with known outputs."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Mapping
from typing import Any

import flatbuffers
import numpy as np

from crosscue.detectors.decoders.base import Array

# Numbers of the types in TFLite's schema.
_TYPES = {"float32": 0, "int32": 2, "uint8": 3, "int64": 4, "int8": 9}


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
    build = flatbuffers.Builder(1024)
    tensors, buffers = [], [_table(build, [])]
    for name, values in {"images": None, **outputs}.items():
        sides = shape if values is None else values.shape
        kind = dtype if values is None else values.dtype.name
        # Buffer 0 is empty: the input's.
        number = 0 if values is None else len(buffers)
        if values is not None:
            data = build.CreateNumpyVector(np.frombuffer(values.tobytes(), np.uint8))
            buffers.append(_table(build, [(0, "offset", data)]))
        fields: list[tuple[int, str, Any]] = [
            (0, "offset", build.CreateNumpyVector(np.array(sides, np.int32))),
            (1, "int8", _TYPES[kind]),
            (2, "uint32", number),
            (3, "offset", build.CreateString(name)),
        ]
        if scales is not None and name in scales:
            scale, zero = scales[name]
            scaled = build.CreateNumpyVector(np.array([scale], np.float32))
            zeros = build.CreateNumpyVector(np.array([zero], np.int64))
            fields.append(
                (4, "offset", _table(build, [(2, "offset", scaled), (3, "offset", zeros)]))
            )
        tensors.append(_table(build, fields))
    graph = [
        (0, "offset", _vector(build, tensors)),
        (1, "offset", build.CreateNumpyVector(np.array([0], np.int32))),
        (2, "offset", build.CreateNumpyVector(np.arange(1, len(tensors), dtype=np.int32))),
        (3, "offset", _vector(build, [])),
    ]
    parts = [_vector(build, []), _vector(build, [_table(build, graph)]), _vector(build, buffers)]
    model = [
        (0, "uint32", 3),
        (1, "offset", parts[0]),
        (2, "offset", parts[1]),
        (4, "offset", parts[2]),
    ]
    build.Finish(_table(build, model), file_identifier=b"TFL3")
    content = bytes(build.Output())
    if files is None:
        return content
    archive = io.BytesIO(content)
    with zipfile.ZipFile(archive, "a") as zipped:
        for name, text in files.items():
            zipped.writestr(name, text)
    return archive.getvalue()


def _table(build: Any, fields: list[tuple[int, str, Any]]) -> int:
    build.StartObject(max((number for number, _, _ in fields), default=-1) + 1)
    for number, kind, value in fields:
        if kind == "offset":
            build.PrependUOffsetTRelativeSlot(number, value, 0)
        elif kind == "int8":
            build.PrependInt8Slot(number, value, 0)
        else:
            build.PrependUint32Slot(number, value, 0)
    return int(build.EndObject())


def _vector(build: Any, offsets: list[int]) -> int:
    build.StartVector(4, len(offsets), 4)
    for offset in reversed(offsets):
        build.PrependUOffsetTRelative(offset)
    return int(build.EndVector())
