"""Read the interface that a model file declares, and infer the layout of its output."""

import ast
import io
import math
import re
import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import replace
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final

import numpy as np

from crosscue.detectors.decoders.base import (
    DEFAULT_SCORE,
    GRID_STRIDES,
    IMAGENET,
    IMAGENET_BGR,
    Guess,
    Interface,
    Tensor,
    cell_count,
    decoder_name,
    static,
)
from crosscue.detectors.decoders.plausible import oddity
from crosscue.detectors.decoders.table import DECODERS
from crosscue.detectors.networks.backends import (
    Network,
    load_network,
    missing_operation,
    output_name,
)
from crosscue.detectors.networks.openvino import import_openvino
from crosscue.detectors.networks.trial import candidates_in
from crosscue.detectors.networks.weights import Weights
from crosscue.replay.errors import UsageError, one_line
from crosscue.replay.files.bounded import read_whole
from crosscue.replay.files.tree_text import yaml_tree

from .architectures import WEIGHTS_SUFFIXES
from .card import MAX_BYTES, Input, model_bytes
from .segmentation import recognise_segmentation

# Maximum number of brackets in metadata; parsing more is slow.
_MAX_NAMES_CHARACTERS: Final = 100_000
# Maximum number of files behind a TFLite file to read.
_MAX_APPENDED: Final = 8
# Default side of a network's input, where the file declares no size.
DEFAULT_SIDE_PX: Final = 640
# Maximum number of values of one input: the largest picture that a card may specify.
MAX_INPUT_VALUES: Final = 3 * 8192 * 8192
# Number of classes to assume where the shapes do not determine it.
_MANY_CLASSES: Final = 10_000
# ONNX's numbers of int32 and int64, and of uint8.
_ONNX_INTEGERS: Final = frozenset((6, 7))
_ONNX_BYTE: Final = 2
# Minimum spread of candidates, as a fraction of the input's sides. If the layout is correct, the
# candidates of all cells are spread over the whole picture.
SPREAD_FRACTION: Final = 0.5
# Version of an OpenVINO file, at its beginning, and the oldest one that is still read.
_OPENVINO_VERSION: Final = re.compile(rb'<net [^>]*\bversion="(\d{1,3})"')
_OPENVINO_OLDEST: Final = 10
_MAX_HEAD: Final = 1000
# Path of the class names in an OpenVINO file, with underscores for spaces.
_LABELS: Final = ["model_info", "labels"]
# Task of a segmentation in LibreYOLO's metadata.
SEMANTIC: Final = "semantic"
_UNIT: Final = {"colour": "rgb", "mean": (0.0,) * 3, "scale": (1 / 255,) * 3}
_LETTERBOX: Final = {**_UNIT, "fit": "letterbox", "pad": 114}
_DARKNET: Final = {**_LETTERBOX, "pad": 128}
_STRETCHED: Final = {"colour": "rgb", **IMAGENET, "fit": "stretch"}
_FAMILIES: Final[Mapping[str, Mapping[str, object]]] = {
    "yolo2": _DARKNET,
    "yolo3": _DARKNET,
    "yolo4": _DARKNET,
    "yolo7": _LETTERBOX,
    "yolo9": _LETTERBOX,
    "yolo9_e2e": _LETTERBOX,
    "pidnet": _LETTERBOX,
    "rtmdet": {**IMAGENET_BGR, "fit": "letterbox", "pad": 114},
    "efficientdet": {**_STRETCHED, "fit": "letterbox", "pad": 114},
    "picodet": _STRETCHED,
    "ppyoloe": _STRETCHED,
    "detr": _STRETCHED,
    "lwdetr": _STRETCHED,
    "ssd": {**_UNIT, "mean": (123.0, 117.0, 104.0), "scale": (1.0,) * 3, "fit": "stretch"},
}
_REFUSED: Final = {
    ".pkl": "a pickle runs code when it is read; export it to ONNX",
    ".torchscript": "a TorchScript archive carries code; export it to ONNX",
}


def read_interface(path: Path) -> Interface:
    """Read inputs, outputs and metadata of an ONNX file, an OpenVINO .xml or a TFLite file.

    Raises:
        UsageError: The file is of another kind or damaged, or the package to read it is missing.
    """
    suffix = path.suffix.lower()
    if suffix in _REFUSED:
        raise UsageError(f"{path}: {_REFUSED[suffix]}")
    if suffix not in _READERS:
        raise UsageError(
            f"{path}: expected {', '.join(_READERS)}, or weights of a torchvision network: "
            f"{', '.join(WEIGHTS_SUFFIXES)}"
        )
    try:
        return _READERS[suffix](model_bytes(path), path)
    except UsageError:
        raise
    except Exception as error:
        why = missing_operation(error) or f"not a complete model file: {one_line(error, 160)}"
        raise UsageError(f"{path}: {why}") from None


def _of_onnx(content: bytes, path: Path) -> Interface:
    import onnx

    model: Any = onnx.load_model_from_string(content)
    weights = {tensor.name for tensor in model.graph.initializer}
    metadata = {prop.key: prop.value for prop in model.metadata_props}
    inputs = [_tensor(value) for value in model.graph.input if value.name not in weights]
    return Interface(
        # The picture first: Paddle's exporter sorts the inputs by name.
        tuple(sorted(inputs, key=lambda one: len(one.shape) < 3)),
        tuple(_tensor(value) for value in model.graph.output),
        metadata,
        class_names(metadata),
        _scored_classes(model),
    )


def _scored_classes(model: Any) -> int | None:
    """Number of classes whose scores an ONNX file suppresses; None if it does not, or hides it."""
    nodes = model.graph.node
    if not any(node.op_type in ("NonMaxSuppression", "EfficientNMS_TRT") for node in nodes):
        return None
    import onnx

    try:
        inferred = onnx.shape_inference.infer_shapes(model).graph
    except onnx.shape_inference.InferenceError:
        return None
    shapes = {value.name: _tensor(value).shape for value in inferred.value_info}
    found = set()
    for node in nodes:
        if node.op_type == "ArgMax":
            axis = next((one.i for one in node.attribute if one.name == "axis"), 0)
            found.add(static(shapes.get(node.input[0], ()), axis))
        elif node.op_type == "EfficientNMS_TRT":
            found |= {static(shapes.get(name, ()), 2) for name in node.input[1:2]}
    return found.pop() if len(found) == 1 else None


def _tensor(value: Any) -> Tensor:
    declared = value.type.tensor_type
    shape = tuple(side.dim_value or side.dim_param or None for side in declared.shape.dim)
    kind = declared.elem_type
    return Tensor(value.name, shape, kind in _ONNX_INTEGERS, kind == _ONNX_BYTE)


def _of_openvino(content: bytes, path: Path) -> Interface:
    if find_spec("openvino") is None:
        raise UsageError(f"{path}: needs the package openvino: pip install openvino")
    old = _OPENVINO_VERSION.search(content[:_MAX_HEAD])
    if old and int(old[1]) < _OPENVINO_OLDEST:
        raise UsageError(
            f"{path}: version {int(old[1])} of OpenVINO's format, which its releases no longer "
            "read; convert the network again"
        )
    ov = import_openvino()
    second = path.with_suffix(".bin")
    weights = read_whole(second, MAX_BYTES) if second.exists() else b""
    model = ov.Core().read_model(content, weights)

    def tensor(port: Any, index: int) -> Tensor:
        sides = (side.get_length() if side.is_static else None for side in port.partial_shape)
        is_integer = port.element_type.get_type_name() in ("i32", "i64")
        is_bytes = port.element_type.get_type_name() == "u8"
        return Tensor(output_name(port, index), tuple(sides), is_integer, is_bytes)

    # YOLOv5 calls the file as the model.
    beside = (path.with_name("metadata.yaml"), path.with_suffix(".yaml"))
    metadata = next(filter(None, map(_yaml_metadata, beside)), {})
    names = class_names(metadata)
    if not names and model.has_rt_info(_LABELS):
        names = tuple(model.get_rt_info(_LABELS).astype(str).split()[:_MANY_CLASSES])
    return Interface(
        tuple(tensor(port, i) for i, port in enumerate(model.inputs)),
        tuple(tensor(port, i) for i, port in enumerate(model.outputs)),
        metadata,
        names,
        *_detected_classes(model),
    )


def _detected_classes(model: Any) -> tuple[int | None, int | None]:
    """Number of classes that a suppression is given, and number of the first, if it says so."""
    for operation in model.get_ops():
        if operation.get_type_name() == "DetectionOutput":
            shapes = [operation.input(index).get_partial_shape() for index in (0, 1)]
            background = operation.get_attributes()["background_label_id"]
            if all(shape.is_static for shape in shapes):
                boxes, scores = (shape[1].get_length() for shape in shapes)
                return int(4 * scores // boxes) - 1, 0 if background else 1
    return None, None


def _of_tflite(content: bytes, path: Path) -> Interface:
    if find_spec("ai_edge_litert") is None:
        raise UsageError(f"{path}: needs the package ai-edge-litert: pip install ai-edge-litert")
    litert: Any = import_module("ai_edge_litert.interpreter")
    net = litert.Interpreter(model_content=content)
    net.allocate_tensors()

    def tensor(one: Any) -> Tensor:
        kind, (scale, zero) = np.dtype(one["dtype"]).name, one["quantization"]
        shape = tuple(map(int, one["shape"]))
        limits = ((-128 - zero) * scale, (127 - zero) * scale) if kind == "int8" and scale else None
        name, is_integer = str(one["name"]), kind in ("int32", "int64")
        return Tensor(name, shape, is_integer, kind == "uint8", limits)

    metadata, names = _appended(content)
    return Interface(
        tuple(map(tensor, net.get_input_details())),
        tuple(map(tensor, net.get_output_details())),
        metadata,
        class_names(metadata) or names,
        _suppressed_classes(net),
    )


def _suppressed_classes(net: Any) -> int | None:
    """Number of classes that TFLite_Detection_PostProcess is given, without the background."""
    for operation in net._get_ops_details():
        if operation["op_name"] == "TFLite_Detection_PostProcess":
            scores = operation["inputs"][1]
            shapes = (one["shape"] for one in net.get_tensor_details() if one["index"] == scores)
            return int(next(shapes)[-1]) - 1
    return None


def _appended(content: bytes) -> tuple[dict[str, str], tuple[str, ...]]:
    """Metadata of Ultralytics, and labels of TensorFlow, in the ZIP archive after a TFLite file."""
    metadata: dict[str, str] = {}
    names: tuple[str, ...] = ()
    if not zipfile.is_zipfile(io.BytesIO(content)):
        return metadata, names
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        for name in archive.namelist()[:_MAX_APPENDED]:
            with archive.open(name) as file:
                text = file.read(_MAX_NAMES_CHARACTERS).decode("utf-8", "replace")
            try:
                # JSON, or the text of a dictionary of Python: both are YAML.
                tree = yaml_tree(text)
            except ValueError:
                tree = None
            if isinstance(tree, dict):
                metadata |= {str(key): str(value) for key, value in tree.items()}
            elif name.endswith(".txt"):
                names = tuple(filter(None, map(str.strip, text.splitlines())))
    return metadata, names


def _yaml_metadata(path: Path) -> dict[str, str]:
    """Metadata that Ultralytics writes next to an OpenVINO file, in the form of ONNX metadata.

    The result is empty where the file is missing.

    Raises:
        UsageError: The file is damaged.
    """
    if not path.is_file():
        return {}
    try:
        content = read_whole(path, _MAX_NAMES_CHARACTERS)
        found = yaml_tree(content.decode("utf-8"))
    except (OSError, ValueError) as error:
        why = one_line(error, 160)
        raise UsageError(f"{path}: not readable as metadata: {why}; correct or remove it") from None
    if not isinstance(found, dict):
        return {}
    return {str(key): str(value) for key, value in found.items()}


_READERS: Final = {".onnx": _of_onnx, ".xml": _of_openvino, ".tflite": _of_tflite}


def class_names(metadata: Mapping[str, str]) -> tuple[str, ...]:
    """Class names that an exporter stored under ``names``, as Ultralytics does; else empty."""
    text = metadata.get("names", "")
    if not text or len(text) > _MAX_NAMES_CHARACTERS:
        return ()
    try:
        # Parses literals only; no code is run.
        found = ast.literal_eval(text)
    except (ValueError, SyntaxError, MemoryError, RecursionError):
        return ()
    if isinstance(found, dict):
        # JSON has texts for keys.
        found = [found.get(i, found.get(str(i))) for i in range(len(found))]
    if not isinstance(found, list | tuple) or not all(isinstance(name, str) for name in found):
        return ()
    return tuple(found)


def closed(path: Path, model: Interface, size_px: tuple[int, int] | None) -> Interface:
    """Fill in sizes that the file does not declare, by running the network once.

    Args:
        path: The model file.
        model: The interface that the file declares.
        size_px: Width and height of the input, where the file does not declare them.

    Raises:
        UsageError: The network does not run at that size, or the size exceeds the limit.
    """
    if all(isinstance(side, int) for out in model.outputs for side in out.shape):
        return model
    given = model.inputs[0]
    if len(given.shape) not in (3, 4):
        return model
    width, height = size_px or size_in(model.metadata) or (DEFAULT_SIDE_PX, DEFAULT_SIDE_PX)
    is_last = len(given.shape) == 4 and static(given.shape, 3) == 3
    wanted = (1, height, width, 3) if is_last else (1, 3, height, width)[-len(given.shape) :]
    shape = tuple(
        side if isinstance(side, int) else want
        for side, want in zip(given.shape, wanted, strict=True)
    )
    if math.prod(shape) > MAX_INPUT_VALUES:
        raise UsageError(
            f"{path}: input {'x'.join(map(str, shape))} is {math.prod(shape):,} numbers, the limit "
            f"is {MAX_INPUT_VALUES:,}; use another --size"
        )
    network = load_network(_weights(path))
    noise = np.random.default_rng(0).random(shape, np.float32)
    try:
        outputs = network(noise.astype(np.uint8) if given.is_bytes else noise)
    except Exception as error:
        raise UsageError(
            f"{path}: does not run on input {'x'.join(map(str, shape))}: {one_line(error, 160)}; "
            "use another --size"
        ) from None
    outs = (replace(out, shape=outputs[out.name].shape) for out in model.outputs)
    picture = replace(given, shape=shape)
    return replace(model, inputs=(picture, *model.inputs[1:]), outputs=tuple(outs))


def size_in(metadata: Mapping[str, str]) -> tuple[int, int] | None:
    """Width and height that an exporter stored as ``imgsz``, which has the height first."""
    try:
        height, width = ast.literal_eval(metadata.get("imgsz", "")[:100])
        return int(width), int(height)
    except (ValueError, SyntaxError, TypeError):
        return None


def _weights(path: Path) -> Weights:
    second = path.with_suffix(".bin")
    return Weights(
        name=str(path),
        content=path.read_bytes(),
        second=second.read_bytes() if path.suffix == ".xml" and second.exists() else b"",
    )


def plausible(path: Path, model: Interface, found: list[Guess]) -> list[Guess]:
    """Return the layouts that decode the network's output for noise to sensible boxes.

    If no layout does, all are returned.

    Raises:
        VehicleError: The network does not run.
    """
    network = load_network(_weights(path))
    kept = [guess for guess in found if _is_plausible(network, model, guess)]
    return kept or found


def _is_plausible(network: Network, model: Interface, guess: Guess) -> bool:
    width, height = model.declared_px
    if height is None or width is None:
        return True
    given = Input.model_validate(
        {"width_px": width, "height_px": height, **input_settings(model, guess)}
    )
    noise = np.random.default_rng(0).integers(0, 256, (height, width, 3), np.uint8)
    classes = tuple(str(i) for i in range(guess.class_count or _MANY_CLASSES))
    decoder = next(one for one in DECODERS if decoder_name(one) == guess.settings["kind"])
    output = decoder.model_validate({**guess.settings, "classes": classes})
    try:
        found, size = candidates_in(network, output, given, noise)
    except Exception:
        # The layout does not fit, or the network does not run: the trial of its card says why.
        return False
    if oddity(found, (width, height), DEFAULT_SCORE) is not None:
        return False
    cells = cell_count((width, height), GRID_STRIDES)
    if len(found) not in (cells, 3 * cells):
        return True
    centers = (found.boxes_px[:, 2:] + found.boxes_px[:, :2]) / 2.0
    low, high = np.percentile(centers, (5, 95), axis=0)
    return bool((high - low > SPREAD_FRACTION * np.array(size)).all())


def input_settings(model: Interface, guess: Guess) -> dict[str, object]:
    """Return keys of the card's ``[input]`` besides the size: of the layout, or as declared."""
    usual = {**(guess.input or {}), **_picture_of_family(model.metadata)}
    usual["layout"] = model.layout or usual.get("layout", "nchw")
    if model.inputs[0].is_bytes:
        # Such a network scales its pixels itself.
        usual = {key: value for key, value in usual.items() if key not in ("mean", "scale")}
        usual["dtype"] = "uint8"
    elif model.inputs[0].limits is not None:
        usual |= _quantised(usual, *model.inputs[0].limits)
    return usual


def _picture_of_family(metadata: Mapping[str, str]) -> Mapping[str, object]:
    """Keys of ``[input]`` with which LibreYOLO trains the family that its metadata name."""
    found = _FAMILIES.get(metadata.get("model_family", ""), {})
    pad = metadata.get("letterbox_pad")
    return {**found, "fit": "letterbox-center"} if found and pad == "center" else found


def _quantised(usual: Mapping[str, object], low: float, high: float) -> dict[str, object]:
    """Return mean and scale with which black is the lowest number and white the highest.

    Empty if those of the layout stay within these, or differ between colours.
    """
    keys = {key: value for key, value in usual.items() if key in ("mean", "scale")}
    given = Input.model_validate({"width_px": 1, "height_px": 1, **keys})
    black, white = -given.mean[0] * given.scale[0], (255.0 - given.mean[0]) * given.scale[0]
    step = (high - low) / 255.0
    if len({*given.mean}) > 1 or max(low - black, white - high) < 5.0 * step:
        return {}
    return {"mean": (-low / step,) * 3, "scale": (step,) * 3}


def guesses(model: Interface) -> list[Guess]:
    """List all layouts that a model file may have, in the order of the table."""
    if not model.inputs or not model.outputs:
        return []
    found = [guess for decoder in DECODERS if (guess := decoder.recognise(model)) is not None]
    # Exporters differ in how they store boxes; the boxes decide.
    found += [
        replace(one, settings={**one.settings, **keys}, assumptions=(*one.assumptions, *said))
        for one in found
        for keys, said in _ways_of_boxes(one, model)
    ]
    road = recognise_segmentation(model)
    # Integers are class numbers, never boxes.
    is_semantic = model.metadata.get("task") == SEMANTIC
    is_road = road is not None and (not found or is_semantic or model.outputs[0].is_integer)
    if is_semantic and road is None:
        return []
    return [road] if road is not None and is_road else found


_FRACTIONS: Final = ({"is_fraction": True}, ("boxes are in fractions of the input",))
_CORNERS: Final = ({"are_corners": True}, ("boxes are corners",))


def _ways_of_boxes(
    guess: Guess, model: Interface
) -> Iterator[tuple[dict[str, bool], tuple[str, ...]]]:
    """Other ways to store boxes in a layout: keys of ``[output]``, and what they assume."""
    kind = guess.settings["kind"]
    if kind in ("yolov5", "yolov8", "yolov8-seg", "end-to-end") and model.layout == "nhwc":
        # Ultralytics' TFLite exports.
        yield _FRACTIONS
    if kind == "yolov8" and "are_corners" not in guess.settings:
        # LibreYOLO's exports of YOLOv3, v9, SSD and others.
        yield _CORNERS
