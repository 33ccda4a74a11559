"""What rules are given: detections by role, road by region, cars by side, and where it all is."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from crosscue.detectors.base import Detections, Found, RoadMask
from crosscue.replay.vehicle.cue_spec import CueSpec


class Place(NamedTuple):
    """An intersection ahead, from the rear axle.

    Attributes:
        start_m: Its start.
        end_m: Its end.
        sd_m: Standard deviation of either.
    """

    start_m: float
    end_m: float
    sd_m: float


@dataclass(frozen=True, slots=True)
class RoadFractions:
    """How much of each region of interest is road (eq. 13).

    Attributes:
        left: Fraction of the left region's pixels, 0 to 1; NaN where the region is not seen.
        straight: Of the straight one.
        right: Of the right one.
    """

    left: float
    straight: float
    right: float

    def positive(self, min_fraction: float) -> tuple[bool, bool, bool]:
        """Left, straight and right road: more than ``min_fraction`` of the region (eq. 14)."""
        return self.left > min_fraction, self.straight > min_fraction, self.right > min_fraction


NOT_SEEN: Final = RoadFractions(math.nan, math.nan, math.nan)


class Sides(NamedTuple):
    """How many say left and how many right."""

    left: int
    right: int


NONE: Final = Sides(0, 0)


class Ways(NamedTuple):
    """How many cars come towards the ego vehicle, and how many go away."""

    oncoming: int
    outgoing: int


class Judged(NamedTuple):
    """What cars do, where they were followed over several frames and not only in two.

    Attributes:
        crossing: Cross traffic at the intersection.
        parked: Parked cars there.
        crossing_elsewhere: Cross traffic that is not there.
        parked_elsewhere: Likewise, or the place of the intersection is unknown.
        seen: Cars that were whole and near enough.
        followed: Those of them that were seen in frames enough.
        past: Cars that move along the road past the intersection; None where its place is unknown.
    """

    crossing: Sides
    parked: Sides
    crossing_elsewhere: Sides
    parked_elsewhere: Sides
    seen: int
    followed: int
    past: Ways | None = None


def nose_of(heights_px: NDArray[np.float64]) -> int:
    """-1 where the mask's left end is lower than its right, 1 where the right is, 0 where equal.

    An end is the outer quarter of the mask's length: single columns are too noisy.

    Args:
        heights_px: Shape (width,): mask pixels in each column.
    """
    (columns,) = heights_px.nonzero()
    if len(columns) < 4:
        return 0
    heights = heights_px[columns[0] : columns[-1] + 1]
    quarter = max(len(heights) // 4, 1)
    difference = heights[-quarter:].sum() - heights[:quarter].sum()
    return int(difference < 0) - int(difference > 0)


def of_side(sides: Sides, cue: CueSpec) -> int:
    """How many say the side that the cue supports."""
    return sides.left if cue.supports == ("left",) else sides.right


class Role(StrEnum):
    """What a detector looks for; where none of a role ran, its cues are not looked for."""

    OBJECTS = "objects"
    SIGNS = "signs"
    ROAD = "road"


@dataclass(frozen=True, slots=True)
class Seen:
    """What detectors found in one frame, by what they look for.

    Attributes:
        t_ns: Log time of the frame.
        objects: Of detectors of objects; empty where none ran.
        signs: Of detectors of one-way and do-not-enter signs; empty where none ran.
        road: Road pixels, or their fractions by region where these are known already.
        labels: What the detectors of objects and signs can report; None for anything.
        doubles: What was left out of ``objects`` and ``signs``, since another detector found it
            with a better score.
    """

    t_ns: int
    objects: tuple[Detections, ...] = ()
    signs: tuple[Detections, ...] = ()
    road: RoadMask | RoadFractions | None = None
    labels: frozenset[str] | None = None
    doubles: tuple[Detections, ...] = ()

    @property
    def boxes(self) -> tuple[Detections, ...]:
        """Of all detectors of objects and signs."""
        return (*self.objects, *self.signs)


def all_labels(labels: Iterable[Sequence[str] | None]) -> frozenset[str] | None:
    """What several detectors can report together; None for anything, if one does not say."""
    known: set[str] = set()
    for one in labels:
        if one is None:
            return None
        known.update(one)
    return frozenset(known)


def role_of(found: Found, is_for_signs: bool) -> Role:
    """The role that a result plays."""
    if isinstance(found, RoadMask):
        return Role.ROAD
    return Role.SIGNS if is_for_signs else Role.OBJECTS


def seen(
    t_ns: int,
    found: Sequence[Found],
    is_for_signs: Sequence[bool],
    labels: frozenset[str] | None = None,
) -> Seen:
    """One frame's results, sorted by role.

    Args:
        t_ns: Log time of the frame.
        found: One result for each detector.
        is_for_signs: Whether that detector looks for one-way and do-not-enter signs.
        labels: What all detectors can report together.
    """
    boxes: dict[bool, list[Detections]] = {True: [], False: []}
    road: RoadMask | None = None
    for one, for_signs in zip(found, is_for_signs, strict=True):
        if isinstance(one, Detections):
            boxes[for_signs].append(one)
        elif road is None:
            road = one
    return Seen(t_ns, tuple(boxes[False]), tuple(boxes[True]), road, labels)


@dataclass(frozen=True, slots=True)
class FrameCues:
    """What one frame says.

    Attributes:
        counts: From each cue that was looked for, a user's own among them, to how many there were;
            0 means searched for and not found.
        road: Fractions of road, where a detector segments.
    """

    counts: Mapping[str, int]
    road: RoadFractions | None
