"""A network does not run on another input size than its file declares, in any back end."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from onnx import TensorProto, helper

from crosscue.detectors.catalog.recognise import read_interface
from crosscue.detectors.networks.backends import load_network
from crosscue.detectors.networks.model_detector import build
from crosscue.detectors.networks.weights import Weights
from crosscue.replay.errors import UsageError, VehicleError
from support.detecting import yolox_card


@pytest.mark.parametrize("backend", ["opencv", "onnxruntime"])
def test_card_of_another_size_than_its_network_is_refused(backend: str, tmp_path: Path) -> None:
    card = yolox_card(tmp_path, width_px="640")

    with pytest.raises(VehicleError, match="the network does not run on input 640 x 416"):
        build(card=str(card), backend=backend)


def test_without_onnx_network_of_its_own_size_only_runs_in_onnxruntime(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = helper.make_tensor_value_info("x", TensorProto.FLOAT, [1, 3, 8, 8])
    end = helper.make_tensor_value_info("y", TensorProto.FLOAT, [1, 3, 8, 8])
    graph = helper.make_graph([helper.make_node("Relu", ["x"], ["y"])], "relu", [place], [end])
    made = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    weights = Weights(name="net.onnx", content=made.SerializeToString())
    assert load_network(weights, size_px=(16, 12)).backend.startswith("onnxruntime")

    monkeypatch.setitem(sys.modules, "onnx", None)

    assert load_network(weights).backend.startswith("onnxruntime")
    wide = load_network(weights, size_px=(16, 12))
    assert wide.backend.startswith("opencv")
    picture = np.ones((1, 3, 12, 16), np.float32)
    assert np.array_equal(wide(picture)["y"], picture)
    with pytest.raises(VehicleError, match=r"onnx is not installed: pip install onnx$"):
        load_network(weights, "onnxruntime", size_px=(16, 12))
    (tmp_path / "net.onnx").write_bytes(weights.content)
    with pytest.raises(UsageError, match="needs the package onnx: pip install onnx"):
        read_interface(tmp_path / "net.onnx")
