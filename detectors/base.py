"""What every detector takes and returns."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final, Protocol, Self, TypeAlias

import numpy as np
from numpy.typing import NDArray

from . import rle

MIN_SCORE: Final = 0.5
"""A detection is a cue above this score, where neither vehicle file nor detector says more."""


@dataclass(frozen=True, slots=True)
class View:
    """The pixels a detector asks for; a frame is decoded no finer than that.

    Attributes:
        min_width_px: Any picture at least this wide will do; None for the full size.
        is_grey: One channel instead of three.
    """

    min_width_px: int | None = None
    is_grey: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One decoded picture.

    Attributes:
        t_ns: Log time.
        camera: Topic.
        pixels: Shape (H, W, 3) blue, green, red, or (H, W) grey; uint8; perhaps smaller than the
            picture the camera took.
        size_px: Width and height of the picture the camera took; detections are given in these.
    """

    t_ns: int
    camera: str
    pixels: NDArray[np.uint8]
    size_px: tuple[int, int]

    def __post_init__(self) -> None:
        """Refuse pixels of another shape."""
        shape = self.pixels.shape
        if len(shape) not in (2, 3) or (len(shape) == 3 and shape[2] != 3):
            raise ValueError(f"pixels: expected (H, W) or (H, W, 3), got {shape}")

    @property
    def scale(self) -> tuple[float, float]:
        """From decoded pixels to the camera's: along x and along y."""
        height, width = self.pixels.shape[:2]
        return self.size_px[0] / width, self.size_px[1] / height


@dataclass(frozen=True, slots=True, eq=False)
class Detections:
    """All objects one detector found in one frame, as columns of equal length N.

    Attributes:
        t_ns: Log time of the frame.
        size_px: Width and height of the picture.
        boxes_px: Shape (N, 4), float64: x0, y0, x1, y1, origin at the top-left pixel's corner.
        scores: Shape (N,), float64, in [0, 1]; comparable only within one detector.
        labels: N class names.
        masks: N masks as compressed runs over the picture (``crosscue.detectors.rle``), empty
            where the detector returns only a box.
        lenses: N names of the lit lens (``crosscue.detectors.ranging.lens``), empty for what is no
            traffic light; no entries at all where nobody looked.
        min_scores: Shape (N,): the score that each has to exceed to be a cue, as its detector says;
            None where it says nothing.
    """

    t_ns: int
    size_px: tuple[int, int]
    boxes_px: NDArray[np.float64]
    scores: NDArray[np.float64]
    labels: tuple[str, ...]
    masks: tuple[bytes, ...]
    lenses: tuple[str, ...] = ()
    min_scores: NDArray[np.float64] | None = None

    def __post_init__(self) -> None:
        """Refuse columns that do not line up, and values that are not finite.

        Raises:
            ValueError: Naming the column, the shape wanted and the shape given.
        """
        n = len(self.labels)
        if self.boxes_px.shape != (n, 4):
            raise ValueError(f"boxes_px: expected ({n}, 4), got {self.boxes_px.shape}")
        if self.scores.shape != (n,):
            raise ValueError(f"scores: expected ({n},), got {self.scores.shape}")
        if len(self.masks) != n:
            raise ValueError(f"masks: expected {n}, got {len(self.masks)}")
        if len(self.lenses) not in (0, n):
            raise ValueError(f"lenses: expected {n} or none, got {len(self.lenses)}")
        if self.min_scores is not None and self.min_scores.shape != (n,):
            raise ValueError(f"min_scores: expected ({n},), got {self.min_scores.shape}")
        if not (np.isfinite(self.boxes_px).all() and np.isfinite(self.scores).all()):
            raise ValueError("boxes_px, scores: expected finite numbers")

    def __len__(self) -> int:
        return len(self.labels)

    @property
    def heights_px(self) -> NDArray[np.float64]:
        """Height of each box, shape (N,)."""
        return np.asarray(self.boxes_px[:, 3] - self.boxes_px[:, 1])

    def mask(self, i: int) -> NDArray[np.bool_]:
        """Pixels of one detection in the picture, shape (height, width).

        Raises:
            ValueError: It has no mask, or not one of this picture.
        """
        return rle.decode(self.masks[i], self.size_px)

    def column_heights_px(self, i: int) -> NDArray[np.float64] | None:
        """Pixels of one detection in each column of the picture; None where it has no mask.

        Raises:
            ValueError: The mask is not one of this picture.
        """
        return rle.column_heights_px(self.masks[i], self.size_px) if self.masks[i] else None

    def of(self, label: str) -> Self:
        """The detections with this label, in the same order."""
        return self.taken(np.array([one == label for one in self.labels], np.bool_))

    def above(self, score: float) -> Self:
        """The detections with a score of at least ``score``, in the same order."""
        return self.taken(self.scores >= score)

    def are_sure(self, setting: float | None) -> NDArray[np.bool_]:
        """Which detections are sure enough to be a cue, shape (N,).

        Args:
            setting: The vehicle file's threshold; without one the detector's holds.
        """
        min_score = self.min_scores if setting is None else setting
        return np.asarray(self.scores > (MIN_SCORE if min_score is None else min_score))

    def with_min_scores(self, by_label: Mapping[str, float]) -> Self:
        """The same detections with the thresholds that their detector has for their labels."""
        if not by_label:
            return self
        min_score = [by_label.get(label, MIN_SCORE) for label in self.labels]
        return replace(self, min_scores=np.array(min_score, np.float64))

    def taken(self, is_taken: NDArray[np.bool_]) -> Self:
        """The detections that shape (N,) marks, in the same order."""
        keep = np.flatnonzero(is_taken)
        return type(self)(
            self.t_ns,
            self.size_px,
            self.boxes_px[keep],
            self.scores[keep],
            tuple(self.labels[i] for i in keep),
            tuple(self.masks[i] for i in keep),
            tuple(self.lenses[i] for i in keep) if self.lenses else (),
            None if self.min_scores is None else self.min_scores[keep],
        )


def nothing_found(frame: Frame) -> Detections:
    """An empty result."""
    return Detections(frame.t_ns, frame.size_px, np.empty((0, 4)), np.empty(0), (), ())


@dataclass(frozen=True, slots=True)
class RoadMask:
    """Which pixels of one frame are road.

    Attributes:
        t_ns: Log time of the frame.
        size_px: Width and height of the picture.
        mask: Compressed runs (``crosscue.detectors.rle``) over the whole picture, coarser than it.
        mask_size_px: Width and height of the mask.
    """

    t_ns: int
    size_px: tuple[int, int]
    mask: bytes
    mask_size_px: tuple[int, int]

    def pixels(self) -> NDArray[np.bool_]:
        """Which of the mask's pixels are road, shape (height, width).

        Raises:
            ValueError: The mask is not one.
        """
        return rle.decode(self.mask, self.mask_size_px)


Found: TypeAlias = Detections | RoadMask


class Detector(Protocol):
    """From frames to what is in each; no memory of earlier frames (that is a tracker).

    It may have ``labels``, a tuple of all class names that it can report: none for one of road. A
    cue whose labels no detector can report is not looked for; without ``labels`` it may be any. It
    may have ``min_scores``, from label to the score above which a detection is a cue.
    """

    @property
    def view(self) -> View:
        """The pixels it asks for."""
        ...

    @property
    def identity(self) -> str:
        """Text that changes whenever its output could, as of version, settings or weights."""
        ...

    def __call__(self, frames: Sequence[Frame], /) -> Sequence[Found]:
        """One result for each frame, in order; an empty one is valid."""
        ...


def is_calibrated(detector: Detector) -> bool:
    """Whether a detector says that its scores are probabilities (``is_calibrated = True``)."""
    return bool(getattr(detector, "is_calibrated", False))


def min_scores_of(detector: Detector) -> dict[str, float]:
    """From label to the score above which a detection is a cue, as far as the detector says."""
    found: Mapping[str, float] = getattr(detector, "min_scores", {})
    return dict(found)


def calibrated_labels(detector: Detector) -> tuple[str, ...]:
    """Labels whose scores a fitted calibration has turned into probabilities, sorted."""
    labels: Sequence[str] = getattr(detector, "calibrated_labels", ())
    return tuple(sorted(labels))


def reportable(detector: Detector) -> tuple[str, ...] | None:
    """All class names that a detector can report, sorted; None where it does not say."""
    labels: Sequence[str] | None = getattr(detector, "labels", None)
    return None if labels is None else tuple(sorted({*labels}))


@dataclass(frozen=True, slots=True)
class Choice:
    """One detector as requested.

    Attributes:
        name: What it is called in tables.
        kind: As the module's text says.
        settings: For its factory.
    """

    name: str
    kind: str
    settings: Mapping[str, Any] = field(default_factory=dict)
