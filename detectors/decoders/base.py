"""What every decoder takes and returns."""

from __future__ import annotations

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
Outputs: TypeAlias = Mapping[str, Array]
"""Raw outputs by name, for one picture: the batch axis is there and has length 1."""
Size: TypeAlias = tuple[int, int]
"""Width and height in pixels."""


class Masks(Protocol):
    """Object masks of some candidates, computed only for those that stay."""

    def __call__(self, kept: Int64s, /) -> Floats:
        """Shape (K, h, w): probability of the object over the network's whole input, coarser."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Candidates:
    """What a network proposes for one picture, before thresholds, as columns of length N.

    Attributes:
        boxes_px: Shape (N, 4), float64: x0, y0, x1, y1 in pixels of the network's input.
        scores: Shape (N,), float64.
        classes: Shape (N,), int64: index into the card's ``classes``.
        masks: Computes their masks; None where the network has none.
    """

    boxes_px: Floats
    scores: Floats
    classes: Int64s
    masks: Masks | None = None

    def __len__(self) -> int:
        """How many candidates."""
        return len(self.scores)


@dataclass(frozen=True, slots=True)
class Tensor:
    """An input or output as a model file declares it; None for a size left open."""

    name: str
    shape: tuple[int | str | None, ...]
    is_integer: bool = False


@dataclass(frozen=True, slots=True)
class Interface:
    """What a model file says of itself.

    Attributes:
        inputs: In the file's order.
        outputs: Likewise.
        metadata: Text by key, as an exporter left it.
        class_names: From the metadata, empty where it has none.
    """

    inputs: tuple[Tensor, ...]
    outputs: tuple[Tensor, ...]
    metadata: Mapping[str, str]
    class_names: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Guess:
    """A layout that a model file may have.

    Attributes:
        settings: Keys of the card's ``[output]`` and their values.
        class_count: How many classes it then has; None where the shapes leave it open.
        reasons: What in the file says so.
        assumptions: What nothing in the file says.
        input: Keys of the card's ``[input]`` that networks of this layout usually have.
        network: Keys of the card's ``[network]``, for tensors alone.
        usual_size_px: Width and height to run at, where the file leaves them open.
        numbers_as_coco: Networks of this layout number classes as COCO does, with its gaps.
    """

    settings: Mapping[str, object]
    class_count: int | None
    reasons: tuple[str, ...]
    assumptions: tuple[str, ...] = ()
    input: Mapping[str, object] | None = None
    network: Mapping[str, object] | None = None
    usual_size_px: tuple[int, int] = (640, 640)
    numbers_as_coco: bool = False


class BoxOutput(Settings):
    """The part of a card's ``[output]`` that every layout has."""

    kind: str
    classes: tuple[str, ...]
    """Names in the order of the network's class numbers."""
    score: Proportion = 0.3
    """Candidates with a lower score are not reported."""
    overlap: Proportion = 0.45
    """Of two boxes of one class that overlap more (intersection over union), the better stays."""

    @abstractmethod
    def candidates(self, outputs: Outputs, size_px: Size, /) -> Candidates:
        """Decode the outputs for one picture of ``size_px``, the network's input.

        Candidates below ``score`` may be left out.

        Raises:
            ValueError: The outputs do not have the shape that the card asks for.
        """

    @classmethod
    @abstractmethod
    def recognise(cls, model: Interface, /) -> Guess | None:
        """What a model file would have to be for this layout; None where it cannot be."""


def kind_of(decoder: type[BoxOutput]) -> str:
    """The name that cards give a layout."""
    (kind,) = get_args(decoder.model_fields["kind"].annotation)
    return str(kind)


def named(outputs: Outputs, name: str | None, key: str = "name") -> Array:
    """One output by the card's name for it, the only one where the card names none.

    Raises:
        ValueError: No such output, or several and no name.
    """
    if name is None and len(outputs) == 1:
        return next(iter(outputs.values()))
    if name is None or name not in outputs:
        raise ValueError(f"{key}: expected one of {', '.join(sorted(outputs))}, got {name!r}")
    return outputs[name]


def rows_of(output: Array, columns: int, what: str) -> Floats:
    """An output (1, N, columns) as a table (N, columns), float64.

    Raises:
        ValueError: Another shape.
    """
    if output.ndim != 3 or output.shape[0] != 1 or output.shape[2] != columns:
        raise ValueError(f"expected (1, N, {columns}) for {what}, got {output.shape}")
    return np.asarray(output[0], np.float64)


def from_centers(table: Floats) -> Floats:
    """Boxes (N, 4) as center x, center y, width, height turned into corners."""
    center, half = table[:, :2], table[:, 2:4] / 2.0
    return np.hstack([center - half, center + half])


def best_class(scores: Array) -> tuple[Floats, Int64s]:
    """Of scores (N, C), each row's highest and its class.

    They keep their type until few are left: a network has a million of them.
    """
    if not scores.shape[1]:
        raise ValueError("0 classes; a detector needs at least one")
    scores = np.ascontiguousarray(scores)
    classes = scores.argmax(axis=1)
    best = np.take_along_axis(scores, classes[:, None], axis=1)[:, 0]
    return np.asarray(best, np.float64), classes.astype(np.int64)


def sigmoid(values: Floats) -> Floats:
    """Logistic function, without overflow."""
    return np.asarray(0.5 * (1.0 + np.tanh(0.5 * values)), np.float64)


def static(shape: tuple[int | str | None, ...], axis: int) -> int | None:
    """A declared size as a number; None where it is open or has no such axis."""
    size = shape[axis] if -len(shape) <= axis < len(shape) else None
    return size if isinstance(size, int) else None


PICTURE_SIZE_INPUT: Final = "orig_target_sizes"
"""Second input of RT-DETR, D-FINE and others: width and height that boxes are scaled to."""
GRID_STRIDES: Final = (8, 16, 32)
"""Of the grids of YOLO networks and of YOLOX."""


def cell_count(size_px: Size, strides: Sequence[int], *, round_up: bool = False) -> int:
    """How many cells the grids of all strides have over a picture."""
    return sum(w * h for w, h in _grids(size_px, strides, round_up))


@lru_cache(maxsize=8)
def cells(
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
        # The same arrays serve every picture of a size.
        one.setflags(write=False)
    return found


def _grids(size_px: Size, strides: Sequence[int], round_up: bool) -> list[Size]:
    width, height = size_px
    if round_up:
        return [(-(-width // s), -(-height // s)) for s in strides]
    return [(width // s, height // s) for s in strides]


def class_numbers(values: Floats, count: int) -> Int64s:
    """Class numbers that came as floating-point values or integers, checked.

    Raises:
        ValueError: One that is not an index of ``count`` classes.
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
