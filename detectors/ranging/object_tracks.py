"""Track lights or signs of one kind over frames, each with its own range from motion.

The position of a standing object is predicted. As the car drives, the object moves away from the
picture's centre and grows by the ratio of the ranges before and after. As the car turns, it shifts
sideways. Two adjacent lights therefore remain two tracks, and no range mixes their heights.
Housings seen from behind or from the side are tracked, too; ``ObjectTrack.facing`` distinguishes
them by their lit lenses.

A track is accepted by Wald's sequential probability ratio test (A. Wald, *Sequential Analysis*,
1947): each frame adds the log likelihood ratio of its box, or of its absence. Successive frames
resemble each other, so a frame counts less the sooner it follows the last one.
"""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from statistics import median
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from crosscue.detectors.boxes import box_ious

from .range_from_motion import MotionRange, range_from_motion, range_from_size
from .standard_sizes import BOX_SPREAD, SizePrior, size_prior

# Maximum distance of a box from a track's predicted box, in heights of the box: the car's pitch
# shifts a distant object by about its own height, and lights are further apart.
NEAR_HEIGHTS: Final = 1.0
# Maximum ratio of the heights of a box and a track's predicted box.
GROWTH: Final = 1.5
# Time between two frames up to which these limits also hold where the car's motion is unknown; they
# widen in proportion beyond.
UNSEEN_S: Final = 0.2
# Intersection over union above which a box is the same object as an assigned box.
SAME_IOU: Final = 0.3
# Distance travelled within which observations are merged to one, with their mean height.
MERGE_M: Final = 0.2
# Maximum number of observations of a track; the newest, over 80 m or more, are kept.
MAX_OBSERVATIONS: Final = 400
GONE_M: Final = 5.0
# A track ends after this time (and the distance ``GONE_M``) without an observation.
GONE_S: Final = 1.0
# Colours of a lit lens. Yellow is also the paint of housings seen from behind, and it is lit for a
# few seconds only.
SIGNALS: Final = ("red", "green")
MIN_LIT: Final = 2
# A light faces the car if a lens was lit in ``MIN_LIT`` frames and in this fraction of the frames
# where the box was large enough. The fraction is low because lamps flicker, hoods hide them, and
# the rule for one frame misses four in ten small or blurred lenses.
MIN_LIT_FRACTION: Final = 0.15
MIN_DARK: Final = 10
# A light does not face the car if it was dark in ``MIN_DARK`` frames, and lit or yellow in at most
# this fraction.
MAX_LIT_FRACTION: Final = 0.05
# Relative spread of the heights of lights at one intersection, which are mostly of one make. It
# includes the errors of the boxes and is much less than the spread of standard sizes.
SAME_MAKE: Final = 0.06
# Maximum ratio of the aspects (height over width) of two lights of one make.
SAME_ASPECT: Final = 1.2
# Maximum difference of the sizes by motion of two lights of one make, in standard deviations.
OTHER_MAKE: Final = 2.0
# Minimum information on the size by motion, as a fraction of that of the standard sizes.
MIN_INFORMATION: Final = 0.25
# Minimum number of frames of a light for it to inform the size of others.
MIN_SEEN: Final = 5
# Turn after which a track restarts, because range from motion assumes a straight path.
STRAIGHT_RAD: Final = 0.15
# Correlation time of a detector's errors on one object. Evidence of a second is the same at any
# frame rate above 10 Hz, and about 5 independent frames.
RESEMBLE_S: Final = 0.1
# Evidence of an accepted track, of one whose acceptance is taken back, and of one that is given up.
ACCEPTED: Final = math.log(0.95 / 0.05)
TAKEN_BACK: Final = 0.0
GIVEN_UP: Final = -2.0
# Minimum number of frames of an accepted track.
MIN_HITS: Final = 3
# Evidence of a frame in which the object is not found.
MISSED: Final = -0.35


class Facing(StrEnum):
    """Direction of a traffic light, relative to the ego vehicle."""

    EGO = "ego"
    AWAY = "away"
    UNKNOWN = "unknown"


class CarStep(NamedTuple):
    """Motion of the car since the previous frame.

    Attributes:
        way_m: Distance travelled, forwards positive; None where unknown.
        var_m2: Variance of ``way_m``.
        turned_rad: Change of heading, counter-clockwise; 0 where unknown.
        seconds: Duration.
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
        center_px: Pixel that is stationary while the car drives straight ahead.
    """

    focal_px: float
    center_px: tuple[float, float]


@dataclass(slots=True)
class ObjectTrack:
    """Track of one object.

    Attributes:
        number: Number of the track, from 1.
        box_px: Current box, observed or predicted.
        height_px: Current height of the box, observed or predicted.
        size: Prior of its height, from its aspect.
        seen: Number of frames with an observation.
        is_seen: True if it was observed in the newest frame.
        since_m: Distance travelled since the last observation.
        unseen_m: Absolute distance travelled since the last observation.
        unseen_s: Time since the last observation.
        lit: Number of frames in which a red or green lens was lit.
        yellow: Number of frames in which a spot of the box was yellow: a lens, or the housing.
        dark: Number of frames in which no lens was lit although the box was large enough.
        way_scale_sd: Relative standard deviation of the odometer's scale.
        evidence: Log likelihood ratio of an object against none, from all frames so far.
        hits: Number of frames with an observation and a new picture.
        is_accepted: True once the evidence was sufficient, until it is against an object.
        is_way_unknown: True if the distance travelled to the newest frame is unknown.
        looks: Area of the boxes, in pixels, by the result of the second look at them.
        aspect: Height over width, as the median of its newest boxes.
    """

    number: int
    box_px: NDArray[np.float64]
    height_px: float
    size: SizePrior
    lens: Lens
    seen: int = 0
    is_seen: bool = True
    since_m: float = 0.0
    unseen_m: float = 0.0
    unseen_s: float = 0.0
    lit: int = 0
    yellow: int = 0
    dark: int = 0
    way_scale_sd: float = 0.0
    evidence: float = 0.0
    hits: int = 0
    is_accepted: bool = False
    is_way_unknown: bool = False
    looks: Counter[str] = field(default_factory=Counter)
    aspect: float = math.nan
    _way_m: list[float] = field(default_factory=list)
    _height_px: list[float] = field(default_factory=list)
    _aspect: list[float] = field(default_factory=list)
    _merged: int = 0
    _at_m: float = 0.0
    _way_var_m2: float = 0.0
    _turned_rad: float = 0.0
    _alone: MotionRange | None = None
    _weighed: MotionRange | None = None

    @property
    def alone(self) -> MotionRange:
        """Range and height at the last observation, from this object only.

        It is computed when it is first needed, and from the size alone until the track is accepted.
        """
        if self._alone is None:
            self._alone = self._ranged(self.size)
        return self._alone

    @property
    def estimate(self) -> MotionRange:
        """Range and height at the last observation, from this object and similar ones."""
        return self.alone if self._weighed is None else self._weighed

    @property
    def range_m(self) -> float:
        """Current depth from the camera."""
        return self.estimate.mean_m - self.since_m

    @property
    def facing(self) -> Facing:
        """Direction from all frames so far; unknown without frames of sufficient size."""
        examined = self.lit + self.dark
        if self.lit >= MIN_LIT and self.lit >= MIN_LIT_FRACTION * examined:
            return Facing.EGO
        coloured = self.lit + self.yellow
        is_away = self.dark >= MIN_DARK and coloured <= MAX_LIT_FRACTION * (self.dark + coloured)
        return Facing.AWAY if is_away else Facing.UNKNOWN

    def add_lens(self, lens: str) -> None:
        """Count the lens of the newest box (by ``lens_of``; empty if it was not examined)."""
        self.lit += lens in SIGNALS
        self.yellow += lens == "yellow"
        self.dark += lens == "dark"

    @property
    def var_m2(self) -> float:
        """Variance of the range, including the odometer's error, which scales the range."""
        stretch = self.estimate.by_motion * self._stretch()
        return self.estimate.var_m2 + (stretch * self.estimate.mean_m) ** 2

    def _stretch(self) -> float:
        """Relative standard deviation of the distance travelled."""
        way_m = abs(self._way_m[-1] - self._way_m[0])
        if way_m < MERGE_M:
            return 0.0
        return math.hypot(self.way_scale_sd, math.sqrt(self._way_var_m2) / way_m)

    def size_by_motion(self) -> tuple[float, float] | None:
        """Log ratio of its size to the standard size, as mean and variance, by motion only.

        It is None while motion has too little information. The prior of the standard size is
        removed from the estimate, so that it is applied only once when objects are combined.
        """
        found, prior = self.alone, self.size
        precision = 1.0 / found.log_height_var - 1.0 / prior.log_var
        if precision <= MIN_INFORMATION / prior.log_var:
            return None
        mean = (found.log_height - prior.log_mean) / (found.log_height_var * precision)
        return mean, 1.0 / precision + self._stretch() ** 2

    def predict(self, motion: CarStep) -> None:
        """Predict the track to the next frame."""
        way_m, scale = motion.way_m or 0.0, 1.0
        if way_m:
            range_m = self.range_m
            scale = range_m / max(range_m - way_m, 0.1 * range_m, 1e-3)
        shift_px = self.lens.focal_px * math.tan(max(min(motion.turned_rad, 1.0), -1.0))
        (x, y), (x0, y0, x1, y1) = self.lens.center_px, self.box_px.tolist()
        left, right = (x + (at - x) * scale + shift_px for at in (x0, x1))
        self.box_px = np.array([left, y + (y0 - y) * scale, right, y + (y1 - y) * scale])
        self.height_px *= scale
        self.is_seen = False
        self.since_m += way_m
        self.unseen_m += abs(way_m)
        self.unseen_s += motion.seconds
        self._at_m += way_m
        self._way_var_m2 += motion.var_m2
        self._turned_rad += motion.turned_rad
        self.is_way_unknown = motion.way_m is None
        if motion.way_m is None or abs(self._turned_rad) > STRAIGHT_RAD:
            self._forget()

    def weigh_evidence(self, log_ratio: float, worth: float) -> None:
        """Add the evidence of a frame, which is worth so many independent ones."""
        self.evidence += worth * log_ratio
        self.hits += self.is_seen and worth > 0.0
        if self.evidence >= ACCEPTED and self.hits >= MIN_HITS:
            self.accept()
        elif self.evidence < TAKEN_BACK:
            self.is_accepted = False

    def accept(self) -> None:
        """Accept the track; its range is then by all observations."""
        if not self.is_accepted:
            self.is_accepted, self._alone = True, None

    def observe(self, box_px: NDArray[np.float64], height_px: float, cue: str) -> None:
        """Update the track with the box of the newest frame.

        Args:
            box_px: The box.
            height_px: Height of the object; 0 where the picture's edge cuts it.
            cue: Cue of the object.
        """
        self.seen += 1
        self.is_seen, self.unseen_m, self.unseen_s = True, 0.0, 0.0
        self.box_px = box_px.copy()
        if height_px <= 0.0:
            return
        width_px = float(box_px[2] - box_px[0])
        if width_px > 0.0:
            self._aspect.append(height_px / width_px)
            del self._aspect[:-MAX_OBSERVATIONS]
            self.aspect = median(self._aspect)
        if self._way_m and abs(self._at_m - self._way_m[-1]) < MERGE_M and self._merged:
            self._merged += 1
            self._height_px[-1] += (height_px - self._height_px[-1]) / self._merged
        else:
            self._way_m.append(self._at_m)
            self._height_px.append(height_px)
            self._merged = 1
            del self._way_m[:-MAX_OBSERVATIONS], self._height_px[:-MAX_OBSERVATIONS]
        self.size = size_prior(cue, self.aspect if self._aspect else None)
        self._alone = self._weighed = None
        self.since_m = self._at_m - self._way_m[-1]
        self.height_px = height_px

    def weigh(self, size: SizePrior) -> None:
        """Update the estimate with a size prior from similar objects."""
        self._weighed = self._ranged(size)

    def _ranged(self, size: SizePrior) -> MotionRange:
        if not self.is_accepted:
            return range_from_size(self._height_px[-1], self.lens.focal_px, size)
        return range_from_motion(
            np.array(self._way_m), np.array(self._height_px), self.lens.focal_px, size
        )

    def _forget(self) -> None:
        """Discard earlier heights, which are not of a straight path; the estimate remains."""
        if len(self._way_m) > 1:
            self._alone = self.alone
        self._way_m, self._height_px, self._merged = [self._at_m], [self.height_px], 0
        self._way_var_m2 = self._turned_rad = 0.0


class ObjectTracks:
    """Tracks all objects of one kind that are in view.

    Attributes:
        tracks: Tracks, in the order of their first observation.
        of_boxes: Track of each box of the newest frame; None for a second box of one object.
        counts: Number of boxes by outcome.
    """

    def __init__(
        self,
        cue: str,
        focal_px: float,
        center_px: tuple[float, float],
        way_scale_sd: float = 0.0,
    ) -> None:
        self.tracks: list[ObjectTrack] = []
        self.of_boxes: list[ObjectTrack | None] = []
        self.counts: Counter[str] = Counter()
        self._begun = 0
        self._cue = cue
        self._way_scale_sd = way_scale_sd
        self._lens = Lens(focal_px, center_px)

    def __call__(
        self,
        motion: CarStep,
        boxes_px: NDArray[np.float64],
        heights_px: NDArray[np.float64],
        lenses: Sequence[str] = (),
        evidence: NDArray[np.float64] | None = None,
        *,
        is_new: bool = True,
    ) -> Sequence[ObjectTrack]:
        """Update the tracks with the boxes of the next frame.

        Args:
            motion: Motion of the car since the previous frame.
            boxes_px: Shape (N, 4): x0, y0, x1, y1.
            heights_px: Shape (N,); 0 for an object that the picture's edge cuts.
            lenses: N lenses, or empty if they were not examined.
            evidence: Shape (N,): log likelihood ratio of each box; None where one box is enough to
                accept a track.
            is_new: False for a repeated picture, which is no further evidence.

        Returns:
            All tracks; those without an observation in this frame are predicted.
        """
        for track in self.tracks:
            track.predict(motion)
        worth = math.tanh(0.5 * motion.seconds / RESEMBLE_S) if is_new else 0.0
        slack = 1.0 if motion.way_m is not None else max(motion.seconds / UNSEEN_S, 1.0)
        self.of_boxes = self._assign(boxes_px, heights_px, slack)
        order = range(len(boxes_px)) if evidence is None else np.argsort(-evidence, kind="stable")
        for i in map(int, order):
            if self.of_boxes[i] is None and not self._is_found(boxes_px, i) and heights_px[i] > 0.0:
                self.of_boxes[i] = self._begin(boxes_px[i], float(heights_px[i]))
        followed = sum(one.is_accepted for one in self.tracks)
        for i, one in enumerate(self.of_boxes):
            if one is not None:
                one.add_lens(lenses[i] if lenses else "")
                if evidence is None:
                    one.accept()
                else:
                    one.weigh_evidence(float(evidence[i]), 1.0 if one.seen == 1 else worth)
        self.counts["objects followed"] += sum(one.is_accepted for one in self.tracks) - followed
        for one in self.tracks:
            if not one.is_seen and evidence is not None:
                one.weigh_evidence(MISSED, worth)
        self.tracks = [one for one in self.tracks if not _is_over(one)]
        self._share_sizes()
        return self.tracks

    def _assign(
        self, boxes_px: NDArray[np.float64], heights_px: NDArray[np.float64], slack: float
    ) -> list[ObjectTrack | None]:
        """Assign boxes to tracks, nearest pairs first; return the track of each box.

        Args:
            boxes_px: Shape (N, 4).
            heights_px: Shape (N,).
            slack: Factor on the permitted distances and logarithms of growth.
        """
        spans_px = np.where(heights_px > 0.0, heights_px, boxes_px[:, 3] - boxes_px[:, 1])
        own_px = np.array([one.height_px for one in self.tracks]).reshape(-1, 1)
        predicted_px = np.array([one.box_px for one in self.tracks]).reshape(-1, 1, 4)
        off_px = boxes_px - predicted_px
        # Distance of a box from the predicted box, in heights.
        away = 0.5 * np.hypot(off_px[..., 0] + off_px[..., 2], off_px[..., 1] + off_px[..., 3])
        away /= np.maximum(spans_px, own_px)
        is_near = np.abs(np.log(spans_px / own_px)) <= slack * math.log(GROWTH)
        is_near &= away < NEAR_HEIGHTS * slack
        found: list[ObjectTrack | None] = [None] * len(boxes_px)
        pairs = np.argwhere(is_near).tolist()
        for _, i, j in sorted((float(away[j, i]), i, j) for j, i in pairs):
            track = self.tracks[j]
            if found[i] is None and not track.is_seen:
                track.observe(boxes_px[i], float(heights_px[i]), self._cue)
                found[i] = track
        return found

    def _is_found(self, boxes_px: NDArray[np.float64], i: int) -> bool:
        """Return whether a box without a track is of an object with another box."""
        found = [j for j, one in enumerate(self.of_boxes) if one is not None]
        is_again = bool((box_ious(boxes_px[i], boxes_px[found]) > SAME_IOU).any())
        self.counts["boxes of an object already found"] += is_again
        return is_again

    def _share_sizes(self) -> None:
        """Combine each object's size with the sizes by motion of similar objects."""
        tracks = [one for one in self.tracks if one.is_accepted]
        sizes = [one.size_by_motion() for one in tracks]
        said = [
            (one, size)
            for one, size in zip(tracks, sizes, strict=True)
            if one.seen >= MIN_SEEN and size is not None
        ]
        for one, own in zip(tracks, sizes, strict=True):
            others = [
                size
                for other, size in said
                if other is not one
                and is_alike(one.aspect, other.aspect)
                and (own is None or may_be_one_make(own, size))
            ]
            if others and one.is_seen:
                one.weigh(shared_size(one.size, others))

    def _begin(self, box_px: NDArray[np.float64], height_px: float) -> ObjectTrack:
        self._begun += 1
        track = ObjectTrack(self._begun, box_px, height_px, size_prior(self._cue), self._lens)
        track.way_scale_sd = self._way_scale_sd
        track.observe(box_px, height_px, self._cue)
        self.tracks.append(track)
        return track


def is_alike(aspect: float, other: float) -> bool:
    """Whether two lights can be of one make, by the aspects of their boxes."""
    return abs(math.log(aspect / other)) < math.log(SAME_ASPECT)


def may_be_one_make(one: tuple[float, float], other: tuple[float, float]) -> bool:
    """Whether two lights can be of one make, by their sizes from motion."""
    var = one[1] + other[1] + 2.0 * SAME_MAKE**2
    return (one[0] - other[0]) ** 2 < OTHER_MAKE**2 * var


def difference_var_m2(one: ObjectTrack, other: ObjectTrack) -> float:
    """Variance of the difference of two ranges.

    For lights of one make, the common part of their sizes is left out. Its error changes both
    ranges alike, and the light with the higher box is the nearer one.
    """
    apart_m2 = one.var_m2 + other.var_m2
    if not is_alike(one.aspect, other.aspect):
        return apart_m2
    ratio_var = 2.0 * (SAME_MAKE**2 + BOX_SPREAD**2)
    return min(apart_m2, ratio_var * max(one.range_m, other.range_m) ** 2)


def shared_size(size: SizePrior, others: Sequence[tuple[float, float]]) -> SizePrior:
    """Size prior of an object, given the sizes of others of its make.

    The logarithm of a size is the sum of three Gaussians: the standard size, a part common to the
    make, and a part of the object (``SAME_MAKE``).

    Args:
        size: Prior from the object's aspect.
        others: Mean and variance of the log ratio (``ObjectTrack.size_by_motion``) of each other
            object.
    """
    own = min(SAME_MAKE**2, 0.5 * size.log_var)
    common = size.log_var - own
    precision = 1.0 / common + sum(1.0 / (own + var) for _, var in others)
    mean = sum(off / (own + var) for off, var in others) / precision
    var = own + 1.0 / precision
    return SizePrior(math.exp(size.log_mean + mean + 0.5 * var), math.sqrt(math.expm1(var)))


def _is_over(track: ObjectTrack) -> bool:
    if not track.is_accepted and track.evidence <= GIVEN_UP:
        return True
    has_moved = track.unseen_m > GONE_M or track.is_way_unknown
    return (has_moved and track.unseen_s > GONE_S) or track.range_m <= 0.0
