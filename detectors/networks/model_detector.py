"""A network described by a model card as a detector: boxes, or road.

Settings: ``card``, ``backend``, ``threads``, ``score``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from crosscue.detectors import rle
from crosscue.detectors.base import Detections, Detector, Found, Frame, RoadMask, View
from crosscue.detectors.catalog.card import (
    Input,
    ModelCard,
    SegmentationOutput,
    YoloxOutput,
    read_card,
    read_weights,
)
from crosscue.detectors.settings import Settings, Share, identity_of, settings_of
from crosscue.replay.columns import Bytes, Floats, Int64s
from crosscue.replay.errors import VehicleError, one_line

from .backends import Array, Network, load_network

PAD: Final = 114
VERSION: Final = 1
"""Counts up when the same pixels, card and settings would give other numbers."""


class ModelSettings(Settings):
    """How to run a card."""

    card: str
    """File name of the card."""
    backend: Literal["onnxruntime", "opencv", "openvino", "litert"] | None = None
    threads: int = 1
    score: Share | None = None
    """Instead of the card's."""


def build(**given: Any) -> Detector:
    """The detector that a card describes.

    Raises:
        VehicleError: Settings, card, weights or back end do not fit one another.
    """
    settings = settings_of(ModelSettings, given, "detector model")
    path = Path(settings.card)
    card = read_card(path)
    network = load_network(read_weights(card, path.parent), settings.backend, settings.threads)
    if isinstance(card.output, YoloxOutput):
        detector: Detector = BoxDetector(card, card.output, settings, network, str(path))
    else:
        detector = RoadDetector(card, card.output, settings, network, str(path))
    return _tried(detector, card, path)


def _tried(detector: Detector, card: ModelCard, path: Path) -> Detector:
    """The detector, once a grey picture has gone through it."""
    size = (card.input.width_px, card.input.height_px)
    grey = np.full((size[1], size[0], 3), PAD, np.uint8)
    try:
        detector([Frame(0, "", grey, size)])
    except VehicleError:
        raise
    except Exception as error:
        why = one_line(error, 200)
        raise VehicleError(
            f"{path}: the network does not run on input {size[0]} x {size[1]}, "
            f"{card.input.layout}, {card.input.dtype}: {why}; mend [input]"
        ) from None
    return detector


@dataclass(frozen=True, slots=True)
class BoxDetector:
    """Boxes from a YOLOX-type network."""

    card: ModelCard
    output: YoloxOutput
    settings: ModelSettings
    network: Network
    where: str

    @property
    def view(self) -> View:
        """No finer than the network's input."""
        return View(least_width_px=self.card.input.width_px)

    @property
    def identity(self) -> str:
        """Of card, settings and back end."""
        return _identity(self.card, self.settings, self.network)

    def __call__(self, frames: Sequence[Frame], /) -> Sequence[Found]:
        """Detect."""
        return [self._one(frame) for frame in frames]

    def _one(self, frame: Frame) -> Detections:
        given, ratio = prepared(frame.pixels, self.card.input)
        rows = _output(self.network(given), self.output.name, self.where)
        try:
            boxes, scores, classes = yolox_boxes(rows, self.output, self.card.input)
        except ValueError as error:
            raise VehicleError(f"{self.where}: output: {error}; mend the card") from None
        score = self.output.score if self.settings.score is None else self.settings.score
        keep = _best(boxes, scores, classes, score, self.output.overlap)
        scale = np.tile(np.array(frame.scale) / np.array(ratio), 2)
        width, height = frame.size_px
        boxes = np.clip(boxes[keep] * scale, 0.0, [width, height, width, height])
        labels = tuple(self.output.classes[i] for i in classes[keep])
        return Detections(
            frame.t_ns, frame.size_px, boxes, scores[keep], labels, (b"",) * len(labels)
        )


@dataclass(frozen=True, slots=True)
class RoadDetector:
    """Road pixels from semantic segmentation."""

    card: ModelCard
    output: SegmentationOutput
    settings: ModelSettings
    network: Network
    where: str

    @property
    def view(self) -> View:
        """No finer than the network's input."""
        return View(least_width_px=self.card.input.width_px)

    @property
    def identity(self) -> str:
        """Of card, settings and back end."""
        return _identity(self.card, self.settings, self.network)

    def __call__(self, frames: Sequence[Frame], /) -> Sequence[Found]:
        """Segment."""
        found = []
        for frame in frames:
            road = self.road_mask(frame)
            size = (road.shape[1], road.shape[0])
            text = rle.encode(road, (0, 0), size)
            found.append(RoadMask(frame.t_ns, frame.size_px, text, size))
        return found

    def road_mask(self, frame: Frame) -> NDArray[np.bool_]:
        """Road pixels over the whole picture at the network's resolution, shape (h, w), bool."""
        given, ratio = prepared(frame.pixels, self.card.input)
        raw = _output(self.network(given), self.output.name, self.where)
        try:
            classes = class_map(raw, len(self.output.classes))
        except ValueError as error:
            raise VehicleError(f"{self.where}: output: {error}; mend the card") from None
        names = [i for i, name in enumerate(self.output.classes) if name in self.output.road]
        if not names:
            raise VehicleError(
                f"{self.where}: output.road: none of {', '.join(self.output.road)} is a class"
            )
        rows = round(
            frame.pixels.shape[0] * ratio[1] * classes.shape[0] / self.card.input.height_px
        )
        columns = round(
            frame.pixels.shape[1] * ratio[0] * classes.shape[1] / self.card.input.width_px
        )
        return np.isin(classes[:rows, :columns], names)


def _identity(card: ModelCard, settings: ModelSettings, network: Network) -> str:
    asked = settings.model_dump(mode="json", exclude={"card", "threads"})
    return identity_of("model", VERSION, card.model_dump(mode="json"), asked, network.backend)


def prepared(pixels: Bytes, want: Input) -> tuple[Array, tuple[float, float]]:
    """A picture as a network's input, and by how much it was stretched along x and y."""
    import cv2

    height, width = pixels.shape[:2]
    ratio = (want.width_px / width, want.height_px / height)
    if want.fit == "letterbox":
        ratio = (min(ratio), min(ratio))
    size = (max(round(width * ratio[0]), 1), max(round(height * ratio[1]), 1))
    shrunk = cv2.resize(pixels, size, interpolation=cv2.INTER_LINEAR)
    whole = np.full((want.height_px, want.width_px, 3), PAD, np.uint8)
    whole[: size[1], : size[0]] = shrunk
    if want.colour == "rgb":
        whole = whole[:, :, ::-1]
    if want.dtype == "float32":
        mean, scale = np.array(want.mean, np.float32), np.array(want.scale, np.float32)
        given: Array = (whole.astype(np.float32) - mean) * scale
    else:
        given = whole
    axes = (2, 0, 1) if want.layout == "nchw" else (0, 1, 2)
    return np.ascontiguousarray(given.transpose(axes)[None]), ratio


def _output(outputs: Mapping[str, Array], name: str | None, where: str) -> Array:
    if name is None and len(outputs) == 1:
        return next(iter(outputs.values()))
    if name is None or name not in outputs:
        raise VehicleError(
            f"{where}: output.name: want one of {', '.join(sorted(outputs))}, got {name!r}"
        )
    return outputs[name]


def yolox_boxes(rows: Array, output: YoloxOutput, want: Input) -> tuple[Floats, Floats, Int64s]:
    """Boxes in input pixels (x0, y0, x1, y1), scores and classes, one for each grid cell.

    Raises:
        ValueError: The numbers do not have the shape that the card's sizes and classes ask for.
    """
    grids = [(want.width_px // s, want.height_px // s, s) for s in output.strides]
    cells = sum(w * h for w, h, _ in grids)
    shape = (1, cells, 5 + len(output.classes))
    if rows.shape != shape:
        raise ValueError(f"want {shape} for {len(output.classes)} classes, got {rows.shape}")
    table = np.asarray(rows[0], np.float64)
    corner = np.concatenate([_cells(w, h) for w, h, _ in grids])
    stride = np.concatenate([np.full(w * h, s) for w, h, s in grids])[:, None]
    center = (table[:, :2] + corner) * stride
    half = np.exp(np.minimum(table[:, 2:4], 20.0)) * stride / 2.0
    scores = table[:, 4] * table[:, 5:].max(axis=1)
    return np.hstack([center - half, center + half]), scores, table[:, 5:].argmax(axis=1)


def _cells(width: int, height: int) -> Floats:
    y, x = np.mgrid[0:height, 0:width]
    return np.stack([x.ravel(), y.ravel()], axis=1).astype(np.float64)


def _best(boxes: Floats, scores: Floats, classes: Int64s, score: float, overlap: float) -> Int64s:
    """Which boxes stay: good enough, and no better one of their class over them; best first."""
    candidates = np.flatnonzero(np.isfinite(scores) & (scores >= score))
    candidates = candidates[np.argsort(-scores[candidates], kind="stable")]
    kept: list[int] = []
    for i in candidates.tolist():
        rivals = [k for k in kept if classes[k] == classes[i]]
        if not rivals or float(overlaps(boxes[i], boxes[rivals]).max()) <= overlap:
            kept.append(i)
    return np.array(kept, np.int64)


def overlaps(box: Floats, others: Floats) -> Floats:
    """Intersection over union of one box with each of N others, shape (N,)."""
    low = np.maximum(box[:2], others[:, :2])
    high = np.minimum(box[2:], others[:, 2:])
    both = np.prod(np.maximum(high - low, 0.0), axis=1)
    areas = np.prod(others[:, 2:] - others[:, :2], axis=1) + np.prod(box[2:] - box[:2])
    return np.asarray(both / np.maximum(areas - both, 1e-12), np.float64)


def class_map(raw: Array, classes: int) -> Array:
    """One class number a pixel, shape (h, w), from scores (1, C, h, w) or numbers (1, h, w).

    Raises:
        ValueError: Another shape, or a class that is not listed.
    """
    if raw.ndim == 4 and raw.shape[0] == 1 and raw.shape[1] == classes:
        return np.asarray(raw[0].argmax(axis=0))
    squeezed = raw.reshape([side for side in raw.shape if side != 1])
    if squeezed.ndim != 2:
        raise ValueError(f"want (1, {classes}, h, w) or (1, h, w), got {raw.shape}")
    numbers = np.asarray(squeezed, np.int64)
    if numbers.min() < 0 or numbers.max() >= classes:
        raise ValueError(f"class number {numbers.max()}, but {classes} classes are listed")
    return numbers
