"""Decoders of YOLOv5 to v11 in their projects' exports: boxes in input pixels, some with masks."""

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from typing_extensions import override

from .base import (
    GRID_STRIDES,
    IMAGENET,
    MAX_QUERIES,
    Array,
    BoxCandidates,
    BoxOutput,
    Floats,
    Guess,
    Int64s,
    Interface,
    Outputs,
    Size,
    best_class,
    cell_count,
    from_centers,
    grid_cells,
    named,
    output_rows,
    sigmoid,
    static,
    table_rows,
)

PICTURE: Final = {"colour": "rgb", "fit": "letterbox-center", "scale": (1 / 255,) * 3}
YOLOX_PICTURE: Final = {"colour": "bgr", "fit": "letterbox"}
_COEFFICIENTS: Final = 32
# Strides of networks with three anchors per cell: most, small ones, and those for large inputs.
_ANCHORED: Final = (GRID_STRIDES, (16, 32), (8, 16, 32, 64))


class _CentersOutput(BoxOutput):
    """Boxes as center and size."""

    is_fraction: bool = False
    """True if boxes are in fractions of the input, as in TFLite files; else in its pixels."""
    are_corners: bool = False
    """True if boxes are x0, y0, x1, y1 instead of center and size."""

    def _corners(self, table: Floats, size_px: Size) -> Floats:
        corners = table[:, :4] if self.are_corners else from_centers(table)
        return corners * np.tile(size_px, 2) if self.is_fraction else corners


class YoloV5Output(_CentersOutput):
    """YOLOv3, v5, v7: (1, N, 5 + classes): center, size, objectness, class scores."""

    kind: Literal["yolov5"]
    name: str | None = None
    """Name of the output; by default the only output."""
    heads: tuple[str, ...] = ()
    """Names of the outputs, where each stride has its own."""

    @override
    def candidates(self, outputs: Outputs, size_px: Size, /) -> BoxCandidates:
        classes = len(self.classes)
        rows = [named(outputs, name) for name in self.heads or (self.name,)]
        table = np.vstack([output_rows(one, 5 + classes, f"{classes} classes") for one in rows])
        best, numbers = best_class(table[:, 5:])
        return BoxCandidates(self._corners(table, size_px), table[:, 4] * best, numbers)

    @override
    @classmethod
    def recognise(cls, model: Interface, /) -> Guess | None:
        heads = _heads(model)
        output = next((out for out in model.outputs if heads or len(out.shape) == 3), None)
        columns = None if output is None else static(output.shape, -1)
        if (
            output is None
            or columns is None
            or columns < 6
            or (not heads and prototype_output(model) is not None)
        ):
            return None
        rows, cells = None if heads else static(output.shape, 1), grid_cells(model)
        # Three anchors per cell; one if the network decodes the boxes of YOLOX itself.
        if rows is not None and (rows <= columns or (cells and rows not in _row_counts(model))):
            return None
        names = len(model.class_names)
        if names and names != columns - 5:
            return None
        why = f"rows of {columns}: 5 and {columns - 5} classes"
        settings: dict[str, object] = {"kind": "yolov5"}
        settings |= {"heads": heads} if heads else {"name": output.name}
        # YOLOv6's exporter calls its output so; its objectness is 1.
        if rows is not None and rows == cells and output.name != "outputs":
            return Guess(
                settings,
                columns - 5,
                (why, f"{rows} rows are the cells of strides 8, 16, 32"),
                ("boxes are in input pixels, as YOLOX exports with --decode_in_inference",),
                YOLOX_PICTURE,
                is_decided=False,
            )
        return Guess(
            settings,
            columns - 5,
            (why, *((f"its metadata names {names} classes",) if names else ())),
            () if names else ("boxes are in input pixels, with an objectness",),
            # YOLOP has maps of road and lanes besides.
            {**PICTURE, **IMAGENET}
            if any(len(out.shape) == 4 for out in model.outputs)
            else PICTURE,
            is_decided=bool(names),
        )


class YoloV8Output(_CentersOutput):
    """YOLOv8, v9, v11: one output (1, 4 + classes, N), or transposed: box, class scores."""

    kind: Literal["yolov8"]
    name: str | None = None
    """Name of the output; by default the only output."""

    @override
    def candidates(self, outputs: Outputs, size_px: Size, /) -> BoxCandidates:
        table = _columns(named(outputs, self.name), 4 + len(self.classes))
        scores, classes = best_class(table[:, 4:])
        return BoxCandidates(self._corners(table, size_px), scores, classes)

    @override
    @classmethod
    def recognise(cls, model: Interface, /) -> Guess | None:
        names = len(model.class_names)
        found = _transposed(model) or _rows_of_boxes(model)
        # YOLOv9's own export has an auxiliary head before the one that counts.
        heads, last = len(model.outputs), model.outputs[-1]
        if found is None or heads > 2 or model.outputs[0].shape != last.shape:
            return None
        name, rows = last.name, found[1]
        if rows < 5 or (names and names != rows - 4):
            return None
        why = f"{rows} rows: 4 and {rows - 4} classes"
        # Without names, rows of centers are YOLOX's, with an objectness.
        are_corners = not names and _transposed(model) is None
        return Guess(
            {"kind": "yolov8", "name": name, **({"are_corners": True} if are_corners else {})},
            rows - 4,
            (why, *((f"its metadata names {names} classes",) if names else ())),
            (
                *(() if names else ("class scores without an objectness",)),
                *((f"{name} is the head that counts, as in YOLOv9's export",) * (heads - 1)),
            ),
            PICTURE,
            is_decided=bool(names),
        )


class YoloV8SegOutput(_CentersOutput):
    """YOLOv8-seg, v11-seg: as YOLOv8, then 32 mask weights; and prototypes (1, 32, h, w)."""

    kind: Literal["yolov8-seg"]
    name: str
    """Name of the output with the boxes."""
    prototypes: str
    """Name of the output with the prototype masks."""

    @override
    def candidates(self, outputs: Outputs, size_px: Size, /) -> BoxCandidates:
        prototypes = prototypes_of(named(outputs, self.prototypes, "prototypes"))
        classes = len(self.classes)
        table = _columns(named(outputs, self.name), 4 + classes + len(prototypes))
        scores, numbers = best_class(table[:, 4 : 4 + classes])
        masks = PrototypeMasks(table[:, 4 + classes :], prototypes)
        return BoxCandidates(self._corners(table, size_px), scores, numbers, masks)

    @override
    @classmethod
    def recognise(cls, model: Interface, /) -> Guess | None:
        found, prototypes = _transposed(model), prototype_output(model)
        if found is None or prototypes is None:
            return None
        name, rows = found
        classes = rows - 4 - prototypes[1]
        if classes < 1:
            return None
        return Guess(
            {"kind": "yolov8-seg", "name": name, "prototypes": prototypes[0]},
            classes,
            (f"{rows} rows: 4, {classes} classes and {prototypes[1]} mask weights",),
            (),
            PICTURE,
        )


@dataclass(frozen=True, slots=True, eq=False)
class PrototypeMasks:
    """Masks as weighted sums of prototypes: weights (N, K), prototypes (K, h, w)."""

    weights: Floats
    prototypes: Floats

    def __call__(self, kept: Int64s, /) -> Floats:
        """Return the selected masks, shape (len(kept), h, w)."""
        return sigmoid(np.tensordot(self.weights[kept], self.prototypes, axes=1))


def prototype_output(model: Interface) -> tuple[str, int] | None:
    """Name of the output with prototype masks, and their number; None without such an output."""
    for out in model.outputs:
        # In TFLite files the prototypes are the last axis.
        if len(out.shape) == 4 and _COEFFICIENTS in (out.shape[1], out.shape[3]):
            return out.name, _COEFFICIENTS
    return None


def prototypes_of(output: Array) -> Floats:
    """Remove the batch axis of prototype masks (1, K, h, w), or (1, h, w, K) in TFLite files.

    Raises:
        ValueError: The output has another shape.
    """
    if output.ndim != 4 or output.shape[0] != 1 or _COEFFICIENTS not in output.shape:
        raise ValueError(f"prototypes: expected (1, {_COEFFICIENTS}, h, w), got {output.shape}")
    is_last = output.shape[1] != _COEFFICIENTS
    return np.asarray(output[0].transpose(2, 0, 1) if is_last else output[0], np.float64)


def _columns(output: Array, rows: int) -> Floats:
    if output.ndim == 3 and output.shape[1] != rows:
        output = output.transpose(0, 2, 1)
    if output.ndim != 3 or output.shape[:2] != (1, rows):
        raise ValueError(f"expected (1, {rows}, N) for these classes, got {output.shape}")
    return np.asarray(output[0].T, np.float64)


def _row_counts(model: Interface) -> tuple[int, ...]:
    """Numbers of rows that a table over the cells of an input may have."""
    width, height = model.declared_px
    if not width or not height:
        return ()
    three = (3 * cell_count((width, height), strides) for strides in _ANCHORED)
    return cell_count((width, height), GRID_STRIDES), *three


def _heads(model: Interface) -> tuple[str, ...]:
    """Names of several outputs that together have three rows for each cell; else empty."""
    rows = [table_rows(out.shape) or 0 for out in model.outputs]
    columns = {static(out.shape, -1) for out in model.outputs}
    is_whole = len(columns) == 1 and sum(rows) in _row_counts(model)[1:]
    return tuple(out.name for out in model.outputs) if len(rows) > 1 and is_whole else ()


def _rows_of_boxes(model: Interface) -> tuple[str, int] | None:
    """Name and number of columns of the output whose rows are the candidates.

    Without names, a table with COCO's 80 classes, or not over the cells of YOLO's grids. Paddle's
    exports, with an input named image, have a layout of their own.
    """
    shape = model.outputs[0].shape
    rows, columns = static(shape, 1) or 0, static(shape, 2)
    if columns is None or rows <= max(columns, MAX_QUERIES) or model.inputs[0].name == "image":
        return None
    is_other = not model.class_names and columns != 84 and rows in _row_counts(model)
    return None if is_other else (model.outputs[0].name, columns)


def _transposed(model: Interface) -> tuple[str, int] | None:
    """Name and number of rows of the output whose columns are the candidates."""
    for out in model.outputs:
        rows, columns = static(out.shape, 1), static(out.shape, 2)
        if len(out.shape) == 3 and rows is not None and (columns is None or columns > rows):
            return out.name, rows
    return None
