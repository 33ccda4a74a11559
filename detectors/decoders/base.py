"""Base class of decoders, with the types of their inputs and results."""

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Final, Protocol, TypeAlias, get_args

import numpy as np
from numpy.typing import NDArray

from crosscue.detectors.settings import Proportion, Settings

Floats: TypeAlias = NDArray[np.float64]
Int64s: TypeAlias = NDArray[np.int64]

Array: TypeAlias = NDArray[np.generic]
# Raw outputs by name, for one picture; the batch axis has length 1.
Outputs: TypeAlias = Mapping[str, Array]
# Width and height in pixels.
Size: TypeAlias = tuple[int, int]


# Minimum score of a detection, where nothing else was fitted or asked for.
DEFAULT_SCORE: Final = 0.3
# Default intersection over union above which two boxes are of one object.
DEFAULT_OVERLAP: Final = 0.45


class Masks(Protocol):
    """Computes object masks, only for the candidates that remain after suppression."""

    def __call__(self, kept: Int64s, /) -> Floats:
        """Return shape (K, h, w): object probability over the whole input, at lower resolution."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class BoxCandidates:
    """Candidates of a network for one picture, before thresholds, as columns of length N.

    Attributes:
        boxes_px: Shape (N, 4), float64: x0, y0, x1, y1 in pixels of the network's input.
        scores: Shape (N,), float64.
        classes: Shape (N,), int64: index into the card's ``classes``.
        masks: Computes their masks; None if the network has no masks.
    """

    boxes_px: Floats
    scores: Floats
    classes: Int64s
    masks: Masks | None = None

    def __len__(self) -> int:
        """Number of candidates."""
        return len(self.scores)


@dataclass(frozen=True, slots=True)
class Tensor:
    """An input or output as a model file declares it; None for a variable size.

    Attributes:
        limits: Lowest and highest number of a tensor of quantised numbers; None for others.
    """

    name: str
    shape: tuple[int | str | None, ...]
    is_integer: bool = False
    is_bytes: bool = False
    limits: tuple[float, float] | None = None


@dataclass(frozen=True, slots=True)
class Interface:
    """Interface that a model file declares.

    Attributes:
        inputs: Inputs, in the file's order.
        outputs: Outputs, in the file's order.
        metadata: Text by key, as stored by the exporter.
        class_names: Class names from the metadata; empty if missing.
        class_count: Number of classes that a suppression in the file is given; None without it.
        first_class: Number of the first class, if the suppression says which is the background.
    """

    inputs: tuple[Tensor, ...]
    outputs: tuple[Tensor, ...]
    metadata: Mapping[str, str]
    class_names: tuple[str, ...] = ()
    class_count: int | None = None
    first_class: int | None = None

    @property
    def layout(self) -> str | None:
        """Layout of the picture, as in a card's ``[input]``; None if no axis has three channels."""
        shape = self.inputs[0].shape
        if len(shape) == 4 and 3 in (shape[1], shape[3]):
            return "nchw" if shape[1] == 3 else "nhwc"
        return "chw" if len(shape) == 3 else None

    @property
    def declared_px(self) -> tuple[int | None, int | None]:
        """Width and height of the input; None where variable."""
        axes = (2, 1) if self.layout == "nhwc" else (-1, -2)
        width, height = (static(self.inputs[0].shape, axis) for axis in axes)
        return width, height


@dataclass(frozen=True, slots=True)
class Guess:
    """A possible layout of a model file.

    Attributes:
        settings: Keys of the card's ``[output]`` and their values.
        class_count: Number of classes in this layout; None if the shapes do not determine it.
        reasons: Facts in the file that support this layout.
        assumptions: Assumptions without support in the file.
        input: Keys of the card's ``[input]`` that networks of this layout usually have.
        network: Keys of the card's ``[network]``, for files that contain only tensors.
        usual_size_px: Width and height to run at, where the file does not declare them.
        numbers_as_coco: True if networks of this layout use COCO's class numbers, with gaps.
        needs_names: True if networks of this layout are seldom trained on COCO.
        is_decided: False if other layouts may have such shapes, so that the reasons only suggest
            this one.
    """

    settings: Mapping[str, object]
    class_count: int | None
    reasons: tuple[str, ...]
    assumptions: tuple[str, ...] = ()
    input: Mapping[str, object] | None = None
    network: Mapping[str, object] | None = None
    usual_size_px: tuple[int, int] = (640, 640)
    numbers_as_coco: bool = False
    needs_names: bool = False
    is_decided: bool = True


class BoxOutput(Settings):
    """Settings of a card's ``[output]`` that all layouts have in common."""

    kind: str
    classes: tuple[str, ...]
    """Class names, in the order of the network's class numbers."""
    score: Proportion = DEFAULT_SCORE
    """Minimum score of a detection."""
    overlap: Proportion = DEFAULT_OVERLAP
    """Intersection over union above which only the better of two boxes of one class is kept."""

    @abstractmethod
    def candidates(self, outputs: Outputs, size_px: Size, /) -> BoxCandidates:
        """Decode the outputs for one picture of ``size_px``, the network's input.

        Candidates below ``score`` may be left out.

        Raises:
            ValueError: The outputs do not have the shape that the card specifies.
        """

    @classmethod
    @abstractmethod
    def recognise(cls, model: Interface, /) -> Guess | None:
        """Return the settings with which a model file has this layout; None if it cannot."""


def decoder_name(decoder: type[BoxOutput]) -> str:
    """Name of a layout in model cards."""
    (kind,) = get_args(decoder.model_fields["kind"].annotation)
    return str(kind)


def named(outputs: Outputs, name: str | None, key: str = "name") -> Array:
    """Select an output by name, or the only output if the card has no name.

    Raises:
        ValueError: The output does not exist, or a name is needed to choose one.
    """
    if name is None and len(outputs) == 1:
        return next(iter(outputs.values()))
    if name is None or name not in outputs:
        raise ValueError(f"{key}: expected one of {', '.join(sorted(outputs))}, got {name!r}")
    return outputs[name]


def output_rows(output: Array, columns: int, what: str) -> Floats:
    """Convert an output (1, N, columns), with any number of axes of 1, to a table, float64.

    Raises:
        ValueError: The output has another shape.
    """
    rows = table_rows(output.shape)
    if rows is None or output.shape[-1] != columns:
        raise ValueError(f"expected (1, N, {columns}) for {what}, got {output.shape}")
    return np.asarray(output.reshape(rows, columns), np.float64)


def table_rows(shape: Sequence[int | str | None]) -> int | None:
    """Number of rows of a table (N, columns) or (1, N, columns); None if variable or no table."""
    rows = shape[-2] if len(shape) > 1 and all(side == 1 for side in shape[:-2]) else None
    return rows if isinstance(rows, int) else None


def is_called(model: Interface, *names: str) -> bool:
    """Return whether a model file has outputs of all these names."""
    return {*names} <= {out.name for out in model.outputs}


def from_centers(table: Floats) -> Floats:
    """Convert boxes (N, 4) from center x, center y, width, height to corners."""
    center, half = table[:, :2], table[:, 2:4] / 2.0
    return np.hstack([center - half, center + half])


def best_class(scores: Array) -> tuple[Floats, Int64s]:
    """Maximum score of each row of scores (N, C), and its class.

    Only the maxima are converted to float64, because there can be a million scores.
    """
    if not scores.shape[1]:
        raise ValueError("0 classes; a detector needs at least one")
    scores = np.ascontiguousarray(scores)
    classes = scores.argmax(axis=1)
    best = np.take_along_axis(scores, classes[:, None], axis=1)[:, 0]
    return np.asarray(best, np.float64), classes.astype(np.int64)


def sigmoid(values: Floats) -> Floats:
    """Compute the logistic function without overflow."""
    return np.asarray(0.5 * (1.0 + np.tanh(0.5 * values)), np.float64)


def static(shape: tuple[int | str | None, ...], axis: int) -> int | None:
    """Declared size of an axis; None if it is variable or the axis does not exist."""
    size = shape[axis] if -len(shape) <= axis < len(shape) else None
    return size if isinstance(size, int) else None


# Second input of RT-DETR, D-FINE and others: width and height to which boxes are scaled.
PICTURE_SIZE_INPUT: Final = "orig_target_sizes"
# Inputs of Paddle's exports besides the picture: its factors of scale, its height and width.
PADDLE_SCALE_INPUT: Final = "scale_factor"
PADDLE_SIZE_INPUT: Final = "im_shape"
# Input of networks trained from ImageNet's weights: mean and scale of red, green and blue, for
# pixels from 0 to 255.
IMAGENET: Final = {
    "mean": (123.675, 116.28, 103.53),
    "scale": (1 / 58.395, 1 / 57.12, 1 / 57.375),
}
# The same in the order of OpenCV, as in networks of OpenMMLab and NanoDet.
IMAGENET_BGR: Final = {"colour": "bgr"} | {key: three[::-1] for key, three in IMAGENET.items()}
# Maximum number of a network's queries; tables of candidates by cells have more rows.
MAX_QUERIES: Final = 1000
# Strides of the grids of YOLO networks and of YOLOX.
GRID_STRIDES: Final = (8, 16, 32)


def cell_count(size_px: Size, strides: Sequence[int], *, round_up: bool = False) -> int:
    """Total number of cells of the grids of all strides over a picture."""
    return sum(w * h for w, h in _grids(size_px, strides, round_up))


def grid_cells(model: Interface) -> int | None:
    """Number of cells of strides 8, 16 and 32; None if the input's size is variable."""
    width, height = model.declared_px
    return cell_count((width, height), GRID_STRIDES) if width and height else None


@lru_cache(maxsize=8)
def cell_grid(
    size_px: Size, strides: tuple[int, ...], *, round_up: bool = False
) -> tuple[Floats, Floats]:
    """Column and row of each cell, shape (N, 2), and its stride in pixels, shape (N, 1)."""
    grids = _grids(size_px, strides, round_up)
    corners = [
        np.stack(np.meshgrid(np.arange(w), np.arange(h)), axis=-1).reshape(-1, 2) for w, h in grids
    ]
    steps = [np.full((w * h, 1), s) for (w, h), s in zip(grids, strides, strict=True)]
    found = (np.concatenate(corners).astype(np.float64), np.concatenate(steps).astype(np.float64))
    for one in found:
        # Cached arrays, shared by all pictures of a size.
        one.setflags(write=False)
    return found


def _grids(size_px: Size, strides: Sequence[int], round_up: bool) -> list[Size]:
    width, height = size_px
    if round_up:
        return [(-(-width // s), -(-height // s)) for s in strides]
    return [(width // s, height // s) for s in strides]


def class_numbers(values: Floats, count: int) -> Int64s:
    """Validate class numbers and convert them to integers.

    Raises:
        ValueError: A number is not an index of ``count`` classes.
    """
    bad = len(values) - int(np.isfinite(values).sum())
    if bad:
        raise ValueError(f"{bad} of {len(values)} candidates are not finite numbers")
    numbers: Int64s = values.astype(np.int64)
    if len(numbers) and not (numbers.min() >= 0 and numbers.max() < count):
        raise ValueError(
            f"class numbers {numbers.min()} to {numbers.max()}, but {count} classes are listed"
        )
    return numbers
