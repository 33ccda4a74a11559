"""Read the input shape that an ONNX file declares, without the package onnx.

It is needed because OpenCV runs a network on unsupported sizes and returns meaningless numbers.
Field numbers are those of ONNX's public ``onnx.proto``; all other fields are skipped.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final, TypeAlias

Field: TypeAlias = tuple[int, int | memoryview]
_GRAPH, _INITIALIZER, _INITIALIZER_NAME, _INPUT = 7, 5, 8, 11
_NAME, _TYPE, _TENSOR, _SHAPE, _DIMENSION, _VALUE = 1, 2, 1, 2, 1, 1
# Number of bytes of the wire types with a fixed length.
_FIXED: Final = {1: 8, 5: 4}


def input_shape(content: bytes) -> tuple[int | None, ...] | None:
    """Shape of the first input that is not a weight; None for variable sizes and if undeclared.

    Raises:
        ValueError: The bytes are not protobuf.
    """
    for graph in _parts(memoryview(content), _GRAPH):
        weights = {
            bytes(name)
            for tensor in _parts(graph, _INITIALIZER)
            for name in _parts(tensor, _INITIALIZER_NAME)
        }
        for given in _parts(graph, _INPUT):
            if not any(bytes(name) in weights for name in _parts(given, _NAME)):
                return _shape(given)
    return None


def _shape(given: memoryview) -> tuple[int | None, ...] | None:
    for kind in _parts(given, _TYPE):
        for tensor in _parts(kind, _TENSOR):
            for shape in _parts(tensor, _SHAPE):
                return tuple(_size(one) for one in _parts(shape, _DIMENSION))
    return None


def _size(dimension: memoryview) -> int | None:
    sizes = [v for number, v in _fields(dimension) if number == _VALUE and isinstance(v, int)]
    return sizes[0] if sizes and sizes[0] > 0 else None


def _parts(message: memoryview, number: int) -> Iterator[memoryview]:
    for found, value in _fields(message):
        if found == number and isinstance(value, memoryview):
            yield value


def _fields(message: memoryview) -> Iterator[Field]:
    at = 0
    while at < len(message):
        key, at = _varint(message, at)
        number, wire = key >> 3, key & 7
        if wire == 0:
            value, at = _varint(message, at)
            yield number, value
            continue
        if wire == 2:
            size, at = _varint(message, at)
        elif wire in _FIXED:
            size = _FIXED[wire]
        else:
            raise ValueError(f"wire type {wire} at byte {at}: not protobuf")
        if at + size > len(message):
            raise ValueError(f"field {number} at byte {at} is truncated")
        yield number, message[at : at + size]
        at += size


def _varint(message: memoryview, at: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        if at >= len(message) or shift > 63:
            raise ValueError(f"number at byte {at} is truncated")
        byte = message[at]
        value |= (byte & 0x7F) << shift
        at, shift = at + 1, shift + 7
        if byte < 0x80:
            return value, at
