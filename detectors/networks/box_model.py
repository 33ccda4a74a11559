"""Detector of boxes from a model card: batches, tiles, suppression and masks."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from crosscue.detectors import rle
from crosscue.detectors.base import Detections, Found, Frame, View
from crosscue.detectors.boxes import non_maximum_suppression
from crosscue.detectors.catalog.card import ModelCard, Tiles
from crosscue.detectors.catalog.class_names import CONTROL_LABELS
from crosscue.detectors.decoders.base import Array, BoxCandidates, BoxOutput, Size
from crosscue.replay.columns import Bytes, Floats, Int64s
from crosscue.replay.errors import VehicleError

from .backends import Network
from .picture_input import Placement, prepared, view_of

Corner = tuple[int, int]
# Distance to a tile's inner edge within which a box counts as cut off.
EDGE_PX = 2.0


def corners(picture: Size, tile: Size, tiles: Tiles) -> list[Corner]:
    """Left and top of each tile, in rows from ``tiles.top`` to ``tiles.bottom``."""
    width, height = picture
    top, bottom = round(tiles.top * height), round(tiles.bottom * height)
    lefts = _starts(0, width, tile[0], tiles.overlap, width)
    tops = _starts(top, bottom, tile[1], tiles.overlap, height)
    return [(x, y) for y in tops for x in lefts]


def _starts(first: int, last: int, length: int, overlap: float, side: int) -> list[int]:
    """Starts of tiles of a length that cover first to last and stay inside 0 to side."""
    span = last - first
    if span <= length or side <= length:
        return [min(max((first + last - length) // 2, 0), max(side - length, 0))]
    count = int(np.ceil((span - length) / (length * (1.0 - overlap)))) + 1
    return [first + round(i * (span - length) / (count - 1)) for i in range(count)]


def is_uncut(
    boxes_px: NDArray[np.float64], corner: Corner, tile: Size, picture: Size
) -> NDArray[np.bool_]:
    """Mark the boxes (N, 4), in the picture's pixels, that no inner edge of the tile cuts off."""
    low = np.array(corner, np.float64)
    high = np.minimum(low + tile, picture)
    at_low = (boxes_px[:, :2] < low + EDGE_PX) & (low > 0)
    at_high = (boxes_px[:, 2:] > high - EDGE_PX) & (high < picture)
    return np.asarray(~(at_low | at_high).any(axis=1))


@dataclass(frozen=True, slots=True, eq=False)
class _Part:
    """A picture or a part of it, as passed to the network."""

    frame: int
    pixels: Bytes
    corner: Corner | None
    """Left and top of a part in decoded pixels; None for the whole picture."""


@dataclass(frozen=True, slots=True, eq=False)
class _Found:
    """Candidates of one part after suppression; boxes are in decoded pixels of the frame."""

    boxes: Floats
    scores: Floats
    classes: Int64s
    masks: list[bytes]


@dataclass(frozen=True, slots=True)
class BoxModel:
    """Detector of boxes, with masks if the network returns them.

    Attributes:
        card: The model card.
        output: Decoder of the network's output, with the minimum score of a traffic light or stop
            sign.
        network: The loaded network.
        where: The card's file, for errors.
        identity: Text that changes with card, settings and back end.
        score: Minimum score of any other detection.
        is_enlarged: True to look at the middle half of a picture again.
    """

    card: ModelCard
    output: BoxOutput
    network: Network
    where: str
    identity: str
    score: float
    is_enlarged: bool = False

    @property
    def labels(self) -> tuple[str, ...]:
        """Labels of the card's classes."""
        return tuple(map(self.card.meaning, range(len(self.output.classes))))

    @property
    def is_calibrated(self) -> bool:
        """Whether the card declares its scores to be probabilities."""
        return self.card.is_calibrated

    @property
    def min_scores(self) -> dict[str, float]:
        """The card's thresholds by label."""
        known = {label: one.threshold for label, one in self.card.scores.items()}
        return {label: score for label, score in known.items() if score is not None}

    @property
    def log_ratios(self) -> dict[str, tuple[float, ...]]:
        """The card's log likelihood ratio of one box by label."""
        known = {label: one.log_ratio for label, one in self.card.scores.items()}
        return {label: one for label, one in known.items() if one is not None}

    @property
    def calibrated_labels(self) -> tuple[str, ...]:
        """Labels with a calibration in the card."""
        return tuple(label for label, one in self.card.scores.items() if one.calibration)

    @property
    def view(self) -> View:
        """The resolution that the card's input needs; full size for a second look at parts."""
        is_full = self.card.tiles is not None or self.is_enlarged
        return View() if is_full else view_of(self.card.input)

    def __call__(self, frames: Sequence[Frame], /) -> Sequence[Found]:
        """Return the detections in each frame."""
        parts = [part for i, frame in enumerate(frames) for part in self._parts(i, frame)]
        found: list[list[_Found]] = [[] for _ in frames]
        step = self.card.input.max_batch
        for start in range(0, len(parts), step):
            batch = parts[start : start + step]
            for part, one in zip(batch, self._run(batch, frames), strict=True):
                found[part.frame].append(one)
        return [self._merged(frame, some) for frame, some in zip(frames, found, strict=True)]

    def _parts(self, number: int, frame: Frame) -> Iterator[_Part]:
        yield _Part(number, frame.pixels, None)
        height, width = frame.pixels.shape[:2]
        wide, high = self.card.input.width_px, self.card.input.height_px
        if self.is_enlarged and width > 1:
            half = (width // 2, min(max(width // 2 * high // wide, 1), height))
            x, y = (width - half[0]) // 2, (height - half[1]) // 2
            yield _Part(number, frame.pixels[y : y + half[1], x : x + half[0]], (x, y))
        if self.card.tiles is None:
            return
        if width <= wide and height <= high:
            return
        for x, y in corners((width, height), (wide, high), self.card.tiles):
            yield _Part(number, frame.pixels[y : y + high, x : x + wide], (x, y))

    def _run(self, parts: Sequence[_Part], frames: Sequence[Frame]) -> Iterator[_Found]:
        given = [prepared(part.pixels, self.card.input) for part in parts]
        is_bare = self.card.input.layout == "chw"
        batch = given[0][0] if len(given) == 1 else np.concatenate([one for one, _ in given])
        outputs = self.network(batch[0] if is_bare else batch)
        for i, (part, (_, placement)) in enumerate(zip(parts, given, strict=True)):
            try:
                mine = outputs if len(parts) == 1 else _of_picture(outputs, i, len(parts))
                yield self._kept(mine, part, placement, frames[part.frame])
            except ValueError as error:
                raise VehicleError(f"{self.where}: output: {error}; correct the card") from None

    def _kept(
        self, outputs: Mapping[str, Array], part: _Part, placement: Placement, frame: Frame
    ) -> _Found:
        some = self.output.candidates(outputs, placement.size_px)
        bad = len(some) - int(
            np.isfinite(np.column_stack([some.boxes_px, some.scores])).all(1).sum()
        )
        if bad:
            raise ValueError(f"{bad} of {len(some)} candidates are not finite numbers")
        lowest = [
            self.output.score if label in CONTROL_LABELS else self.score for label in self.labels
        ]
        is_above = some.scores >= np.array(lowest)[some.classes]
        keep = non_maximum_suppression(
            some.boxes_px,
            np.where(is_above, some.scores, -1.0),
            some.classes,
            self.output.score,
            self.output.overlap,
        )
        boxes = placement.to_picture(some.boxes_px[keep])
        if part.corner is not None:
            boxes = boxes + np.tile(part.corner, 2)
            height, width = frame.pixels.shape[:2]
            tile = (part.pixels.shape[1], part.pixels.shape[0])
            is_kept = is_uncut(boxes, part.corner, tile, (width, height))
            boxes, keep = boxes[is_kept], keep[is_kept]
        masks = self._masks(some, keep, boxes, part, placement, frame)
        return _Found(boxes, some.scores[keep], some.classes[keep], masks)

    def _masks(
        self,
        some: BoxCandidates,
        keep: Int64s,
        boxes: Floats,
        part: _Part,
        placement: Placement,
        frame: Frame,
    ) -> list[bytes]:
        if some.masks is None:
            return [b""] * len(keep)
        texts = []
        for i, box in zip(keep, boxes, strict=True):
            (grid,) = some.masks(np.array([i]))
            wide, high = placement.size_px
            per_input = (grid.shape[1] / wide, grid.shape[0] / high)
            corner = part.corner or (0, 0)
            affine = [
                (
                    placement.scale[a] * per_input[a] / frame.scale[a],
                    (placement.offset[a] - corner[a] * placement.scale[a]) * per_input[a],
                )
                for a in (0, 1)
            ]
            texts.append(_mask_text(grid, box * np.tile(frame.scale, 2), affine, frame.size_px))
        return texts

    def _merged(self, frame: Frame, some: Sequence[_Found]) -> Detections:
        boxes = np.vstack([one.boxes for one in some])
        scores = np.concatenate([one.scores for one in some])
        classes = np.concatenate([one.classes for one in some])
        masks = [mask for one in some for mask in one.masks]
        keep = np.arange(len(scores))
        if len(some) > 1:
            overlap = min(self.output.overlap, 0.45)
            keep = non_maximum_suppression(boxes, scores, classes, self.output.score, overlap)
        width, height = frame.size_px
        inside = np.clip(boxes * np.tile(frame.scale, 2), 0.0, [width, height, width, height])
        is_seen = (inside[keep, 2:] > inside[keep, :2]).all(axis=1)
        keep = keep[is_seen]
        labels = tuple(self.card.meaning(i) for i in classes[keep].tolist())
        return Detections(
            frame.t_ns,
            frame.size_px,
            inside[keep],
            self._calibrated(np.clip(scores[keep], 0.0, 1.0), labels),
            labels,
            tuple(masks[i] for i in keep.tolist()),
        )

    def _calibrated(self, scores: Floats, labels: Sequence[str]) -> Floats:
        """Apply the card's calibrations to scores."""
        for label in self.calibrated_labels:
            mine = np.array([one == label for one in labels], np.bool_)
            by = self.card.scores[label].calibration
            if by is not None and mine.any():
                scores[mine] = by.probabilities(scores[mine])
        return scores


def _of_picture(outputs: Mapping[str, Array], number: int, count: int) -> dict[str, Array]:
    """Return one picture's part of a batch's outputs.

    Raises:
        ValueError: An output does not have one row per picture.
    """
    for name, values in outputs.items():
        if not values.ndim or len(values) != count:
            raise ValueError(
                f"{name}: expected {count} pictures' results, got {values.shape}; "
                "set input.max_batch = 1"
            )
    return {name: values[number : number + 1] for name, values in outputs.items()}


def _mask_text(
    grid: Floats, box_px: Floats, affine: Sequence[tuple[float, float]], size_px: tuple[int, int]
) -> bytes:
    """Encode an object's mask inside its box, from probabilities over the network's input.

    Args:
        grid: Probabilities, shape (h, w).
        box_px: x0, y0, x1, y1 in the camera's pixels.
        affine: Factor and offset for x and y: grid coordinate = factor * camera pixel + offset.
        size_px: Width and height of the camera's picture.
    """
    low = np.clip(np.floor(box_px[:2]), 0, size_px).astype(int)
    high = np.clip(np.ceil(box_px[2:]), 0, size_px).astype(int)
    width, height = (high - low).tolist()
    if width <= 0 or height <= 0:
        return b""
    (fx, ox), (fy, oy) = affine
    # Pixel centres are half a pixel inside, in the camera's picture and in the grid.
    shift = ((low[0] + 0.5) * fx + ox - 0.5, (low[1] + 0.5) * fy + oy - 0.5)
    matrix = np.array([[fx, 0.0, shift[0]], [0.0, fy, shift[1]]])
    part = cv2.warpAffine(
        grid.astype(np.float32),
        matrix,
        (width, height),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,
    )
    mask = part > 0.5
    return rle.encode_mask(mask, (int(low[0]), int(low[1])), size_px) if mask.any() else b""
