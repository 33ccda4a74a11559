"""Lights or signs of one kind followed through the frames, each with its own range from motion.

A standing object is looked for where it must be now: as the car goes on, it moves away from the
picture's centre and grows by the ratio of the ranges before and after; as the car turns, it shifts
sideways. So two lights side by side stay two, and no range mixes their heights. A housing seen from
behind or from the side is followed, too; ``Track.facing`` says so, from the lenses seen lit.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .lens import HUES
from .range_from_motion import MotionRange, range_from_motion
from .standard_sizes import BOX_SPREAD, SizePrior, size_of

NEAR_HEIGHTS: Final = 1.0
"""A box belongs to a track whose predicted box is nearer than so many of its heights: the car's
pitch shifts a far object by about its own height, and lights stand further apart."""
GROWTH: Final = 1.5
"""And if their heights differ by less than this factor."""
SAME_IOU: Final = 0.3
"""A box that overlaps with one already taken is the same object again, not another track."""
MERGE_M: Final = 0.2
"""Observations so close to each other count as one, with their mean height."""
MAX_OBSERVATIONS: Final = 400
"""Of one track, the newest: 80 m and more."""
GONE_M: Final = 5.0
GONE_S: Final = 1.0
"""A track unseen for this way and this time is over."""
MIN_LIT: Final = 2
MIN_LIT_FRACTION: Final = 0.15
"""A light faces the car if a lens was lit in so many frames, and in this fraction of those that
were large enough: lamps flicker, hoods hide them, and the rule of one frame misses four in ten of
small or blurred ones."""
MIN_DARK: Final = 10
MAX_LIT_FRACTION: Final = 0.05
"""And does not face it if it was dark in so many frames and lit in at most this fraction."""
SAME_MAKE: Final = 0.06
"""Lights at one crossing are mostly of one make: their heights differ by this fraction, boxes drawn
tight or wide included, much less than the standard sizes do."""
SAME_ASPECT: Final = 1.2
"""If their boxes are alike, height by width, within this factor."""
OTHER_MAKE: Final = 2.0
"""And if motion does not say otherwise by more than so many standard deviations."""
MIN_SAID: Final = 0.25
"""Motion has said something once it is worth this fraction of what the standard sizes say."""
MIN_SEEN: Final = 5
"""A light seen less often says nothing about the others' make."""
STRAIGHT_RAD: Final = 0.15
"""Heights follow the way only while the car goes straight; after such a turn they start over."""


class Facing(StrEnum):
    """Whether a light is for this car to see."""

    EGO = "ego"
    AWAY = "away"
    UNKNOWN = "unknown"


class Motion(NamedTuple):
    """Of the car since the frame before.

    Attributes:
        way_m: Forwards positive; None where unknown.
        var_m2: Its variance.
        turned_rad: Counter-clockwise; 0 where unknown.
        seconds: Time passed.
    """

    way_m: float | None
    var_m2: float
    turned_rad: float
    seconds: float


@dataclass(frozen=True, slots=True)
class Lens:
    """The pinhole camera.

    Attributes:
        focal_px: Focal length.
        center_px: What does not move as the car goes straight ahead.
    """

    focal_px: float
    center_px: tuple[float, float]


@dataclass(slots=True)
class Track:
    """One object.

    Attributes:
        number: Of the track, from 1.
        box_px: Where it is now: as seen, or as predicted.
        height_px: Of its box, the same way.
        estimate: Range and height at the last observation, from this object and those alike.
        alone: The same from this object alone.
        size: What its shape alone says of its height.
        seen: In how many frames.
        is_seen: In the newest frame.
        since_m: Way gone since the last observation.
        unseen_m: The same without sign.
        unseen_s: Time since then.
        lit: In how many frames a lens was lit.
        dark: And in how many none was, though the box was large enough.
        way_scale_sd: Of the odometer, as a fraction of any way.
    """

    number: int
    box_px: NDArray[np.float64]
    height_px: float
    estimate: MotionRange
    alone: MotionRange
    size: SizePrior
    seen: int = 1
    is_seen: bool = True
    since_m: float = 0.0
    unseen_m: float = 0.0
    unseen_s: float = 0.0
    lit: int = 0
    dark: int = 0
    way_scale_sd: float = 0.0
    _way_m: list[float] = field(default_factory=list)
    _height_px: list[float] = field(default_factory=list)
    _aspect: list[float] = field(default_factory=list)
    _merged: int = 0
    _at_m: float = 0.0
    _way_var_m2: float = 0.0
    _turned_rad: float = 0.0

    @property
    def range_m(self) -> float:
        """Depth from the camera now."""
        return self.estimate.mean_m - self.since_m

    @property
    def facing(self) -> Facing:
        """From all frames so far; one that was never examined is unknown."""
        looked = self.lit + self.dark
        if self.lit >= MIN_LIT and self.lit >= MIN_LIT_FRACTION * looked:
            return Facing.EGO
        is_away = self.dark >= MIN_DARK and self.lit <= MAX_LIT_FRACTION * looked
        return Facing.AWAY if is_away else Facing.UNKNOWN

    def look(self, lens: str) -> None:
        """Take the lens of the newest frame's box (``lens_of``; empty where nobody looked)."""
        self.lit += lens in HUES
        self.dark += lens == "dark"

    @property
    def var_m2(self) -> float:
        """Its variance, the odometer's error included: a way too long is a range too far."""
        stretch = self.estimate.by_motion * self._stretch()
        return self.estimate.var_m2 + (stretch * self.estimate.mean_m) ** 2

    @property
    def aspect(self) -> float:
        """Height by width of its boxes, the median of the newest."""
        return float(np.median(self._aspect))

    def _stretch(self) -> float:
        """S.d. of the way as a fraction of it."""
        way_m = abs(self._way_m[-1] - self._way_m[0])
        if way_m < MERGE_M:
            return 0.0
        return math.hypot(self.way_scale_sd, math.sqrt(self._way_var_m2) / way_m)

    def size_by_motion(self) -> tuple[float, float] | None:
        """How much larger it is than its standard size, as mean and variance of the logarithm.

        None where motion has said nothing yet. The standard size, which the estimate holds, too, is
        taken out, so that several objects may be weighed together with it once.
        """
        found, prior = self.alone, self.size
        precision = 1.0 / found.log_height_var - 1.0 / prior.log_var
        if precision <= MIN_SAID / prior.log_var:
            return None
        mean = (found.log_height - prior.log_mean) / (found.log_height_var * precision)
        return mean, 1.0 / precision + self._stretch() ** 2

    def go_on(self, motion: Motion, lens: Lens) -> None:
        """Carry it to the next frame, where it has not been looked for yet."""
        way_m = motion.way_m or 0.0
        scale = self.range_m / max(self.range_m - way_m, 0.1 * self.range_m, 1e-3)
        shift_px = lens.focal_px * math.tan(max(min(motion.turned_rad, 1.0), -1.0))
        center = np.array([*lens.center_px, *lens.center_px])
        self.box_px = center + (self.box_px - center) * scale
        self.box_px += np.array([shift_px, 0.0, shift_px, 0.0])
        self.height_px *= scale
        self.is_seen = False
        self.since_m += way_m
        self.unseen_m += abs(way_m)
        self.unseen_s += motion.seconds
        self._at_m += way_m
        self._way_var_m2 += motion.var_m2
        self._turned_rad += motion.turned_rad
        if motion.way_m is None or abs(self._turned_rad) > STRAIGHT_RAD:
            self._forget()

    def observe(self, box_px: NDArray[np.float64], height_px: float, cue: str, lens: Lens) -> None:
        """Take the box of the newest frame."""
        width_px = float(box_px[2] - box_px[0])
        if width_px > 0.0:
            self._aspect.append(height_px / width_px)
            del self._aspect[:-MAX_OBSERVATIONS]
        if self._way_m and abs(self._at_m - self._way_m[-1]) < MERGE_M and self._merged:
            self._merged += 1
            self._height_px[-1] += (height_px - self._height_px[-1]) / self._merged
        else:
            self._way_m.append(self._at_m)
            self._height_px.append(height_px)
            self._merged = 1
            del self._way_m[:-MAX_OBSERVATIONS], self._height_px[:-MAX_OBSERVATIONS]
        self.size = size_of(cue, self.aspect if self._aspect else None)
        self.alone = self.estimate = self._ranged(self.size, lens)
        self.since_m = self._at_m - self._way_m[-1]
        self.box_px, self.height_px = box_px.copy(), height_px
        self.seen += 1
        self.is_seen, self.unseen_m, self.unseen_s = True, 0.0, 0.0

    def weigh(self, size: SizePrior, lens: Lens) -> None:
        """Take into account what objects alike say of its size."""
        self.estimate = self._ranged(size, lens)

    def _ranged(self, size: SizePrior, lens: Lens) -> MotionRange:
        return range_from_motion(
            np.array(self._way_m), np.array(self._height_px), lens.focal_px, size
        )

    def _forget(self) -> None:
        """What heights said so far fits no straight road; the last estimate stands until seen."""
        self._way_m, self._height_px, self._merged = [self._at_m], [self.height_px], 0
        self._way_var_m2 = self._turned_rad = 0.0


class ObjectTracks:
    """Follows all objects of one kind; memory holds those in view.

    Attributes:
        tracks: In the order in which they were first seen.
        counts: What became of boxes, by outcome.
    """

    def __init__(
        self,
        cue: str,
        focal_px: float,
        center_px: tuple[float, float],
        way_scale_sd: float = 0.0,
    ) -> None:
        self.tracks: list[Track] = []
        self.counts: Counter[str] = Counter()
        self._cue = cue
        self._way_scale_sd = way_scale_sd
        self._lens = Lens(focal_px, center_px)

    def __call__(
        self,
        motion: Motion,
        boxes_px: NDArray[np.float64],
        heights_px: NDArray[np.float64],
        lenses: Sequence[str] = (),
    ) -> Sequence[Track]:
        """Take the next frame's boxes.

        Args:
            motion: Of the car since the frame before.
            boxes_px: Shape (N, 4): x0, y0, x1, y1.
            heights_px: Shape (N,), positive.
            lenses: N of them, or none where nobody looked.

        Returns:
            All tracks, those unseen in this frame as predicted.
        """
        for track in self.tracks:
            track.go_on(motion, self._lens)
        lenses = lenses or [""] * len(boxes_px)
        taken = self._assign(boxes_px, heights_px, lenses)
        for i in range(len(boxes_px)):
            if i in taken:
                continue
            if any(iou(boxes_px[i], boxes_px[j]) > SAME_IOU for j in taken):
                self.counts["boxes of an object already found"] += 1
                continue
            self._begin(boxes_px[i], float(heights_px[i]), lenses[i])
            taken.append(i)
        self.tracks = [one for one in self.tracks if not _is_over(one)]
        self._share_sizes()
        return self.tracks

    def _assign(
        self, boxes_px: NDArray[np.float64], heights_px: NDArray[np.float64], lenses: Sequence[str]
    ) -> list[int]:
        """Nearest pairs first; the boxes that were taken."""
        pairs = [
            (away, i, j)
            for j, track in enumerate(self.tracks)
            for i in range(len(boxes_px))
            if (away := _away(track, boxes_px[i], float(heights_px[i]))) < NEAR_HEIGHTS
        ]
        boxes: list[int] = []
        tracks: set[int] = set()
        for _, i, j in sorted(pairs):
            if i not in boxes and j not in tracks:
                self.tracks[j].observe(boxes_px[i], float(heights_px[i]), self._cue, self._lens)
                self.tracks[j].look(lenses[i])
                boxes.append(i)
                tracks.add(j)
        return boxes

    def _share_sizes(self) -> None:
        """Weigh each object's size with those of the others alike, each taken by itself."""
        said = [
            (one, by_motion)
            for one in self.tracks
            if one.seen >= MIN_SEEN and (by_motion := one.size_by_motion()) is not None
        ]
        for one in self.tracks:
            own = one.size_by_motion()
            others = [
                by_motion
                for other, by_motion in said
                if other is not one
                and is_alike(one.aspect, other.aspect)
                and (own is None or may_be_one_make(own, by_motion))
            ]
            if others and one.is_seen:
                one.weigh(shared_size(one.size, others), self._lens)

    def _begin(self, box_px: NDArray[np.float64], height_px: float, lens: str) -> None:
        self.counts["objects followed"] += 1
        size = size_of(self._cue)
        first = range_from_motion(np.zeros(1), np.array([height_px]), self._lens.focal_px, size)
        number = self.counts["objects followed"]
        track = Track(number, box_px.copy(), height_px, first, first, size)
        track.way_scale_sd = self._way_scale_sd
        track.observe(box_px, height_px, self._cue, self._lens)
        track.look(lens)
        track.seen = 1
        self.tracks.append(track)


def is_alike(aspect: float, other: float) -> bool:
    """May two lights be of one make, by the shape of their boxes?"""
    return abs(math.log(aspect / other)) < math.log(SAME_ASPECT)


def may_be_one_make(one: tuple[float, float], other: tuple[float, float]) -> bool:
    """Do two sizes by motion agree as well as lights of one make would?"""
    var = one[1] + other[1] + 2.0 * SAME_MAKE**2
    return (one[0] - other[0]) ** 2 < OTHER_MAKE**2 * var


def difference_var_m2(one: Track, other: Track) -> float:
    """Variance of the difference of two ranges.

    Of lights of one make, what is common to their sizes does not count: it makes both ranges too
    long or too short, and the higher box is the nearer light.
    """
    apart_m2 = one.var_m2 + other.var_m2
    if not is_alike(one.aspect, other.aspect):
        return apart_m2
    ratio_var = 2.0 * (SAME_MAKE**2 + BOX_SPREAD**2)
    return min(apart_m2, ratio_var * max(one.range_m, other.range_m) ** 2)


def shared_size(size: SizePrior, others: Sequence[tuple[float, float]]) -> SizePrior:
    """An object's size, given how much larger than standard others of its make are.

    The logarithm of a size is that of the standard size, plus what is common to the make, plus the
    object's own (``SAME_MAKE``); all are Gaussian.

    Args:
        size: What its shape alone says.
        others: Mean and variance of the logarithm by ``Track.size_by_motion``, of each.
    """
    own = min(SAME_MAKE**2, 0.5 * size.log_var)
    common = size.log_var - own
    precision = 1.0 / common + sum(1.0 / (own + var) for _, var in others)
    mean = sum(off / (own + var) for off, var in others) / precision
    var = own + 1.0 / precision
    return SizePrior(math.exp(size.log_mean + mean + 0.5 * var), math.sqrt(math.expm1(var)))


def iou(one: NDArray[np.float64], other: NDArray[np.float64]) -> float:
    """Intersection over union of two boxes."""
    low, high = np.maximum(one[:2], other[:2]), np.minimum(one[2:], other[2:])
    inside = float(np.prod(np.maximum(high - low, 0.0)))
    both = float(np.prod(one[2:] - one[:2]) + np.prod(other[2:] - other[:2]))
    return inside / (both - inside) if both > inside else 0.0


def _away(track: Track, box_px: NDArray[np.float64], height_px: float) -> float:
    """Distance from the predicted box in heights; infinite if it is another's for its height."""
    if abs(math.log(height_px / track.height_px)) > math.log(GROWTH):
        return math.inf
    apart = 0.5 * (box_px[:2] + box_px[2:] - track.box_px[:2] - track.box_px[2:])
    return float(np.hypot(*apart)) / max(height_px, track.height_px)


def _is_over(track: Track) -> bool:
    is_gone = track.unseen_m > GONE_M and track.unseen_s > GONE_S
    return is_gone or track.range_m <= 0.0
