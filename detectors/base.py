"""The detector protocol, its input frames and its results."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final, Protocol, Self, TypeAlias

import numpy as np
from numpy.typing import NDArray

from . import rle

# Score above which a detection is a cue, where vehicle file and detector set no other.
MIN_SCORE: Final = 0.5
# Decision on a detection whose track over frames is accepted.
ACCEPTED: Final = "accepted"


@dataclass(frozen=True, slots=True)
class View:
    """Resolution and channels that a detector needs; a frame is decoded no finer than that.

    Attributes:
        min_width_px: Minimum width of the decoded picture; None for the full size.
        is_grey: True for one channel instead of three.
    """

    min_width_px: int | None = None
    is_grey: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One decoded picture.

    Attributes:
        t_ns: Log time.
        camera: Topic.
        pixels: Shape (H, W, 3) blue, green, red, or (H, W) grey; uint8; may be smaller than the
            camera's picture.
        size_px: Width and height of the camera's picture; detections are in its pixels.
    """

    t_ns: int
    camera: str
    pixels: NDArray[np.uint8]
    size_px: tuple[int, int]

    def __post_init__(self) -> None:
        """Reject pixels of any other shape."""
        shape = self.pixels.shape
        if len(shape) not in (2, 3) or (len(shape) == 3 and shape[2] != 3):
            raise ValueError(f"pixels: expected (H, W) or (H, W, 3), got {shape}")

    @property
    def scale(self) -> tuple[float, float]:
        """Factors from decoded pixels to the camera's, along x and along y."""
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
        lenses: N names of the lit lens (``crosscue.detectors.ranging.lens``), empty for objects
            other than traffic lights; an empty tuple where lenses were not examined.
        min_scores: Shape (N,): the score that each must exceed to be a cue, as set by its
            detector; None where the detector sets no thresholds.
        looks: N results of the second look (``detectors.signs.second_look``) at stop signs and
            lights, empty for other objects; an empty tuple where there was none.
        spans_px: Shape (N,): number of rows that each mask spans, or the height of a box without
            mask; None where masks were not measured.
        log_ratios: Log likelihood ratio of one box by label, as in a model card's ``scores``.
        decisions: N decisions by tracks over frames: ``ACCEPTED``, or why the detection is no cue;
            empty for objects that are decided by their score. An empty tuple without tracks.
    """

    t_ns: int
    size_px: tuple[int, int]
    boxes_px: NDArray[np.float64]
    scores: NDArray[np.float64]
    labels: tuple[str, ...]
    masks: tuple[bytes, ...]
    lenses: tuple[str, ...] = ()
    min_scores: NDArray[np.float64] | None = None
    looks: tuple[str, ...] = ()
    decisions: tuple[str, ...] = ()
    spans_px: NDArray[np.float64] | None = None
    log_ratios: Mapping[str, tuple[float, ...]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Reject columns of unequal length and values that are not finite.

        Raises:
            ValueError: A column does not fit; names it, the expected shape and the actual shape.
        """
        n = len(self.labels)
        if self.boxes_px.shape != (n, 4):
            raise ValueError(f"boxes_px: expected ({n}, 4), got {self.boxes_px.shape}")
        if self.scores.shape != (n,):
            raise ValueError(f"scores: expected ({n},), got {self.scores.shape}")
        if len(self.masks) != n:
            raise ValueError(f"masks: expected {n}, got {len(self.masks)}")
        for name in ("lenses", "looks", "decisions"):
            if len(getattr(self, name)) not in (0, n):
                raise ValueError(f"{name}: expected {n} or none, got {len(getattr(self, name))}")
        for name, column in (("min_scores", self.min_scores), ("spans_px", self.spans_px)):
            if column is not None and column.shape != (n,):
                raise ValueError(f"{name}: expected ({n},), got {column.shape}")
        if not (np.isfinite(self.boxes_px).all() and np.isfinite(self.scores).all()):
            raise ValueError("boxes_px, scores: expected finite numbers")

    def __len__(self) -> int:
        return len(self.labels)

    @property
    def heights_px(self) -> NDArray[np.float64]:
        """Shape (N,), the height of each object, of its mask if measured, else of its box."""
        if self.spans_px is not None:
            return self.spans_px
        return np.asarray(self.boxes_px[:, 3] - self.boxes_px[:, 1])

    def measured(self) -> Self:
        """The same detections with the heights of their masks."""
        spans = self.boxes_px[:, 3] - self.boxes_px[:, 1]
        for i, mask in enumerate(self.masks):
            if mask:
                rows = np.flatnonzero(self.mask(i).any(axis=1))
                spans[i] = rows[-1] - rows[0] + 1 if len(rows) else 0.0
        return replace(self, spans_px=spans)

    def mask(self, i: int) -> NDArray[np.bool_]:
        """Decode the mask of one detection, shape (height, width).

        Raises:
            ValueError: It has no mask, or the mask is not of this picture's size.
        """
        return rle.decode_mask(self.masks[i], self.size_px)

    def column_heights_px(self, i: int) -> NDArray[np.float64] | None:
        """Count one detection's pixels in each column of the picture; None where it has no mask.

        Raises:
            ValueError: The mask is not of this picture's size.
        """
        return rle.column_heights_px(self.masks[i], self.size_px) if self.masks[i] else None

    def of(self, label: str) -> Self:
        """The detections with this label, in the same order."""
        return self.taken(np.array([one == label for one in self.labels], np.bool_))

    def are_sure(self, setting: float | None) -> NDArray[np.bool_]:
        """Mark the detections that are a cue, by their score or by a track's decision, shape (N,).

        Args:
            setting: The vehicle file's threshold; None uses the detector's.
        """
        min_score = self.min_scores if setting is None else setting
        are_sure = np.asarray(self.scores > (MIN_SCORE if min_score is None else min_score))
        if not self.decisions:
            return are_sure
        both = zip(self.decisions, are_sure.tolist(), strict=True)
        return np.array([one == ACCEPTED if one else is_sure for one, is_sure in both], np.bool_)

    def with_min_scores(
        self, by_label: Mapping[str, float], log_ratios: Mapping[str, tuple[float, ...]] = {}
    ) -> Self:
        """The same detections with their detector's thresholds and log ratios, by label."""
        found = replace(self, log_ratios=log_ratios) if log_ratios else self
        if not by_label:
            return found
        min_score = [by_label.get(label, MIN_SCORE) for label in self.labels]
        return replace(found, min_scores=np.array(min_score, np.float64))

    def taken(self, is_taken: NDArray[np.bool_]) -> Self:
        """The detections that the mask ``is_taken``, shape (N,), selects, in the same order."""
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
            tuple(self.looks[i] for i in keep) if self.looks else (),
            tuple(self.decisions[i] for i in keep) if self.decisions else (),
            None if self.spans_px is None else self.spans_px[keep],
            self.log_ratios,
        )


def nothing_found(frame: Frame) -> Detections:
    """Return an empty result for a frame."""
    return Detections(frame.t_ns, frame.size_px, np.empty((0, 4)), np.empty(0), (), ())


def is_repeated(before: Sequence[Detections], now: Sequence[Detections]) -> bool:
    """Whether two frames have the same results and at least one detection: one picture, twice."""
    if len(before) != len(now) or not any(map(len, now)):
        return False
    return all(
        one.labels == other.labels
        and np.array_equal(one.boxes_px, other.boxes_px)
        and np.array_equal(one.scores, other.scores)
        for one, other in zip(before, now, strict=True)
    )


@dataclass(frozen=True, slots=True)
class RoadMask:
    """Road pixels of one frame.

    Attributes:
        t_ns: Log time of the frame.
        size_px: Width and height of the picture.
        mask: Compressed runs (``crosscue.detectors.rle``) over the whole picture, at a lower
            resolution.
        mask_size_px: Width and height of the mask.
    """

    t_ns: int
    size_px: tuple[int, int]
    mask: bytes
    mask_size_px: tuple[int, int]

    def pixels(self) -> NDArray[np.bool_]:
        """Decode the mask, shape (height, width); True where a pixel is road.

        Raises:
            ValueError: The mask is damaged or of another size.
        """
        return rle.decode_mask(self.mask, self.mask_size_px)


Found: TypeAlias = Detections | RoadMask


def bars_beside(is_empty: NDArray[np.bool_]) -> int:
    """Number of columns of each of two bars beside a picture of another shape; 0 without bars.

    Args:
        is_empty: Of each column, whether it can belong to a bar.
    """
    width, within = len(is_empty), np.flatnonzero(~is_empty)
    if not len(within):
        return 0
    left, right = int(within[0]), width - 1 - int(within[-1])
    are_bars = abs(left - right) <= 0.01 * width and min(left, right) >= 0.02 * width
    return max(left, right) if are_bars else 0


class Detector(Protocol):
    """Finds objects or road in frames, without memory of earlier frames (that is a tracker).

    A detector may have two more attributes. ``labels`` is a tuple of all class names that it can
    report, empty for a detector of road; without it, any class is possible. A cue whose labels no
    detector can report is not evaluated. ``min_scores`` maps a label to the score above which a
    detection is a cue.
    """

    @property
    def view(self) -> View:
        """Resolution and channels of the frames that it needs."""
        ...

    @property
    def identity(self) -> str:
        """Text that changes whenever the output could: with version, settings or weights."""
        ...

    def __call__(self, frames: Sequence[Frame], /) -> Sequence[Found]:
        """Return one result for each frame, in order; an empty result is valid."""
        ...


def is_calibrated(detector: Detector) -> bool:
    """Whether a detector declares its scores to be probabilities (``is_calibrated = True``)."""
    return bool(getattr(detector, "is_calibrated", False))


def min_scores_of(detector: Detector) -> dict[str, float]:
    """Map each label to the score above which it is a cue; only labels with a threshold."""
    found: Mapping[str, float] = getattr(detector, "min_scores", {})
    return dict(found)


def log_ratios_of(detector: Detector) -> dict[str, tuple[float, ...]]:
    """Map each label to the log likelihood ratio of one box, where the detector states it."""
    return dict(getattr(detector, "log_ratios", {}))


def calibrated_labels(detector: Detector) -> tuple[str, ...]:
    """Labels whose scores are probabilities by a fitted calibration, sorted."""
    labels: Sequence[str] = getattr(detector, "calibrated_labels", ())
    return tuple(sorted(labels))


def reportable(detector: Detector) -> tuple[str, ...] | None:
    """All class names that a detector can report, sorted; None where it declares none."""
    labels: Sequence[str] | None = getattr(detector, "labels", None)
    return None if labels is None else tuple(sorted({*labels}))


def fault_of(found: Found, frame: Frame, labels: Sequence[str] | None) -> str | None:
    """Explain how a result breaks the contract of ``Detector``; None if it keeps it.

    Masks are not decoded.

    Args:
        found: The result for ``frame``.
        frame: The frame.
        labels: All labels that the detector declares; None for any.
    """
    if not isinstance(found, Detections | RoadMask):
        return f"returned a {type(found).__name__}; expected Detections or RoadMask"
    if found.t_ns != frame.t_ns or found.size_px != frame.size_px:
        have, want = (found.t_ns, found.size_px), (frame.t_ns, frame.size_px)
        return f"time and size of the result are {have}; expected the frame's, {want}"
    return None if isinstance(found, RoadMask) else _fault_of_boxes(found, labels)


def _fault_of_boxes(found: Detections, labels: Sequence[str] | None) -> str | None:
    boxes, ends = found.boxes_px, (*found.size_px, *found.size_px)
    is_ordered = np.all(boxes[:, :2] <= boxes[:, 2:], axis=1)
    is_inside = np.all((boxes >= 0.0) & (boxes <= ends), axis=1)
    # Clipped corners may be 0, and nothing is within one pixel.
    is_in_pixels = ~np.all((boxes > 0.0) & (boxes <= 1.0), axis=1)
    is_fraction = (found.scores >= 0.0) & (found.scores <= 1.0)
    is_known = np.array([bool(x) and (labels is None or x in labels) for x in found.labels], bool)
    wrong = np.flatnonzero(~(is_ordered & is_inside & is_in_pixels & is_fraction & is_known))
    if not len(wrong):
        return None
    i = int(wrong[0])
    corners = ", ".join(f"{value:g}" for value in boxes[i].tolist())
    where = f"box {i} of {len(boxes)}, {found.labels[i]!r} at ({corners})"
    if not is_ordered[i]:
        return f"{where}: x1 < x0 or y1 < y0; expected x0, y0, x1, y1 and not a width and a height"
    if not is_inside[i]:
        return f"{where}: not inside the picture of {found.size_px} px; clip it"
    if not is_in_pixels[i]:
        return f"{where}: corners below 1; expected pixels, not fractions of the picture"
    if not is_fraction[i]:
        return f"{where}: score {found.scores[i]:g}; expected 0 to 1"
    return f"{where}: label not declared; expected one of {', '.join(labels or ('any text',))}"


@dataclass(frozen=True, slots=True)
class DetectorChoice:
    """A requested detector, not yet built.

    Attributes:
        name: Name in tables.
        kind: Name, ``module:factory`` or model card, as in ``crosscue.detectors.registry``.
        settings: Keyword arguments of its factory.
        factory: The factory itself, of a detector that was passed as an object.
        identity: Identity of such a detector, which no name reports; otherwise None.
    """

    name: str
    kind: str
    settings: Mapping[str, Any] = field(default_factory=dict)
    factory: Callable[..., Any] | None = None
    identity: str | None = None

    def as_row(self) -> dict[str, object]:
        """Return what decides the detector's results, as JSON."""
        row: dict[str, object] = {
            "name": self.name,
            "kind": self.kind,
            "settings": dict(self.settings),
        }
        return row if self.identity is None else {**row, "identity": self.identity}
