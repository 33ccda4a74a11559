"""Load neural networks from bytes into a back end.

ONNX runs in ONNX Runtime or OpenVINO, OpenVINO IR in OpenVINO, TFLite in LiteRT. Weights are bytes
of a verified hash and never refer to another file.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from pathlib import PurePath
from typing import Any, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from crosscue.detectors.decoders.base import (
    PADDLE_SCALE_INPUT,
    PADDLE_SIZE_INPUT,
    PICTURE_SIZE_INPUT,
)
from crosscue.replay.errors import VehicleError, one_line
from crosscue.replay.versions import installed

from .openvino import import_openvino
from .weights import Weights

Size = tuple[int, int]


def free_size(content: bytes) -> bytes:
    """Return an ONNX file whose input accepts pictures of any size."""
    import onnx

    model: Any = onnx.load_model_from_string(content)
    weights = {tensor.name for tensor in model.graph.initializer}
    for value in model.graph.input:
        for dimension in () if value.name in weights else value.type.tensor_type.shape.dim[1:]:
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


Array = NDArray[np.generic]
# Errors of ONNX Runtime and of LiteRT where an operation is unknown.
_LACKING: Final = re.compile(
    r"([\w.:]+)\(-?\d+\) is not a registered|custom op: ([\w.-]+\w)|(Select TensorFlow op)"
    r"|No Op registered for (\w+)"
)
# Encoded protobuf key of a tensor that is stored in another file.
_EXTERNAL: Final = b"\x0a\x08location"


class Network(Protocol):
    """A network ready to run."""

    @property
    def backend(self) -> str:
        """Name and version of the back end."""
        ...

    def __call__(self, batch: Array, /) -> Mapping[str, Array]:
        """Return all outputs by name."""
        ...


@dataclass(frozen=True, slots=True)
class _Function:
    """A back end's network, wrapped as a function."""

    backend: str
    call: Callable[[Array], Mapping[str, Array]]

    def __call__(self, batch: Array, /) -> Mapping[str, Array]:
        return self.call(batch)


def load_network(
    weights: Weights,
    backend: str | None = None,
    threads: int = 1,
    size_px: tuple[int, int] | None = None,
) -> Network:
    """Load weights into a back end.

    Args:
        weights: Verified weights.
        backend: ``onnxruntime``, ``openvino``, ``litert``; None for the preferred one.
        threads: Maximum number of threads, where the back end supports a limit.
        size_px: Width and height of the input instead of those that the file declares, for
            networks that allow it.

    Raises:
        VehicleError: No installed back end reads the weights, or they are damaged.
    """
    suffix = PurePath(weights.name).suffix.lower()
    able = BACKENDS.get(suffix)
    if able is None:
        raise VehicleError(
            f"{weights.name}: unsupported kind of weights; expected {sorted(BACKENDS)}"
        )
    if suffix == ".onnx" and _EXTERNAL in weights.content:
        raise VehicleError(
            f"{weights.name}: stores tensors in other files, which no hash covers; save it as one "
            "file, torch.onnx.export with external_data=False"
        )
    if backend is not None and backend not in able:
        raise VehicleError(f"{weights.name}: {backend} does not run it; one of: {', '.join(able)}")
    name = backend or able[0]
    module, project = _EXTRAS.get(name, (name, name))
    if find_spec(module) is None:
        raise VehicleError(
            f"{weights.name}: runs in {name}, but {project} is not installed: pip install {project}"
        )
    try:
        return _LOADERS[name](weights, threads, size_px)
    except VehicleError:
        raise
    except Exception as error:
        why = missing_operation(error) or f"{one_line(error, 200)}; is it complete?"
        raise VehicleError(f"{weights.name}: {name} cannot read it: {why}") from None


def missing_operation(error: Exception) -> str | None:
    """Name the operation that a back end does not know; None if its error is another."""
    found = _LACKING.search(str(error))
    name = found and (found[1] or found[2] or found[4] or "Flex, of TensorFlow itself,")
    return found and f"the operation {name} is unknown; export it without that"


def _in_onnxruntime(weights: Weights, threads: int, size_px: Size | None) -> Network:
    ort: Any = import_module("onnxruntime")

    options = ort.SessionOptions()
    options.intra_op_num_threads = threads
    options.log_severity_level = 4
    content = weights.content if size_px is None else free_size(weights.content)
    session = ort.InferenceSession(content, options, providers=_ort_providers(ort))
    inputs = [one.name for one in session.get_inputs()]
    # Paddle's exporter sorts the inputs by name.
    picture = next((one.name for one in session.get_inputs() if len(one.shape) > 2), inputs[0])
    names = [out.name for out in session.get_outputs()]

    def call(batch: Array) -> Mapping[str, Array]:
        # Boxes are in pixels of the batch, as in every other layout.
        sizes = np.array([batch.shape[-2:]] * len(batch))
        others: dict[str, Array] = {
            PICTURE_SIZE_INPUT: sizes[:, ::-1].astype(np.int64),
            PADDLE_SIZE_INPUT: sizes.astype(np.float32),
            PADDLE_SCALE_INPUT: np.ones(sizes.shape, np.float32),
        }
        feed = {picture: batch} | {name: others[name] for name in inputs if name in others}
        return dict(zip(names, session.run(names, feed), strict=True))

    return _Function(f"onnxruntime {ort.__version__} {session.get_providers()[0]}", call)


def _ort_providers(ort: Any) -> list[str]:
    wanted = ("CUDAExecutionProvider", "CPUExecutionProvider")
    return [name for name in wanted if name in ort.get_available_providers()]


def _in_openvino(weights: Weights, threads: int, size_px: Size | None) -> Network:
    ov = import_openvino()
    core = ov.Core()
    core.set_property("CPU", {"INFERENCE_NUM_THREADS": threads})
    # Performance hints may select half precision, but results must not depend on the processor.
    core.set_property("CPU", {"INFERENCE_PRECISION_HINT": "f32"})
    model = core.read_model(weights.content, weights.second)
    if size_px is not None:
        model.reshape(
            replace_size([side.get_length() for side in model.input(0).partial_shape], size_px)
        )
    compiled = core.compile_model(model, "CPU")
    names = [output_name(out, i) for i, out in enumerate(compiled.outputs)]

    def call(batch: Array) -> Mapping[str, Array]:
        found = compiled([batch])
        return {name: np.asarray(found[i]) for i, name in enumerate(names)}

    return _Function(f"openvino {ov.__version__}", call)


def _in_litert(weights: Weights, threads: int, size_px: Size | None) -> Network:
    litert: Any = import_module("ai_edge_litert.interpreter")
    given: dict[str, Any] = {"model_content": weights.content, "num_threads": threads}
    net, backend = litert.Interpreter(**given), f"litert {installed('ai-edge-litert')}"
    kinds = {one["dtype"] for one in net.get_tensor_details()}
    if net.get_input_details()[0]["dtype"] == np.float32 and np.int8 in kinds:
        # With weights in int8, XNNPACK (LiteRT 2.3) reads memory that nobody has written.
        plain = litert.OpResolverType.BUILTIN_WITHOUT_DEFAULT_DELEGATES
        net = litert.Interpreter(**given, experimental_op_resolver_type=plain)
        backend += " without XNNPACK"
    if (unsound := _random_operation(net)) is not None:
        raise VehicleError(
            f"{weights.name}: LiteRT reads the scales of {unsound}, whose int8 weights have one "
            "for all channels, from memory that nobody has written; convert it to float16, or to "
            "int8 by channel"
        )
    if size_px is not None:
        first = net.get_input_details()[0]
        net.resize_tensor_input(first["index"], replace_size(first["shape"].tolist(), size_px))
    net.allocate_tensors()
    image, outputs = net.get_input_details()[0], net.get_output_details()

    def call(batch: Array) -> Mapping[str, Array]:
        net.set_tensor(image["index"], _quantised(batch, image))
        net.invoke()
        return {str(out["name"]): _real(net.get_tensor(out["index"]), out) for out in outputs}

    return _Function(backend, call)


def _random_operation(net: Any) -> str | None:
    """Name an operation whose results in LiteRT 2.3 differ from process to process, if any."""
    tensors = {one["index"]: one for one in net.get_tensor_details()}
    for operation in net._get_ops_details():
        if operation["op_name"] == "DEPTHWISE_CONV_2D":
            picture, weights = (tensors[index] for index in operation["inputs"][:2])
            scales = weights["quantization_parameters"]["scales"]
            # It reads a scale for each channel, also where all channels have one.
            if (picture["dtype"], weights["dtype"], len(scales)) == (np.float32, np.int8, 1):
                return str(operation["op_name"])
    return None


def _quantised(batch: Array, given: Any) -> Array:
    """Convert real numbers to the integers of a quantised input; bytes remain as they are."""
    (scale, zero), kind = given["quantization"], np.dtype(given["dtype"])
    if kind.kind not in "iu" or batch.dtype == kind or not scale:
        return batch
    limits = np.iinfo(kind)
    steps: Array = np.rint(np.asarray(batch, np.float64) / scale) + zero
    return np.asarray(np.clip(steps, limits.min, limits.max), kind)


def _real(values: Array, out: Any) -> Array:
    """Convert the integers of a quantised output to real numbers."""
    scale, zero = out["quantization"]
    if values.dtype.kind not in "iu" or not scale:
        return np.asarray(values)
    return np.asarray((np.asarray(values, np.float64) - zero) * scale)


def output_name(output: Any, index: int) -> str:
    """Name of an output of OpenVINO, or its number, where it has none."""
    names = sorted(output.get_names())
    return str(names[0]) if names else f"output{index}"


# Back ends by suffix of the weights, the preferred one first.
BACKENDS: Final[Mapping[str, tuple[str, ...]]] = {
    ".onnx": ("onnxruntime", "openvino"),
    ".xml": ("openvino",),
    ".tflite": ("litert",),
}
# Module of a back end with another name, and the project that installs it.
_EXTRAS: Final = {"litert": ("ai_edge_litert", "ai-edge-litert")}
_LOADERS: Final[Mapping[str, Callable[[Weights, int, Size | None], Network]]] = {
    "onnxruntime": _in_onnxruntime,
    "openvino": _in_openvino,
    "litert": _in_litert,
}
