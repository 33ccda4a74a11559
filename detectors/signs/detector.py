"""Detect one-way and do-not-enter signs: pyramid, ORB, ratio test, votes in windows (eq. 17).

The dissertation runs ORB in every window of every level. Here points are found once per level.
Each point that matches a point of a drawing votes for the position of the sign's centre that the
match implies. A window counts the distinct points of the drawing that vote for it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Final

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from crosscue.detectors.base import Detections, Detector, Found, Frame, View
from crosscue.detectors.settings import Proportion, Settings, identity_of, settings_of

from .matching import Counts, Words, nearest, window_counts
from .templates import AMERICAN, LABELS, Kind, SignTemplate, drawings

VERSION: Final = 1
# Maximum number of points of a drawing; more than any has.
POINTS_DRAWN: Final = 500
# Minimum side of a pyramid level; ORB's border of 8 pixels and patch of 16 leave too little of a
# smaller one.
MIN_SIDE_PX: Final = 32
# Side of the cells in which votes are counted.
_CELL_PX: Final = 4
# Intersection over union above which two windows are the same sign.
_SAME_SIGN: Final = 0.5


class SignSettings(Settings):
    """Settings of the search; ``crosscue fit signs`` fits ``min_score``."""

    kinds: tuple[Kind, ...] = AMERICAN
    """Kinds of signs to detect. The international disc has few corners and needs its own threshold,
    so search for it alone."""
    heights_px: tuple[Annotated[int, Field(ge=16, le=256)], ...] = (48, 64)
    """Heights of the drawings, in pixels of a pyramid level."""
    levels: Annotated[int, Field(ge=1, le=16)] = 14
    """Number of pyramid levels. 14 levels find signs up to 460 pixels high, which is a sign of
    0.75 m at 3 m for a focal length of 1970 pixels. Nine levels found no sign above 190 pixels."""
    factor: Annotated[float, Field(gt=1.0, le=2.0)] = 1.25
    """Scale factor between successive levels of the pyramid."""
    enlarge: Annotated[float, Field(ge=1.0, le=4.0)] = 2.5
    """Enlargement of the first level, for signs smaller than the drawings."""
    points: Annotated[int, Field(ge=50, le=20000)] = 4000
    """Maximum number of points per level."""
    drawing_fast: Annotated[int, Field(ge=1, le=100)] = 6
    """Minimum contrast of a point in a drawing (FAST threshold)."""
    ratio: Proportion = 0.9
    fast: Annotated[int, Field(ge=1, le=100)] = 6
    """Minimum contrast of a point in a picture (FAST threshold)."""
    reach: Proportion = 0.1
    """Tolerance of a vote around the sign's centre, as a fraction of the sign's height."""
    crop_top: Proportion = 0.0
    """Fraction of the picture to crop at the top."""
    crop_bottom: Proportion = 0.25
    """Fraction of the picture to crop at the bottom."""
    max_bits: Annotated[int, Field(ge=1, le=256)] = 64
    """Number of differing bits of 256 below which two descriptors can match."""
    min_votes: Annotated[int, Field(ge=2)] = 4
    """Minimum number of distinct points that vote for a sign."""
    min_fraction: Proportion = 0.25
    """Minimum fraction of the drawing's points that vote for a sign."""
    min_score: Proportion = 0.065
    """Minimum score of a sign. The default is for precision 0.95 on simulated layouts L800 to L838;
    fit it to your camera."""
    overlap: Proportion = 0.2
    """Overlap of two signs above which only the better is kept."""


@dataclass(frozen=True, slots=True, eq=False)
class Points:
    """ORB points of a picture or of drawings, as columns of length N.

    Attributes:
        at_px: Positions, shape (N, 2), float64.
        words: Descriptors, shape (N, 4), uint64.
    """

    at_px: NDArray[np.float64]
    words: Words


def orb_points(grey: NDArray[np.uint8], max_points: int, fast: int = 10) -> Points:
    """Find points with upright descriptors, in patches small enough for signs of 50 pixels.

    Signs are upright. Rotation-invariant descriptors would confuse a left arrow with a right one,
    and the two ends of a bar with each other; the ratio test then removes both ends.
    """
    import cv2

    # OpenCV's defaults, a border and a patch of 31 pixels, leave no point in a window of 64.
    orb = cv2.ORB.create(
        nfeatures=max_points, nlevels=1, edgeThreshold=8, patchSize=16, fastThreshold=fast
    )
    # ORB detects with FAST, then selects the best points and computes angles. Neither is needed
    # if all points are kept.
    keypoints = cv2.FastFeatureDetector.create(fast).detect(grey, None)
    if len(keypoints) > max_points:
        keypoints = orb.detect(grey, None)
    for keypoint in keypoints:
        keypoint.angle = 0.0
    keypoints, descriptors = orb.compute(grey, keypoints)
    if descriptors is None or not len(keypoints):
        return Points(np.empty((0, 2)), np.empty((0, 4), np.uint64))
    at = np.asarray(cv2.KeyPoint.convert(keypoints), np.float64)
    return Points(at, np.ascontiguousarray(descriptors).view(np.uint64))


@dataclass(frozen=True, slots=True, eq=False)
class _Gallery:
    """Points of all drawings, concatenated."""

    drawn: tuple[SignTemplate, ...]
    points: Points
    first: NDArray[np.int64]
    to_middle_px: NDArray[np.float64]


def _gallery(settings: SignSettings) -> _Gallery:
    drawn = drawings(settings.kinds, settings.heights_px)
    found = [orb_points(one.grey, POINTS_DRAWN, settings.drawing_fast) for one in drawn]
    first = np.concatenate([[0], np.cumsum([len(p.words) for p in found])]).astype(np.int64)
    middles = [
        np.array(one.grey.shape[::-1]) / 2.0 - p.at_px for one, p in zip(drawn, found, strict=True)
    ]
    points = Points(
        np.concatenate([p.at_px for p in found]),
        np.concatenate([p.words for p in found]),
    )
    return _Gallery(tuple(drawn), points, first, np.concatenate(middles))


def build(**given: Any) -> Detector:
    """Build the detector from settings by name.

    Raises:
        VehicleError: A setting is unknown or invalid.
    """
    settings = settings_of(SignSettings, given, "detector signs")
    return SignDetector(settings, _gallery(settings))


@dataclass(frozen=True, slots=True)
class SignDetector:
    """Finds signs that match the stored drawings."""

    settings: SignSettings
    gallery: _Gallery

    @property
    def labels(self) -> tuple[str, ...]:
        """Labels of the kinds that it searches for."""
        return tuple(LABELS.get(kind, kind) for kind in self.settings.kinds)

    @property
    def view(self) -> View:
        """Full size, because signs are small, and grey."""
        return View(is_grey=True)

    @property
    def identity(self) -> str:
        """Text that changes with the settings and OpenCV's version."""
        import cv2

        return identity_of("signs", VERSION, self.settings.model_dump(mode="json"), cv2.__version__)

    def __call__(self, frames: Sequence[Frame], /) -> Sequence[Found]:
        """Return the signs in each frame."""
        return [self._one(frame) for frame in frames]

    def _one(self, frame: Frame) -> Detections:
        height = frame.pixels.shape[0]
        top = int(height * self.settings.crop_top)
        bottom = height - int(height * self.settings.crop_bottom)
        grey = frame.pixels[top:bottom]
        candidates: list[tuple[float, Kind, NDArray[np.float64]]] = []
        for level in range(self.settings.levels if grey.size else 0):
            scale = self.settings.enlarge / self.settings.factor**level
            candidates += self._level(grey, scale)
        best = _apart(candidates, self.settings.overlap)
        kept = [one for one in best if one[0] >= self.settings.min_score]
        stretch = np.tile(np.array(frame.scale), 2)
        boxes = np.array([box for _, _, box in kept], np.float64).reshape(-1, 4)
        boxes = (boxes + np.array([0, top, 0, top])) * stretch
        boxes = np.clip(boxes, 0.0, np.tile(np.array(frame.size_px, np.float64), 2))
        labels = tuple(LABELS.get(kind, kind) for _, kind, _ in kept)
        scores = np.array([score for score, _, _ in kept])
        return Detections(frame.t_ns, frame.size_px, boxes, scores, labels, (b"",) * len(labels))

    def _level(
        self, grey: NDArray[np.uint8], scale: float
    ) -> list[tuple[float, Kind, NDArray[np.float64]]]:
        import cv2

        size = (round(grey.shape[1] * scale), round(grey.shape[0] * scale))
        if min(size) < MIN_SIDE_PX:
            return []
        mode = cv2.INTER_AREA if scale < 1.0 else cv2.INTER_LINEAR
        level = np.asarray(cv2.resize(grey, size, interpolation=mode), np.uint8)
        points = orb_points(level, self.settings.points, self.settings.fast)
        matched = nearest(
            points.words,
            self.gallery.points.words,
            self.gallery.first,
            self.settings.ratio,
            self.settings.max_bits,
        )
        found: list[tuple[float, Kind, NDArray[np.float64]]] = []
        for k, drawing in enumerate(self.gallery.drawn):
            which = np.flatnonzero(matched[k] >= 0)
            at = matched[k, which]
            # Small integers allow numpy's radix sort.
            order = np.argsort((at - self.gallery.first[k]).astype(np.uint16), kind="stable")
            which, at = which[order], at[order]
            votes = points.at_px[which] + self.gallery.to_middle_px[at]
            points_drawn = int(self.gallery.first[k + 1] - self.gallery.first[k])
            found += self._windows(votes, at, level.shape, drawing, points_drawn, scale)
        return found

    def _windows(
        self,
        votes: NDArray[np.float64],
        at: NDArray[np.int64],
        shape: tuple[int, ...],
        drawing: SignTemplate,
        points_drawn: int,
        scale: float,
    ) -> list[tuple[float, Kind, NDArray[np.float64]]]:
        reach = max(round(self.settings.reach * drawing.size_px[1] / _CELL_PX), 1)
        rows, columns = shape[0] // _CELL_PX + 1, shape[1] // _CELL_PX + 1
        cells = np.floor(votes / _CELL_PX).astype(np.int64)
        counts = window_counts(cells, at, rows, columns, reach)
        min_count = max(self.settings.min_fraction * points_drawn, self.settings.min_votes)
        if counts.max(initial=0) < min_count:
            return []
        half = np.array(drawing.size_px) / 2.0
        found = []
        for row, column in np.argwhere(_is_peak(counts, reach) & (counts >= min_count)):
            middle = (np.array([column, row]) + 0.5) * _CELL_PX
            box = np.concatenate([middle - half, middle + half]) / scale
            found.append((float(counts[row, column]) / points_drawn, drawing.kind, box))
        return found


def _is_peak(counts: Counts, reach: int) -> NDArray[np.bool_]:
    import cv2

    # A peak is the maximum within reach; OpenCV's dilation computes that maximum.
    around = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    values = counts.astype(np.float32)
    return np.asarray(values >= cv2.dilate(values, around), np.bool_)


def _apart(
    candidates: list[tuple[float, Kind, NDArray[np.float64]]], overlap: float
) -> list[tuple[float, Kind, NDArray[np.float64]]]:
    """Keep the best windows, without those that overlap a better one of any kind.

    A sign is found on neighbouring levels and by drawings of several sizes, a chance match rarely
    is. So a window's score is its fraction of the drawing's points, times S / (S + 1), where S is
    the sum of the fractions of all overlapping windows of its kind.
    """
    from crosscue.detectors.boxes import box_ious

    if not candidates:
        return []
    boxes = np.array([box for _, _, box in candidates])
    fractions = np.array([fraction for fraction, _, _ in candidates])
    kinds = np.array([kind for _, kind, _ in candidates])
    sums = np.array(
        [
            fractions[(box_ious(box, boxes) > _SAME_SIGN) & (kinds == kind)].sum()
            for _, kind, box in candidates
        ]
    )
    scores = fractions * sums / (sums + 1.0)
    kept: list[int] = []
    for i in np.lexsort((-fractions, -scores)).tolist():
        if not kept or float(box_ious(boxes[i], boxes[kept]).max()) <= overlap:
            kept.append(i)
    return [(float(scores[i]), candidates[i][1], boxes[i]) for i in kept]
