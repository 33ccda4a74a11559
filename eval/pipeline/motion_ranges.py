"""Ranges to an intersection from the motion of its lights and signs, one object for each reference.

Which object tells the range:

* **Traffic lights** stand on both sides of the crossing; the far ones mark its end. Of the lights
  that persist, one is chosen that no other is clearly (two standard deviations) further than.
* **Stop signs** mark the start: one that no other is clearly nearer than.

The choice stays while that holds, groups are never averaged, and every range is that object's own
posterior. Whether a light faces the car is unknown so far.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

from crosscue.detectors.base import Detections
from crosscue.detectors.ranging.object_tracks import Motion, ObjectTracks, Track
from crosscue.fusion.approaches import FrameEvidence, RangePosterior
from crosscue.fusion.intersection_range import Reference
from crosscue.replay.base import Floats
from crosscue.replay.vehicle.vehicle import Vehicle

from .sign_ranges import MEASURED, source_of, usable

CLEARLY: Final = 2.0
"""Standard deviations of the difference of two ranges."""
WIDEST_M: Final = 60.0
"""Lights further behind the nearest than this are another intersection's."""


@dataclass(slots=True)
class MotionRanges:
    """All kinds of objects whose range comes from motion; the vehicle file says which.

    Attributes:
        vehicle: Settings.
        counts: Objects followed, boxes of one object, and changes of choice.
    """

    vehicle: Vehicle
    counts: Counter[str] = field(default_factory=Counter)
    _chains: dict[Reference, _Chain] = field(default_factory=dict)

    def __call__(
        self,
        evidence: FrameEvidence,
        seconds: float,
        found: Sequence[Detections],
        heights_px: Sequence[Floats],
    ) -> tuple[RangePosterior, ...]:
        """The next frame: at most one range for each reference.

        Args:
            evidence: Of that frame; only the car's motion is read.
            seconds: Time since the frame before.
            found: Of the detectors of objects.
            heights_px: For each, the rows that every mask spans.
        """
        turned_rad = evidence.turned_rad or 0.0
        motion = Motion(evidence.travelled_m, evidence.travelled_var_m2, turned_rad, seconds)
        ranges = []
        for row, (cue, reference) in enumerate(MEASURED):
            if source_of(self.vehicle, cue.name) != "motion":
                continue
            boxes, heights = usable(self.vehicle, row, found, heights_px)
            if not len(boxes) and reference not in self._chains:
                continue
            if reference not in self._chains:
                self._chains[reference] = self._chain(reference, cue.name, found[0].size_px)
            one = self._chains[reference](motion, boxes, heights)
            if one is not None:
                ranges.append(one)
        return tuple(ranges)

    def restart(self) -> None:
        """Know nothing of what was before."""
        self._chains.clear()

    def _chain(self, reference: Reference, cue: str, size_px: tuple[int, int]) -> _Chain:
        camera = self.vehicle.camera
        center_px = camera.center_px or (0.5 * size_px[0], 0.5 * size_px[1])
        tracks = ObjectTracks(cue, camera.focal_px or 0.0, center_px)
        tracks.counts = self.counts
        return _Chain(self.vehicle, reference, tracks, self.counts)


@dataclass(slots=True)
class _Held:
    """The range of a choice that is no longer seen."""

    range_m: float
    var_m2: float
    seen: int


@dataclass(slots=True)
class _Chain:
    """One reference: its objects, and which of them tells the range."""

    vehicle: Vehicle
    reference: Reference
    tracks: ObjectTracks
    counts: Counter[str]
    _chosen: int | None = None
    _held: _Held | None = None

    def __call__(
        self, motion: Motion, boxes_px: Floats, heights_px: Floats
    ) -> RangePosterior | None:
        if self._held is not None:
            self._held.range_m -= motion.way_m or 0.0
            self._held.var_m2 += motion.var_m2
            if motion.way_m is None or self._held.range_m <= 0.0:
                self._held = None
        best = self._choose(self.tracks(motion, boxes_px, heights_px))
        if best is None:
            return None
        if best.number != self._chosen:
            self.counts[f"ranges to the {self.reference}: another object chosen"] += (
                self._chosen is not None
            )
            self._chosen = best.number
        self._held = _Held(best.range_m, self._var_m2(best), best.seen)
        if not best.is_seen:
            return None
        camera, estimate = self.vehicle.camera, best.estimate
        measured_m = (camera.focal_px or 0.0) * estimate.height_m / best.height_px
        return RangePosterior(
            self.reference,
            best.range_m + camera.x_m,
            self._var_m2(best),
            measured_m + camera.x_m,
        )

    def _choose(self, tracks: Sequence[Track]) -> Track | None:
        able = [one for one in tracks if self._is_able(one)]
        if not able:
            return None
        nearest_m = min(one.range_m for one in able)
        able = [one for one in able if one.range_m <= nearest_m + WIDEST_M]
        sign = 1.0 if self.reference is Reference.END else -1.0
        extreme = max(able, key=lambda one: sign * one.range_m)
        group = [one for one in able if not self._apart(one, extreme)]
        kept = [one for one in group if one.number == self._chosen]
        if kept:
            return kept[0]
        enough = 0.5 * max(one.seen for one in group)
        return max((one for one in group if one.seen >= enough), key=lambda one: sign * one.range_m)

    def _is_able(self, one: Track) -> bool:
        settings = self.vehicle.range_filter
        sd_m = math.sqrt(self._var_m2(one))
        if one.seen < settings.begin_after or sd_m > settings.most_sd_m:
            return False
        if one.range_m > settings.most_m or one.number == self._chosen:
            return one.range_m <= settings.most_m
        held = self._held
        if held is None or one.seen >= held.seen:
            return True
        off_m = abs(one.range_m - held.range_m)
        return off_m <= CLEARLY * math.sqrt(self._var_m2(one) + held.var_m2)

    def _apart(self, one: Track, other: Track) -> bool:
        off_m = abs(one.range_m - other.range_m)
        return off_m > CLEARLY * math.sqrt(self._var_m2(one) + self._var_m2(other))

    def _var_m2(self, one: Track) -> float:
        return one.var_m2 + (self.vehicle.range_filter.sd_share * one.range_m) ** 2
