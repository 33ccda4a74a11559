"""Build a detector of boxes or of road from a model card.

Settings: ``card``, ``backend``, ``threads``, ``score``, ``candidate_score``, ``enlarged``.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from crosscue.detectors import rle
from crosscue.detectors.base import Detector, Found, Frame, RoadMask, View, bars_beside
from crosscue.detectors.catalog.card import ModelCard, SegmentationOutput, read_card, read_weights
from crosscue.detectors.catalog.entries import weights_folder
from crosscue.detectors.decoders.base import Array, named
from crosscue.detectors.settings import Proportion, Settings, identity_of, settings_of
from crosscue.replay.errors import VehicleError, one_line

from .backends import Network, load_network
from .box_model import BoxModel
from .picture_input import Placement, prepared, view_of
from .weights import Weights

# Incremented when the same pixels, card and settings yield different numbers than before.
VERSION: Final = 3
# Brightness up to which a column counts as black.
BLACK: Final = 32


class ModelSettings(Settings):
    """Settings of a detector from a model card."""

    card: str
    """File name of the card."""
    backend: Literal["onnxruntime", "openvino", "litert"] | None = None
    threads: int = 1
    score: Proportion | None = None
    """Minimum score of a detection; the card's by default."""
    candidate_score: Proportion = 0.1
    """Minimum score of a traffic light or stop sign where ``score`` is not specified: weak
    detections become evidence over frames (``cues.kind = "tracks"``)."""
    enlarged: bool = False
    """Look at the middle half of each picture again, enlarged twice, for lights of 6 to 12 pixels.
    The network then takes twice the time."""


def build(**given: Any) -> Detector:
    """Build the detector that a card describes.

    Raises:
        VehicleError: Settings, card, weights or back end are invalid or do not match.
    """
    settings = settings_of(ModelSettings, given, "detector model")
    path = Path(settings.card)
    card = read_card(path)
    weights = read_weights(card, weights_folder(card, path))
    if isinstance(card.output, SegmentationOutput):
        network = _network(card, weights, settings, 0.0)
        identity = _identity(card, settings, network)
        return _tried(RoadModel(card, card.output, network, str(path), identity), card, path)
    usual = card.output.score if settings.score is None else settings.score
    lowest = min(usual, settings.candidate_score) if settings.score is None else usual
    output = card.output.model_copy(update={"score": lowest})
    network = _network(card, weights, settings, output.score)
    identity = _identity(card, settings, network)
    where, again = str(path), settings.enlarged
    return _tried(BoxModel(card, output, network, where, identity, usual, again), card, path)


def _network(card: ModelCard, weights: Weights, settings: ModelSettings, score: float) -> Network:
    if card.network is None:
        size = (card.input.width_px, card.input.height_px) if card.input.is_resizable else None
        return load_network(weights, settings.backend, settings.threads, size)
    if settings.backend is not None:
        raise VehicleError(
            f"{weights.name}: tensors run in torch, not in {settings.backend}; leave backend out"
        )
    from .torchvision_weights import load_torchvision

    return load_torchvision(card, weights, score, settings.threads)


def _tried(detector: Detector, card: ModelCard, path: Path) -> Detector:
    """Run the detector on a grey picture, and return it if that succeeds."""
    size = (card.input.width_px, card.input.height_px)
    grey = np.full((size[1], size[0], 3), 114, np.uint8)
    try:
        detector([Frame(0, "", grey, size)])
    except VehicleError:
        raise
    except Exception as error:
        why = one_line(error, 200)
        raise VehicleError(
            f"{path}: the network does not run on input {size[0]} x {size[1]}, "
            f"{card.input.layout}, {card.input.dtype}: {why}; correct [input]"
        ) from None
    return detector


@dataclass(frozen=True, slots=True)
class RoadModel:
    """Detector of road pixels by semantic segmentation."""

    card: ModelCard
    output: SegmentationOutput
    network: Network
    where: str
    identity: str

    @property
    def labels(self) -> tuple[str, ...]:
        """Empty: road is not an object."""
        return ()

    @property
    def view(self) -> View:
        """The resolution that the card's input needs."""
        return view_of(self.card.input)

    def __call__(self, frames: Sequence[Frame], /) -> Sequence[Found]:
        """Return the road pixels of each frame."""
        found = []
        for frame in frames:
            road = self.road_mask(frame)
            size = (road.shape[1], road.shape[0])
            text = rle.encode_mask(road, (0, 0), size)
            found.append(RoadMask(frame.t_ns, frame.size_px, text, size))
        return found

    def road_mask(self, frame: Frame) -> NDArray[np.bool_]:
        """Segment a whole picture at the network's resolution, shape (h, w), bool.

        Black bars beside the picture are left out: a network sees edges of the road at them.
        """
        height, width = frame.pixels.shape[:2]
        bar = bars_beside(frame.pixels.reshape(height, width, -1).max(axis=(0, 2)) <= BLACK)
        pixels = frame.pixels[:, bar : width - bar]
        given, placement = prepared(pixels, self.card.input)
        try:
            raw = named(self.network(given), self.output.name)
            classes = class_map(raw, len(self.output.classes))
        except ValueError as error:
            raise VehicleError(f"{self.where}: output: {error}; correct the card") from None
        names = [i for i, name in enumerate(self.output.classes) if name in self.output.road]
        if not names:
            raise VehicleError(
                f"{self.where}: output.road: none of {', '.join(self.output.road)} is a class"
            )
        columns = _part(pixels.shape[1], placement, 0, classes, self.card.input.width_px)
        rows = _part(height, placement, 1, classes, self.card.input.height_px)
        road = np.isin(classes[rows, columns], names)
        beside = round(bar * road.shape[1] / pixels.shape[1])
        return np.pad(road, ((0, 0), (beside, beside)))


def _part(length: int, placement: Placement, axis: int, classes: Array, side_px: int) -> slice:
    """Slice of the class map that shows the picture, along x (axis 0) or y (axis 1)."""
    per_input = classes.shape[1 - axis] / side_px
    start = round(placement.offset[axis] * per_input)
    return slice(start, start + round(length * placement.scale[axis] * per_input))


def _identity(card: ModelCard, settings: ModelSettings, network: Network) -> str:
    asked = settings.model_dump(mode="json", exclude={"card", "threads"})
    return identity_of("model", VERSION, card.model_dump(mode="json"), asked, network.backend)


def class_map(raw: Array, classes: int) -> Array:
    """Class number of each pixel, shape (h, w).

    From scores (1, C, h, w) or (1, h, w, C), or from numbers (1, h, w).

    Raises:
        ValueError: The shape is different, or a class is not listed.
    """
    if raw.ndim == 4 and raw.shape[0] == 1 and raw.shape[1] == classes:
        return np.asarray(raw[0].argmax(axis=0))
    if raw.ndim == 4 and raw.shape[0] == 1 and raw.shape[3] == classes > 1:
        return np.asarray(raw[0].argmax(axis=2))
    squeezed = raw.reshape([side for side in raw.shape if side != 1])
    if squeezed.ndim != 2:
        raise ValueError(f"expected (1, {classes}, h, w) or (1, h, w), got {raw.shape}")
    numbers = np.asarray(squeezed, np.int64)
    if numbers.min() < 0 or numbers.max() >= classes:
        raise ValueError(f"class number {numbers.max()}, but {classes} classes are listed")
    return numbers
