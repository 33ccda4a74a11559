"""The input shape of an ONNX file, read from hand-made bytes and from real files."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crosscue.detectors.networks.model_detector import build
from crosscue.detectors.networks.onnx_input import input_shape
from crosscue.replay.base import VehicleError
from support.data import shared
from support.detecting import yolox_card


def varint(value: int) -> bytes:
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*out, value])


def part(number: int, content: bytes) -> bytes:
    return varint(number << 3 | 2) + varint(len(content)) + content


def number(field: int, value: int) -> bytes:
    return varint(field << 3) + varint(value)


def value_info(name: bytes, sizes: list[int | None]) -> bytes:
    dimensions = [part(1, part(2, b"n") if size is None else number(1, size)) for size in sizes]
    tensor = number(1, 1) + part(2, b"".join(dimensions))
    return part(1, name) + part(2, part(1, tensor))


def model(*inputs: bytes, weights: tuple[bytes, ...] = ()) -> bytes:
    tensors = [part(5, part(8, name) + part(9, b"\0" * 300)) for name in weights]
    graph = b"".join([*tensors, *(part(11, one) for one in inputs)])
    return number(1, 8) + part(2, b"maker") + part(7, graph)


def test_the_first_input_that_is_no_weight_is_reported_with_what_is_left_open() -> None:
    content = model(value_info(b"w", [9]), value_info(b"x", [None, 3, 360, 640]), weights=(b"w",))

    assert input_shape(content) == (None, 3, 360, 640)
    assert input_shape(model()) is None
    assert input_shape(b"") is None


@given(st.binary(max_size=60), st.integers(0, 400))
@settings(max_examples=100, deadline=None)
def test_damage_ends_in_an_error_or_a_shape_never_in_a_hang(noise: bytes, cut: int) -> None:
    for content in (noise, model(value_info(b"x", [1, 3, 8, 8]), weights=(b"w",))[:cut] + noise):
        try:
            found = input_shape(content)
        except ValueError:
            continue
        assert found is None or all(size is None or size > 0 for size in found)


def test_a_real_file_reports_its_shape() -> None:
    path = shared("weights", "yolox_nano", "yolox_nano.onnx")

    assert input_shape(path.read_bytes()) == (1, 3, 416, 416)


@pytest.mark.parametrize("backend", ["opencv", "onnxruntime"])
def test_a_card_of_another_size_than_its_network_is_refused(backend: str, tmp_path: Path) -> None:
    card = yolox_card(tmp_path, width_px="640")

    with pytest.raises(VehicleError, match="the network does not run on input 640 x 416"):
        build(card=str(card), backend=backend)
