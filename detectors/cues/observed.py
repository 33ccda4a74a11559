"""Inputs of the rules: detections by role, road by region, cars by side, and the intersection."""

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
    """Position of the intersection ahead, as distances from the rear axle.

    Attributes:
        start_m: Distance to its start.
        end_m: Distance to its end.
        sd_m: Standard deviation of either distance.
    """

    start_m: float
    end_m: float
    sd_m: float


@dataclass(frozen=True, slots=True)
class RoadFractions:
    """Fractions of road in the regions of interest, 0 to 1 (eq. 13); NaN for an unseen region.

    Attributes:
        left: Fraction of the left region's pixels that are road.
        straight: Fraction of the straight region's pixels that are road.
        right: Fraction of the right region's pixels that are road.
    """

    left: float
    straight: float
    right: float

    def positive(self, min_fraction: float) -> tuple[bool, bool, bool]:
        """Whether road covers more than ``min_fraction`` of the left, straight and right region.

        See eq. 14.
        """
        return self.left > min_fraction, self.straight > min_fraction, self.right > min_fraction


NOT_SEEN: Final = RoadFractions(math.nan, math.nan, math.nan)


class Sides(NamedTuple):
    """Counts for the left and for the right side."""

    left: int
    right: int


NONE: Final = Sides(0, 0)


class Ways(NamedTuple):
    """Numbers of oncoming and outgoing cars."""

    oncoming: int
    outgoing: int


class CarCounts(NamedTuple):
    """Counts of cars by behaviour, from tracks over several frames.

    Attributes:
        crossing: Cross traffic at the intersection.
        parked: Parked cars at the intersection.
        crossing_elsewhere: Cross traffic elsewhere.
        parked_elsewhere: Parked cars elsewhere, or all if the intersection's position is unknown.
        seen: Number of cars that were completely visible and near enough.
        followed: Number of those that were seen in enough frames.
        past: Cars that move along the road past the intersection; None if its position is unknown.
        in_leg: Cars that move in the left and in the right leg of the intersection; None if its
            position is unknown.
    """

    crossing: Sides
    parked: Sides
    crossing_elsewhere: Sides
    parked_elsewhere: Sides
    seen: int
    followed: int
    past: Ways | None = None
    in_leg: Sides | None = None


def nose_of(heights_px: NDArray[np.float64]) -> int:
    """Side of a car's nose: -1 if the mask is lower at the left end, 1 at the right, 0 if equal.

    An end is the outer quarter of the mask's length, because single columns are too noisy.

    Args:
        heights_px: Shape (width,): mask pixels in each column.
    """
    (columns,) = heights_px.nonzero()
    if len(columns) < 4:
        return 0
    heights = heights_px[columns[0] : columns[-1] + 1]
    quarter = len(heights) // 4
    difference = heights[-quarter:].sum() - heights[:quarter].sum()
    return int(difference < 0) - int(difference > 0)


def of_side(sides: Sides, cue: CueSpec) -> int:
    """Count for the side that the cue supports."""
    return sides.left if cue.supports == ("left",) else sides.right


class DetectorRole(StrEnum):
    """Kind of objects that a detector finds; without a detector of a role, its cues are unknown."""

    OBJECTS = "objects"
    SIGNS = "signs"
    ROAD = "road"


@dataclass(frozen=True, slots=True)
class FrameDetections:
    """Detectors' results for one frame, by role.

    Attributes:
        t_ns: Log time of the frame.
        size_px: Width and height of the picture; zero where it is not known.
        objects: Results of detectors of objects; empty if none ran.
        signs: Results of detectors of one-way and do-not-enter signs; empty if none ran.
        road: Road pixels, or their fractions by region if already known.
        labels: Labels that the detectors of objects and signs can report; None for any.
        doubles: Detections left out of ``objects`` and ``signs``, because another detector found
            the same objects with a better score.
    """

    t_ns: int
    objects: tuple[Detections, ...] = ()
    signs: tuple[Detections, ...] = ()
    road: RoadMask | RoadFractions | None = None
    labels: frozenset[str] | None = None
    doubles: tuple[Detections, ...] = ()
    size_px: tuple[int, int] = (0, 0)

    @property
    def found(self) -> tuple[Found, ...]:
        """Results of each detector; road only where its mask is known."""
        return (*self.boxes, *((self.road,) if isinstance(self.road, RoadMask) else ()))

    @property
    def boxes(self) -> tuple[Detections, ...]:
        """Results of all detectors of objects and signs."""
        return (*self.objects, *self.signs)


def all_labels(labels: Iterable[Sequence[str] | None]) -> frozenset[str] | None:
    """Union of the labels that detectors can report; None for any, if one declares none."""
    known: set[str] = set()
    for one in labels:
        if one is None:
            return None
        known.update(one)
    return frozenset(known)


def detector_role(found: Found, is_for_signs: bool) -> DetectorRole:
    """Role of a detector's result."""
    if isinstance(found, RoadMask):
        return DetectorRole.ROAD
    return DetectorRole.SIGNS if is_for_signs else DetectorRole.OBJECTS


@dataclass(frozen=True, slots=True)
class FrameCues:
    """Cues of one frame.

    Attributes:
        counts: Count of each evaluated cue, including the user's own; 0 means searched for and not
            found.
        road: Fractions of road, if a detector segments the road.
        objects: Detections of objects, with the decisions of tracks over frames.
    """

    counts: Mapping[str, int]
    road: RoadFractions | None
    objects: tuple[Detections, ...] = ()
