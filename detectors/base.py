"""What every detector takes and gives."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, Self, TypeAlias

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.columns import Bytes, Floats


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
    pixels: Bytes
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
            where the detector gives only a box.
        lenses: N names of the lit lens (``crosscue.detectors.ranging.lens``), empty for what is no
            traffic light; no entries at all where nobody looked.
    """

    t_ns: int
    size_px: tuple[int, int]
    boxes_px: Floats
    scores: Floats
    labels: tuple[str, ...]
    masks: tuple[bytes, ...]
    lenses: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Refuse columns that do not line up, and numbers that are none.

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
        if not (np.isfinite(self.boxes_px).all() and np.isfinite(self.scores).all()):
            raise ValueError("boxes_px, scores: expected finite numbers")

    def __len__(self) -> int:
        return len(self.labels)

    @property
    def heights_px(self) -> Floats:
        """Height of each box, shape (N,)."""
        return np.asarray(self.boxes_px[:, 3] - self.boxes_px[:, 1])

    def of(self, label: str) -> Self:
        """The detections with this label, in the same order."""
        return self.taken(np.array([one == label for one in self.labels], np.bool_))

    def above(self, score: float) -> Self:
        """The detections with a score of at least ``score``, in the same order."""
        return self.taken(self.scores >= score)

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


Found: TypeAlias = Detections | RoadMask


class Detector(Protocol):
    """From frames to what is in each; no memory of earlier frames (that is a tracker).

    It may have ``labels``, a tuple of all class names that it can report: none for one of road. A
    cue whose labels no detector can report is not looked for; without ``labels`` it may be any.
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


def reportable(detector: Detector) -> tuple[str, ...] | None:
    """All class names that a detector can report, sorted; None where it does not say."""
    labels: Sequence[str] | None = getattr(detector, "labels", None)
    return None if labels is None else tuple(sorted({*labels}))


@dataclass(frozen=True, slots=True)
class Choice:
    """One detector as asked for.

    Attributes:
        name: What it is called in tables.
        kind: As the module's text says.
        settings: For its factory.
    """

    name: str
    kind: str
    settings: Mapping[str, Any] = field(default_factory=dict)
