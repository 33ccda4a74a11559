"""Ranges to an intersection from the motion of its lights and signs, one object for each reference.

The object that defines a range is chosen as follows:

* **Traffic lights** are on both sides of the intersection. Among those facing the vehicle, the
  farthest marks the **end**: no other may be clearly (two standard deviations) farther. A light of
  a nearer group, which may be seen from behind, marks the **start**. A light known not to face the
  vehicle never marks the end. If only one group was seen, the run reports it. Lights are set back
  from the intersection (``Ranges.light_setback_m``).
* **Stop signs** mark the **start**: one such that no other is clearly nearer. They take precedence
  over lights.

The choice is kept while these conditions hold. Groups are never averaged, and every range is the
posterior of a single object. It is written only if a second source confirms it: the object's
growth, or another object. A light of unknown facing marks nothing.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final, NamedTuple

from crosscue.detectors.ranging.object_tracks import (
    CarStep,
    Facing,
    ObjectTrack,
    difference_var_m2,
)
from crosscue.detectors.ranging.usable import source_of
from crosscue.fusion.evidence import RangePosterior
from crosscue.fusion.intersection_range import Reference
from crosscue.replay.vehicle.vehicle import TRAFFIC_LIGHT, Vehicle

from .sign_ranges import MEASURED

# Min difference of two clearly different ranges, in standard deviations.
CLEARLY: Final = 2.0
# Max ratio of the relative standard deviations of equally good ranges.
SURELY: Final = 1.25
# Max distance of a light behind the nearest one at the same intersection.
WIDEST_M: Final = 60.0
# Min distance between two groups, the width of a two-lane street with its kerbs.
NARROWEST_M: Final = 8.0
# Observations after which an object competes with any other. Below, it competes only with objects
# observed at most twice as often.
PERSISTS: Final = 10
# Minimum fraction of the variance that growth removes for it to confirm an assumed size.
GROWN: Final = 0.25
# Fraction of objects that are no light or sign of a standard size, and the spread of their sizes.
LOOK_ALIKES: Final = 0.05
LOOK_ALIKE_SPREAD: Final = 0.5
UNCONFIRMED: Final = "ranges not written: one object of assumed size"
ONE_GROUP: Final = "frames with only one group of lights"
ONLY_AWAY: Final = "frames with only lights that do not face the ego vehicle"


class RangedObject(NamedTuple):
    """One tracked object in one frame, a row of ``ranged_objects.parquet``.

    Attributes:
        cue: Cue of the object.
        object: Number of the object, unique for a cue between restarts.
        facing: Facing of a light, from the lit lenses observed so far.
        reference: Reference that it marks in this frame; None if none.
        range_m: Range from the rear axle to the object.
        var_m2: Variance of the range.
        height_m: Estimated height of the object.
        box_px: Box x0, y0, x1, y1.
    """

    cue: str
    object: int
    facing: Facing
    reference: Reference | None
    range_m: float
    var_m2: float
    height_m: float
    box_px: tuple[float, float, float, float]


@dataclass(slots=True)
class MotionRanges:
    """Ranges from motion, for all kinds of objects that the vehicle file selects.

    Attributes:
        vehicle: Settings.
        counts: Numbers of changes of choice, of frames with only one group, and of ranges that
            nothing confirmed.
        objects: Objects observed in the newest frame.
    """

    vehicle: Vehicle
    counts: Counter[str] = field(default_factory=Counter)
    objects: tuple[RangedObject, ...] = ()
    _chains: dict[str, _Chain] = field(default_factory=dict)

    def __call__(
        self,
        tracks: Mapping[str, Sequence[ObjectTrack]],
        motion: CarStep,
        without: frozenset[str] = frozenset(),
    ) -> tuple[RangePosterior, ...]:
        """Process the next frame; return at most one range for each reference.

        Args:
            tracks: Accepted tracks by cue.
            motion: Motion of the car since the previous frame.
            without: Cues to leave out.
        """
        ranges: dict[Reference, RangePosterior] = {}
        objects: list[RangedObject] = []
        for cue, _ in MEASURED:
            is_wanted = cue.name not in without and cue.name in tracks
            if not is_wanted or source_of(self.vehicle, cue.name) != "motion":
                continue
            if cue.name not in self._chains:
                choices = {one: _Choice(self.vehicle, one, self.counts) for one in Reference}
                self._chains[cue.name] = _Chain(self.vehicle, cue.name, self.counts, choices)
            chain = self._chains[cue.name]
            for one in chain(motion, tracks[cue.name]):
                ranges.setdefault(one.reference, one)
            objects += chain.objects(tracks[cue.name])
        self.objects = tuple(objects)
        return tuple(ranges.values())

    def restart(self) -> None:
        """Forget all objects."""
        self._chains.clear()
        self.objects = ()


@dataclass(slots=True)
class _Chain:
    vehicle: Vehicle
    cue: str
    counts: Counter[str]
    choices: dict[Reference, _Choice]

    def __call__(self, motion: CarStep, tracks: Sequence[ObjectTrack]) -> list[RangePosterior]:
        for choice in self.choices.values():
            choice.go_on(motion)
        if self.cue != TRAFFIC_LIGHT.name:
            return self._posteriors(
                {Reference.START: self.choices[Reference.START](tracks)}, tracks
            )
        facing = [one for one in tracks if one.facing is Facing.EGO]
        end = self.choices[Reference.END](facing)
        start = self.choices[Reference.START](_start_candidates(tracks, end))
        is_seen = any(one.is_seen for one in tracks)
        self.counts[ONE_GROUP] += is_seen and end is not None and start is None
        self.counts[ONLY_AWAY] += is_seen and end is None and start is not None
        return self._posteriors({Reference.END: end, Reference.START: start}, tracks)

    def objects(self, tracks: Sequence[ObjectTrack]) -> list[RangedObject]:
        marks = {choice.chosen: reference for reference, choice in self.choices.items()}
        return [
            RangedObject(
                self.cue,
                one.number,
                one.facing,
                marks.get(one.number),
                one.range_m + self.vehicle.camera.x_m,
                one.var_m2,
                one.estimate.height_m,
                tuple(one.box_px.tolist()),
            )
            for one in tracks
            if one.is_seen
        ]

    def _posteriors(
        self, chosen: dict[Reference, ObjectTrack | None], tracks: Sequence[ObjectTrack]
    ) -> list[RangePosterior]:
        """Return the ranges of the chosen objects that were observed in this frame."""
        camera, ranges = self.vehicle.camera, self.vehicle.ranges
        found = []
        for reference, one in chosen.items():
            if one is None or not one.is_seen:
                continue
            others = [other for other in tracks if other is not one]
            if not _is_confirmed(one, others):
                self.counts[UNCONFIRMED] += 1
                continue
            shift_m, place_var_m2 = camera.x_m, 0.0
            if self.cue == TRAFFIC_LIGHT.name:
                place_var_m2 = ranges.light_setback_sd_m**2
                shift_m -= ranges.light_setback_m if reference is Reference.END else 0.0
                shift_m += ranges.light_setback_m if one.facing is Facing.AWAY else 0.0
            measured_m = (camera.focal_px or 0.0) * one.estimate.height_m / one.height_px
            found.append(
                RangePosterior(
                    reference,
                    one.range_m + shift_m,
                    _widened_m2(one, others) + place_var_m2,
                    measured_m + shift_m,
                )
            )
        return found


def _is_confirmed(one: ObjectTrack, others: Sequence[ObjectTrack]) -> bool:
    """Return whether a range has a second source besides the assumed size of one object.

    This is the growth of the object, if it agrees with the size, or another object that agrees.
    """
    by_motion = one.size_by_motion()
    if by_motion is not None and one.estimate.by_motion >= GROWN:
        mean, var = by_motion
        return abs(mean) <= CLEARLY * math.sqrt(var + one.size.log_var)
    is_alike = (other for other in others if other.facing is one.facing)
    return any(not _is_apart(one, other) for other in is_alike)


def _widened_m2(one: ObjectTrack, others: Sequence[ObjectTrack]) -> float:
    """Return the variance of a range with what can be wrong about its object.

    As long as its size is assumed, it may be a look-alike of any size. And if other objects that
    face the same way are clearly at another range, but too close to be on the other side of the
    intersection, then the interval is widened until it contains them.
    """
    off_m = [
        abs(other.range_m - one.range_m)
        for other in others
        if other.facing is one.facing and _is_apart(one, other)
    ]
    widest_m = max((off for off in off_m if off <= NARROWEST_M), default=0.0)
    return max(one.var_m2 + _look_alike_m2(one), (widest_m / CLEARLY) ** 2)


def _look_alike_m2(one: ObjectTrack) -> float:
    """Return the variance of an object of assumed size that may be of any other size."""
    assumed = 1.0 - one.estimate.by_motion
    return LOOK_ALIKES * assumed * (LOOK_ALIKE_SPREAD * one.range_m) ** 2


def _relative_sd(one: ObjectTrack) -> float:
    return math.sqrt(one.var_m2 + _look_alike_m2(one)) / one.range_m


def _start_candidates(tracks: Sequence[ObjectTrack], end: ObjectTrack | None) -> list[ObjectTrack]:
    """Return the lights that may mark the start.

    These are lights facing away or, if the end is known, of known facing and clearly nearer.
    """
    if end is None:
        return [one for one in tracks if one.facing is Facing.AWAY]
    return [
        one
        for one in tracks
        if one.facing is not Facing.UNKNOWN
        and end.range_m - one.range_m > NARROWEST_M
        and (one.facing is Facing.AWAY or _is_apart(one, end))
    ]


@dataclass(slots=True)
class _Held:
    """Predicted range of a chosen object that is no longer observed."""

    range_m: float
    var_m2: float
    seen: int


@dataclass(slots=True)
class _Choice:
    """Choice of the object that marks a reference; it is kept while no other is clearly better."""

    vehicle: Vehicle
    reference: Reference
    counts: Counter[str]
    chosen: int | None = None
    _held: _Held | None = None

    def go_on(self, motion: CarStep) -> None:
        if self._held is not None:
            self._held.range_m -= motion.way_m or 0.0
            self._held.var_m2 += motion.var_m2
            if motion.way_m is None or self._held.range_m <= 0.0:
                self._held = None

    def __call__(self, tracks: Sequence[ObjectTrack]) -> ObjectTrack | None:
        best = self._best(tracks)
        if best is None:
            return None
        if best.number != self.chosen:
            self.counts[f"ranges to the {self.reference}: another object chosen"] += (
                self.chosen is not None
            )
            self.chosen = best.number
        self._held = _Held(best.range_m, best.var_m2, best.seen)
        return best

    def _best(self, tracks: Sequence[ObjectTrack]) -> ObjectTrack | None:
        eligible = [one for one in tracks if self._is_eligible(one)]
        if not eligible:
            return None
        nearest_m = min(one.range_m for one in eligible)
        enough = min(PERSISTS, 0.5 * max(one.seen for one in eligible))
        eligible = [
            one for one in eligible if one.range_m <= nearest_m + WIDEST_M and one.seen >= enough
        ]
        sign = 1.0 if self.reference is Reference.END else -1.0
        extreme = max(eligible, key=lambda one: sign * one.range_m)
        group = [one for one in eligible if not _is_apart(one, extreme)]
        kept = [one for one in group if one.number == self.chosen]
        if kept:
            return kept[0]
        often = 0.5 * max(one.seen for one in group)
        sure = {one.number: _relative_sd(one) for one in group if one.seen >= often}
        limit = SURELY * min(sure.values())
        best = (one for one in group if sure.get(one.number, math.inf) <= limit)
        return max(best, key=lambda one: sign * one.range_m)

    def _is_eligible(self, one: ObjectTrack) -> bool:
        settings = self.vehicle.range_filter
        sd_m = math.sqrt(one.var_m2)
        if one.seen < settings.begin_after or sd_m > settings.max_sd_m:
            return False
        if one.range_m > settings.max_m or one.number == self.chosen:
            return one.range_m <= settings.max_m
        held = self._held
        if held is None or one.seen >= held.seen:
            return True
        off_m = abs(one.range_m - held.range_m)
        return off_m <= CLEARLY * math.sqrt(one.var_m2 + held.var_m2)


def _is_apart(one: ObjectTrack, other: ObjectTrack) -> bool:
    """Return whether two tracks are clearly at different ranges."""
    var_m2 = difference_var_m2(one, other) + _look_alike_m2(one) + _look_alike_m2(other)
    return abs(one.range_m - other.range_m) > CLEARLY * math.sqrt(var_m2)
